"""A source of simulated frames that moves virtual time: deterministic, as fast as the machine can."""

from __future__ import annotations

from collections.abc import Callable

from automodel.runtime.clocks import VirtualClock
from automodel.signals import Frame
from automodel.sim.world import Scene, World


class LockStepSource:
    """Implements `Source`: each `read` advances the clock to the next capture, plus the loop's own time.

    The clock's `on_advance` moves board and world, so that they follow whoever moves time.
    `latency_ns` stands for what the loop takes from capture to the byte on the wire: the clock shows it when `read`
    returns, so that commands reach the wire that much after their frame. `on_scene` is told the truth of each frame.
    """

    def __init__(
        self, world: World, clock: VirtualClock, rate_hz: float, latency_ns: int, on_scene: Callable[[Scene], None]
    ) -> None:
        self.world, self.clock = world, clock
        self._latency_ns = latency_ns
        self._on_scene = on_scene
        self._start_ns, self._rate_hz, self._index = clock.now_ns(), rate_hz, 0

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame, None when it is not due within `timeout_s` (which then has passed)."""
        now_ns = self.clock.now_ns()
        if self._time_of(self._index + 1) < now_ns:  # somebody waited longer: those frames are lost, as a camera's are
            self._index = int((now_ns - self._start_ns) * 1e-9 * self._rate_hz)
        t_ns = self._time_of(self._index + 1)
        deadline_ns = now_ns + round(timeout_s * 1e9)
        if t_ns > deadline_ns:
            self.clock.advance_to(deadline_ns)
            return None
        self._index += 1
        self.clock.advance_to(max(t_ns, now_ns))
        image, scene = self.world.capture(t_ns, self._index)
        self._on_scene(scene)
        self.clock.advance_to(max(t_ns + self._latency_ns, now_ns))
        return Frame(t_ns=t_ns, index=self._index, image=image)

    def _time_of(self, index: int) -> int:
        return self._start_ns + round(index * 1e9 / self._rate_hz)

    def close(self) -> None:
        """Nothing to give back."""
