"""The parts of a run with a fault built in: they stand between the run and the parts that work."""

from __future__ import annotations

import contextlib
import errno
import functools
import math
import os
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from automodel.bench.faults.fault import At, Disk, Hooks, LaneHook, Stall
from automodel.bench.faults.judge import Plan
from automodel.config import RecordingConfig, VehicleConfig
from automodel.interfaces import Pipeline, Recorder, Source, cameras_of
from automodel.recording.run_file import RunFile
from automodel.recording.writer import McapRecorder
from automodel.runtime.clocks import VirtualClock
from automodel.runtime.os_signals import Interrupted
from automodel.runtime.runner import Runner
from automodel.signals import SIDES, BoardSensors, Event, Frame, LaneEstimate, Motion, StereoFrame
from automodel.sim.world import Scene
from automodel.types import Image
from firmware_link.emulator.board import Peripherals

_APPROACH_IMAGES = 13  # more than frames are dropped in a row: the next one is always different
_WALL_CLOCKS = {"time": 3600, "time_ns": 3600 * 1_000_000_000}  # an hour in each one's unit

Step = Callable[[Frame, Motion], LaneEstimate]


class Staller:
    """Takes the time of a `Stall` at its place, while the fault lasts."""

    def __init__(self, stall: Stall | None, plan: Plan, clock: VirtualClock) -> None:
        self._stall, self._plan, self._clock = stall, plan, clock
        self._done = False

    def __call__(self, at: At) -> None:
        """Called at each place where a stall may happen."""
        stall, now_ns = self._stall, self._clock.now_ns()
        if stall is None or stall.at is not at or now_ns < self._plan.start_ns:
            return
        if self._done if not stall.again else now_ns >= self._plan.end_ns:
            return
        self._done = True
        self._clock.sleep(stall.seconds)


class FaultySource:
    """A `Source`; frames that were taken while the fault lasts go through the hook of the camera, or of the pair.

    `trouble` is why one camera of a pair gives its frames alone, "" while none does.
    """

    def __init__(self, source: Source, hooks: Hooks, plan: Plan, clock: VirtualClock, staller: Staller) -> None:
        self._source, self._hooks, self._plan, self._clock = source, hooks, plan, clock
        self._staller = staller
        self.trouble = ""
        self._late: deque[tuple[int, Frame | StereoFrame]] = deque()

    def read(self, timeout_s: float) -> Frame | StereoFrame | None:
        """The next frame that the faulty camera delivers; raises what its hook raises."""
        self._staller(At.CAMERA)
        deadline_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while True:
            now_ns = self._clock.now_ns()
            if self._late and self._late[0][0] <= now_ns:
                return self._told(self._late.popleft()[1])
            until_ns = min(deadline_ns, self._late[0][0]) if self._late else deadline_ns
            frame = self._source.read(max(until_ns - now_ns, 0) * 1e-9)
            if frame is not None:
                self._take(frame)
            elif until_ns == deadline_ns:
                return None

    def _told(self, frame: Frame | StereoFrame) -> Frame | StereoFrame:
        self.trouble = ""
        if isinstance(frame, Frame) and self._hooks.pair is not None:
            self.trouble = f"{SIDES[1 - frame.eye]} camera: no frame comes"
        return frame

    def _take(self, frame: Frame | StereoFrame) -> None:
        delivery: tuple[int, Frame | StereoFrame] | None = (0, frame)
        if self._plan.start_ns <= frame.t_ns < self._plan.end_ns:
            delivery = self._spoilt(frame)
        if delivery is not None:
            due_ns, out = delivery
            before_ns = self._late[-1][0] if self._late else 0  # frames do not overtake each other
            self._late.append((max(due_ns, before_ns), out))

    def _spoilt(self, frame: Frame | StereoFrame) -> tuple[int, Frame | StereoFrame] | None:
        """Of a pair the left camera fails, and the right one where it has a hook, unless the pair itself has one."""
        hook, pair = self._hooks.camera, self._hooks.pair
        if isinstance(frame, StereoFrame) and pair is not None:
            return pair(frame)
        if hook is None:
            return 0, frame
        if isinstance(frame, Frame):
            return hook(frame)
        left = hook(Frame(t_ns=frame.t_ns, index=frame.index, image=frame.left))
        if left is None:
            return None
        due_ns, out = left
        spoilt = replace(frame, t_ns=out.t_ns, left=out.image)
        if self._hooks.right_camera is None:
            return due_ns, spoilt
        right = self._hooks.right_camera(Frame(t_ns=frame.t_ns, index=frame.index, image=frame.right, eye=1))
        return None if right is None else (max(due_ns, right[0]), replace(spoilt, right=right[1].image))

    def close(self) -> None:
        """As the source's."""
        self._source.close()


class FaultyPipeline:
    """A `Pipeline` that gives the truth until `seen` has found the lane, then its estimates.

    Without `seen` it always gives the truth. Estimates of frames that were taken while the fault lasts go through its
    hook. It needs as many cameras as `seen`: a loop gives the left image alone to a pipeline that needs one.
    `knows` is whether the last estimate before the fault was sure of its lane: its offset's bound was within the
    free space beside the car. Where it states no bound (the truth), it is. `offsets_m`: the car's offset [m] in each
    frame, by its time [ns]; NaN where there was none.
    """

    name = "faulty"

    def __init__(
        self,
        truth: Step,
        seen: Pipeline | None,
        hook: LaneHook | None,
        plan: Plan,
        staller: Staller,
        vehicle: VehicleConfig,
    ) -> None:
        self.knows = True
        self._before, self._last_ns = True, -1  # whether the fault is still to come, the last frame's time
        self.offsets_m: list[tuple[int, float]] = []
        self.cameras = cameras_of(seen)
        self._vehicle = vehicle
        self._truth, self._seen, self._hook, self._plan = truth, seen, hook, plan
        self._staller = staller

    def step(self, frame: Frame, motion: Motion) -> LaneEstimate:
        """The lane, perhaps spoilt."""
        self._staller(At.PIPELINE)
        estimate = self._estimate(frame, motion)
        # A fault may set the time back to before it started.
        self._before = self._before and self._last_ns < frame.t_ns < self._plan.start_ns
        self._last_ns = frame.t_ns
        if self._before:
            pose = estimate.pose
            limit_m = math.inf if pose is None else self._vehicle.free_space_m(pose.width_m)
            self.knows = pose is not None and (math.isinf(pose.offset_bound_m) or pose.offset_bound_m <= limit_m)
        elif self._hook is not None and frame.t_ns < self._plan.end_ns:
            estimate = self._hook(estimate)
        self.offsets_m.append((frame.t_ns, math.nan if estimate.pose is None else estimate.pose.offset_m))
        return estimate

    def _estimate(self, frame: Frame, motion: Motion) -> LaneEstimate:
        if self._seen is None or frame.t_ns < self._plan.rendered_ns:
            return self._truth(frame, motion)
        seen = self._seen.step(frame, motion)
        return seen if frame.t_ns >= self._plan.pipeline_ns else self._truth(frame, motion)

    @property
    def trouble(self) -> str:
        """The pipeline's."""
        return str(getattr(self._seen, "trouble", ""))

    def reset(self) -> None:
        """As the pipeline's."""
        if self._seen is not None:
            self._seen.reset()


class Person:
    """Asks to arm when the plan says, and to stop after `stop`."""

    def __init__(self, plan: Plan, clock: VirtualClock) -> None:
        self._press_ns, self._clock = plan.press_ns, clock
        self._asked_ns = 0
        self._word: str | None = None

    def pressed(self) -> bool:
        """Whether arming was asked for since the last call."""
        before_ns, self._asked_ns = self._asked_ns, self._clock.now_ns()
        return self._press_ns is not None and before_ns < self._press_ns <= self._asked_ns

    def stop(self) -> None:
        """The car has to stop."""
        self._word = "STOP"

    def stop_asked(self) -> str | None:
        """Why the car has to stop, None where nobody has asked for it since the last call."""
        word, self._word = self._word, None
        return word


@functools.lru_cache
def approach_images(height: int, width: int) -> tuple[Image, ...]:
    """Images without a road, all different and none of them blank."""
    slope = np.linspace(40.0, 200.0, width)
    generator = np.random.default_rng(0)
    noisy = (slope + generator.normal(0.0, 5.0, (height, width)) for _ in range(_APPROACH_IMAGES))
    return tuple(image.astype(np.uint8) for image in noisy)


class FaultyPeripherals:
    """Logs the pulses at the pins; a stuck servo and wrong sensors while the fault lasts."""

    def __init__(self, real: Peripherals, hooks: Hooks, plan: Plan) -> None:
        self._real, self._hooks, self._plan = real, hooks, plan
        self._servo_us = 0.0
        self.pins: list[tuple[int, float, float]] = []  # t_ns, servo_us, motor_us

    def set_pulses(self, t_ns: int, servo_us: float, motor_us: float) -> None:
        """Pass the board's pulses on; a servo that is stuck does not follow."""
        self.pins.append((t_ns, servo_us, motor_us))
        if not (self._hooks.servo_stuck and self._lasts(t_ns)):
            self._servo_us = servo_us
        self._real.set_pulses(t_ns, self._servo_us, motor_us)

    def read_sensors(self, t_ns: int) -> BoardSensors:
        """The readings, perhaps spoilt."""
        sensors = self._real.read_sensors(t_ns)
        hook = self._hooks.sensors
        return sensors if hook is None or not self._lasts(t_ns) else hook(sensors)

    def _lasts(self, t_ns: int) -> bool:
        return self._plan.start_ns <= t_ns < self._plan.end_ns


class RaisingRecorder:
    """A `Recorder` that keeps nothing, and raises from the fault's start on."""

    def __init__(self, plan: Plan, clock: VirtualClock) -> None:
        self._plan, self._clock = plan, clock

    def _put(self, value: object = None) -> None:
        if self._clock.now_ns() >= self._plan.start_ns:
            raise OSError("run.mcap: no space left on the device")

    frame = motion = state = estimate = command = driver = event = close = _put


class FullDisk(RunFile):
    """A recording's file on a disk without space."""

    def frame(self, frame: Frame | StereoFrame) -> None:
        """Raise the error of a full disk."""
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


class SlowDisk(RunFile):
    """A recording's file that writes nothing before `released` is set."""

    released: threading.Event

    def frame(self, frame: Frame | StereoFrame) -> None:
        """Wait, then write a frame."""
        self.released.wait()
        super().frame(frame)


class SlowRecorder(McapRecorder):
    """A recorder whose disk writes nothing before it is closed."""

    def __init__(self, path: Path, config: RecordingConfig) -> None:
        released = threading.Event()
        self._released = released
        super().__init__(path, "", config, type("ThisDisk", (SlowDisk,), {"released": released}))

    def close(self) -> None:
        """Let the disk write, then close."""
        self._released.set()
        super().close()


@contextlib.contextmanager
def faulty_recorder(disk: Disk | None, plan: Plan, clock: VirtualClock) -> Iterator[Recorder | None]:
    """A recorder with this fault; None where there is none."""
    if disk is None or disk is Disk.RAISES:
        yield None if disk is None else RaisingRecorder(plan, clock)
        return
    config = RecordingConfig(image="jpeg")
    with tempfile.TemporaryDirectory(prefix="faults-") as folder:
        path = Path(folder) / "run.mcap"
        slow = disk is Disk.SLOW
        recorder = SlowRecorder(path, config) if slow else McapRecorder(path, "", config, FullDisk)
        try:
            yield recorder
        finally:
            recorder.close()


def outside_m(scene: Scene) -> float:
    """How far the car's body is outside its lane [m], 0 where it is inside."""
    return max(scene.reach_m - 0.5 * scene.truth.width_m, 0.0)


def driven(runner: Runner, stop: Callable[[], bool]) -> tuple[tuple[Event, ...], str | None]:
    """The events of a run until `stop`; none where an exception left it, and that one. Raises Interrupted."""
    try:
        result = runner.run(stop=stop)
    except (ArithmeticError, LookupError, OSError, RuntimeError, TypeError, ValueError) as error:
        return (), f"{type(error).__name__}: {error}"
    if result.interrupted:
        raise Interrupted
    return result.events, None


def set_wall_clock_back() -> None:
    """The wall clock's functions give an hour less from now on."""
    for name, hour in _WALL_CLOCKS.items():
        setattr(time, name, functools.partial(_earlier, getattr(time, name), hour))


def _earlier(clock: Callable[[], float], by: float) -> float:
    return clock() - by


@contextlib.contextmanager
def wall_clock_kept() -> Iterator[None]:
    """Restores the wall clock's functions afterwards."""
    kept = {name: getattr(time, name) for name in _WALL_CLOCKS}
    try:
        yield
    finally:
        for name, function in kept.items():
            setattr(time, name, function)
