"""A source of simulated frames that moves virtual time: deterministic, as fast as the machine can."""

from __future__ import annotations

from collections.abc import Callable

from automodel.clocks import VirtualClock
from automodel.signals import Frame
from automodel.sim.world import Scene, World


class LockStepSource:
    """Implements `Source`: each `read` advances the clock to the next capture, plus the loop's own time.

    The clock's `on_advance` is the world's `advance`, so that the world follows whoever moves time.
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

    def read(self, timeout_s: float) -> Frame:
        """The next frame (always there in time)."""
        self._index += 1
        t_ns = self._start_ns + round(self._index * 1e9 / self._rate_hz)
        if (
            t_ns < self.clock.now_ns()
        ):  # somebody waited longer than a frame: those frames are lost, as on a real camera
            self._index = int((self.clock.now_ns() - self._start_ns) * 1e-9 * self._rate_hz) + 1
            t_ns = self._start_ns + round(self._index * 1e9 / self._rate_hz)
        self.clock.advance_to(t_ns)
        image, scene = self.world.capture(t_ns, self._index)
        self._on_scene(scene)
        self.clock.advance_to(t_ns + self._latency_ns)
        return Frame(t_ns=t_ns, index=self._index, image=image)

    def close(self) -> None:
        """Nothing to give back."""
