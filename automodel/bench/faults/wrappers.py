"""The parts of a run with a fault built in: they stand between the run and the parts that work."""

from __future__ import annotations

from collections import deque
from typing import Protocol

from automodel.bench.faults.hooks import At, CameraHook, Hooks, LaneHook, Stall
from automodel.bench.faults.plan import DRIVEN_BY_NS, PICTURES_NS, Plan
from automodel.interfaces import Pipeline, Source
from automodel.runtime.clocks import VirtualClock
from automodel.signals import BoardSensors, Command, Event, Frame, LaneEstimate, Motion, StereoFrame, VehicleState


class Staller:
    """Takes the time of a `Stall` at its place, where the fault's time has come."""

    def __init__(self, stall: Stall | None, plan: Plan, clock: VirtualClock) -> None:
        self._stall, self._plan, self._clock = stall, plan, clock
        self._done = False

    def __call__(self, at: At) -> None:
        """Called at each place where time may be taken."""
        stall, now_ns = self._stall, self._clock.now_ns()
        if stall is None or stall.at is not at or now_ns < self._plan.begin_ns:
            return
        if self._done if not stall.again else now_ns >= self._plan.end_ns:
            return
        self._done = True
        self._clock.sleep(stall.seconds)


class FaultySource:
    """Implements `Source`: frames that were taken while the fault lasts go through its hook."""

    def __init__(
        self, source: Source, hook: CameraHook | None, plan: Plan, clock: VirtualClock, staller: Staller
    ) -> None:
        self._source, self._hook, self._plan, self._clock = source, hook, plan, clock
        self._staller = staller
        self._late: deque[tuple[int, Frame]] = deque()

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame that the faulty camera delivers; raises what its hook raises."""
        self._staller(At.CAMERA)
        deadline_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while True:
            now_ns = self._clock.now_ns()
            if self._late and self._late[0][0] <= now_ns:
                return self._late.popleft()[1]
            until_ns = min(deadline_ns, self._late[0][0]) if self._late else deadline_ns
            frame = self._source.read(max(until_ns - now_ns, 0) * 1e-9)
            if isinstance(frame, Frame):
                self._take(frame)
            elif until_ns == deadline_ns:
                return None

    def _take(self, frame: Frame) -> None:
        delivery: tuple[int, Frame] | None = (0, frame)
        if self._hook is not None and self._plan.begin_ns <= frame.t_ns < self._plan.end_ns:
            delivery = self._hook(frame)
        if delivery is not None:
            due_ns, out = delivery
            before_ns = self._late[-1][0] if self._late else 0  # frames do not overtake each other
            self._late.append((max(due_ns, before_ns), out))

    def close(self) -> None:
        """As the source's."""
        self._source.close()


class Seer(Protocol):
    """A pipeline that is told the truth."""

    def step(self, frame: Frame, motion: Motion) -> LaneEstimate:
        """The lane."""
        ...


class FaultyPipeline:
    """Implements `Pipeline`: the truth's estimates until `seen` has got used to the road, then its own.

    Estimates of the time while the fault lasts go through its hook. `seen` is None where the truth is to be used
    throughout.
    """

    name = "faulty"

    def __init__(self, truth: Seer, seen: Pipeline | None, hook: LaneHook | None, plan: Plan, staller: Staller) -> None:
        self._truth, self._seen, self._hook, self._plan = truth, seen, hook, plan
        self._staller = staller

    def step(self, frame: Frame, motion: Motion) -> LaneEstimate:
        """The lane, or what the fault makes of it."""
        self._staller(At.PIPELINE)
        estimate = self._look(frame, motion)
        if self._hook is not None and self._plan.begin_ns <= frame.t_ns < self._plan.end_ns:
            estimate = self._hook(estimate)
        return estimate

    def _look(self, frame: Frame, motion: Motion) -> LaneEstimate:
        if self._seen is None or frame.t_ns < PICTURES_NS:
            return self._truth.step(frame, motion)
        seen = self._seen.step(frame, motion)
        return seen if frame.t_ns >= DRIVEN_BY_NS else self._truth.step(frame, motion)

    def reset(self) -> None:
        """As the pipeline's."""
        if self._seen is not None:
            self._seen.reset()


class Peripherals(Protocol):
    """What hangs on a board's pins."""

    def set_pulses(self, t_ns: int, servo_us: float, motor_us: float) -> None:
        """The pulses [us] at the pins from `t_ns` on."""
        ...

    def read_sensors(self, t_ns: int) -> BoardSensors:
        """What the sensors read at `t_ns`."""
        ...


class FaultyPeripherals:
    """Notes the pulses at the pins; lets a servo stick and sensors lie while the fault lasts."""

    def __init__(self, real: Peripherals, hooks: Hooks, plan: Plan) -> None:
        self._real, self._hooks, self._plan = real, hooks, plan
        self._servo_us = 0.0
        self.pins: list[tuple[int, float, float]] = []  # t_ns, servo_us, motor_us

    def set_pulses(self, t_ns: int, servo_us: float, motor_us: float) -> None:
        """The board's pulses; a servo that is stuck does not follow."""
        self.pins.append((t_ns, servo_us, motor_us))
        if not (self._hooks.servo_stuck and self._lasts(t_ns)):
            self._servo_us = servo_us
        self._real.set_pulses(t_ns, self._servo_us, motor_us)

    def read_sensors(self, t_ns: int) -> BoardSensors:
        """What the sensors say."""
        sensors = self._real.read_sensors(t_ns)
        hook = self._hooks.sensors
        return sensors if hook is None or not self._lasts(t_ns) else hook(sensors)

    def _lasts(self, t_ns: int) -> bool:
        return self._plan.begin_ns <= t_ns < self._plan.end_ns


class RaisingRecorder:
    """Implements `Recorder`: keeps nothing, and raises from the fault's begin on."""

    def __init__(self, plan: Plan, clock: VirtualClock) -> None:
        self._plan, self._clock = plan, clock

    def _put(self) -> None:
        if self._clock.now_ns() >= self._plan.begin_ns:
            raise OSError("run.mcap: no space left on the device")

    def frame(self, frame: Frame | StereoFrame) -> None:
        """Nothing, or the error."""
        self._put()

    def motion(self, motion: Motion) -> None:
        """Nothing, or the error."""
        self._put()

    def state(self, state: VehicleState) -> None:
        """Nothing, or the error."""
        self._put()

    def estimate(self, estimate: LaneEstimate) -> None:
        """Nothing, or the error."""
        self._put()

    def command(self, command: Command) -> None:
        """Nothing, or the error."""
        self._put()

    def event(self, event: Event) -> None:
        """Nothing, or the error."""
        self._put()

    def close(self) -> None:
        """Nothing, or the error."""
        self._put()
