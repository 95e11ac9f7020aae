"""One run of the simulated car with a fault built in: track -> camera -> pipeline -> control -> bytes -> board -> car.

To be cheap a run begins at rest with the truth for a pipeline and a picture that shows no road; the camera and the
pipeline that is asked for take over when the car drives steadily, before the fault begins.

Recorders on disks that are full or too slow.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import functools
import math
import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from automodel.assembly.parts import build_run, make_loop, make_pipeline, run_config
from automodel.assembly.simulated_car import LATENCY_NS, renderer
from automodel.bench.faults.fault import Fault
from automodel.bench.faults.hooks import At, Disk, Hooks, Moment
from automodel.bench.faults.judge import Observed, Verdict, judge
from automodel.bench.faults.plan import PICTURES_NS, Plan, draw_plan
from automodel.bench.faults.wrappers import FaultyPeripherals, FaultyPipeline, FaultySource, RaisingRecorder, Staller
from automodel.config import CameraConfig, CarConfig, RecordingConfig
from automodel.interfaces import Recorder
from automodel.recording.run_file import RunFile
from automodel.recording.writer import McapRecorder
from automodel.runtime.clocks import VirtualClock
from automodel.runtime.input_checks import InputChecks
from automodel.runtime.run_types import TickRecord
from automodel.runtime.runner import Runner
from automodel.signals import Event, Frame, StereoFrame
from automodel.sim.appearance import Appearance
from automodel.sim.plant import Plant, PlantConfig
from automodel.sim.renderer import Renderer
from automodel.sim.sources import LockStepSource
from automodel.sim.track import Lane, Track
from automodel.sim.track_files import load_track
from automodel.sim.truth import TruthFollower
from automodel.sim.world import Scene, TrueLane, World
from automodel.sources.errors import SourceError
from automodel.types import Image
from firmware_link.arduino import ArduinoLink
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.emulator.faulty_board import FaultyBoard
from firmware_link.emulator.logic import BoardOptions
from firmware_link.messages import TABLE_HASH
from firmware_link.pulses import PulseTable
from firmware_link.transport import MemoryTransport


class FullDisk(RunFile):
    """Takes no frame at all."""

    def frame(self, frame: Frame | StereoFrame) -> None:
        """The error of a full disk."""
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


class SlowDisk(RunFile):
    """Takes the first frame only when `released` is set."""

    released: threading.Event

    def frame(self, frame: Frame | StereoFrame) -> None:
        """Write a frame, much later."""
        self.released.wait()
        super().frame(frame)


class SlowRecorder(McapRecorder):
    """A recorder whose disk writes nothing until it is closed."""

    def __init__(self, path: Path, config: RecordingConfig) -> None:
        released = threading.Event()
        self._released = released
        super().__init__(path, "", config, type("ThisDisk", (SlowDisk,), {"released": released}))

    def close(self) -> None:
        """Let the disk write, and close."""
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


TRACK = "oval"
LOOKS = 4
TRUTH = "truth"  # the pipeline that reads it
AFTER_S = 0.3  # the pins are watched for so long after the program has ended
_SHOWN_RADPS, _SHOWN_SHARE, _SHOWN_NS = 0.6, 0.5, 300_000_000  # a car that turns so much otherwise, for so long
_APPROACH_PICTURES = 13  # more than frames are dropped in a row: the next one is another
_WALL_CLOCKS = {"time": 3600, "time_ns": 3600 * 1_000_000_000}  # an hour in each one's unit


@functools.lru_cache
def _track() -> Track:
    return load_track(TRACK)


@functools.lru_cache
def _lane() -> Lane:
    return _track().lane()


@functools.lru_cache
def _renderer(camera: CameraConfig, look: int) -> Renderer:
    """A plain floor, cheap to draw; the sensor's noise makes each picture another."""
    grey = 30.0 + 20.0 * look
    look_of_it = Appearance(floor_grey=grey, marking_grey=grey + 120.0, vignetting=0.2, read_noise=2.0, noise_seed=look)
    return renderer(_track(), CarConfig(camera=camera), look_of_it)


@functools.lru_cache
def _approach_pictures(height: int, width: int) -> tuple[Image, ...]:
    """Pictures that are none of a road, each another and none of them blank."""
    slope = np.linspace(40.0, 200.0, width)
    generator = np.random.default_rng(0)
    noisy = (slope + generator.normal(0.0, 5.0, (height, width)) for _ in range(_APPROACH_PICTURES))
    return tuple(picture.astype(np.uint8) for picture in noisy)


class Eyes:
    """A camera that begins to look at picture `first`; never where it is None."""

    def __init__(self, car: CarConfig, look: int, first: int | None) -> None:
        self._renderer = None if first is None else _renderer(car.camera, look)
        self._first = first
        self._approach = _approach_pictures(car.camera.height_px, car.camera.width_px)

    def render(
        self, x_m: float, y_m: float, yaw_rad: float, speed_mps: float, yaw_rate_radps: float, index: int
    ) -> Image:
        """A picture of the road, or of nothing."""
        if self._renderer is None or self._first is None or index < self._first:
            return self._approach[index % len(self._approach)]
        return self._renderer.render(x_m, y_m, yaw_rad, speed_mps, yaw_rate_radps, index)


class FaultRig:
    """All parts of one run; `run` makes it."""

    def __init__(self, car: CarConfig, pipeline: str, plan: Plan, hooks: Hooks) -> None:
        self._car, self._plan, self._hooks = car, plan, hooks
        self._scenes: list[Scene] = []
        self._stopping = False
        self._asked_ns = 0
        by_truth = pipeline == TRUTH
        self._build_world(None if by_truth else math.ceil(PICTURES_NS * 1e-9 * car.camera.rate_hz))
        self._clock = VirtualClock(0, self._advance)
        self._staller = Staller(hooks.stall, plan, self._clock)
        self._transport = MemoryTransport(self._line, self._clock)
        for after_s, moment in hooks.moments:
            self._line.at(plan.begin_ns + round(after_s * 1e9), functools.partial(self._happen, moment))
        seer = None if by_truth else make_pipeline(pipeline, car)
        self._pipeline = FaultyPipeline(self._truth, seer, hooks.lane, plan, self._staller)
        lock_step = LockStepSource(self._world, self._clock, car.camera.rate_hz, LATENCY_NS, self._on_scene)
        self._source = FaultySource(lock_step, hooks.camera, plan, self._clock, self._staller)

    def run(self) -> Observed:
        """Drive, and what was seen of it."""
        error: str | None = None
        events: tuple[Event, ...] = ()
        with faulty_recorder(self._hooks.disk, self._plan, self._clock) as recorder, _wall_clock_kept():
            runner = self._runner(recorder)
            try:
                events = runner.run(stop=self._is_over).events
            except (ArithmeticError, LookupError, OSError, RuntimeError, TypeError, ValueError) as e:
                error = f"{type(e).__name__}: {e}"
        self._clock.sleep(AFTER_S)
        link = self._car.link
        servo, motor = PulseTable(link.servo.pulse_us, link.servo.steering_rad), self._motor()
        return Observed(
            pins=self._pins.pins,
            events=events,
            outside=any(s.reach_m > 0.5 * s.truth.width_m for s in self._scenes if s.t_ns >= self._plan.begin_ns),
            shown_ns=self._shown_ns(servo),
            error=error,
            neutral_us=motor.zero_us,
            straight_us=servo.zero_us,
            limits_us=(servo.min_us, servo.max_us, motor.min_us, motor.max_us),
        )

    def on_tick(self, record: TickRecord) -> None:
        """After a turn of the runner, which this observes."""
        self._staller(At.AFTER)

    def _build_world(self, first: int | None) -> None:
        car, plan = self._car, self._plan
        lane = _lane()
        start = lane.pose(plan.place * lane.centerline.length_m, plan.offset_m)
        follower = TruthFollower(lane, car.vehicle.reference_x_m)
        vehicle = car.vehicle
        true = PlantConfig(wheelbase_m=vehicle.wheelbase_m, ticks_per_m=vehicle.ticks_per_m, seed=plan.look)
        self._world = World(
            Plant(true, start),
            Eyes(car, plan.look, first),
            follower,
            lambda state: follower.lateral_reach_m(state, vehicle),
        )
        self._truth = TrueLane(lane)
        self._pins = FaultyPeripherals(self._world, self._hooks, plan)
        self._line = FaultyBoard(
            EmulatedArduino(self._pins, car.link.baud),
            plan.begin_ns,
            plan.end_ns,
            to_board=self._hooks.to_board,
            from_board=self._hooks.from_board,
            pulses=self._hooks.pulses,
        )

    def _runner(self, recorder: Recorder | None) -> Runner:
        car = self._car
        parts = build_run(
            car,
            source=self._source,
            link=ArduinoLink(self._transport, car.link, car.vehicle),
            clock=self._clock,
            loop=make_loop(car, pipeline=self._pipeline, checks=InputChecks(car)),
            recorder=recorder,
        )
        config = run_config(car, collector_off=False)
        return Runner(parts, config, observer=self, arm_requested=self._pressed, reopen=self._reopen)

    def _advance(self, t_ns: int) -> None:
        self._line.advance(t_ns)
        self._world.settle(t_ns)

    def _on_scene(self, scene: Scene) -> None:
        self._scenes.append(scene)
        self._truth.on_scene(scene)

    def _happen(self, moment: Moment, t_ns: int) -> None:
        board = self._line.board
        assert isinstance(board, EmulatedArduino)
        if moment is Moment.UNPLUG:
            self._transport.unplug()
        elif moment is Moment.REPLUG:
            self._transport.replug()
        elif moment is Moment.OTHER_FIRMWARE:
            other = BoardOptions(table_hash=TABLE_HASH ^ 1, boot_id=board.boot_id + 1)
            self._line.board = EmulatedArduino(self._pins, self._car.link.baud, other)
        elif moment is Moment.BROWN_OUT:
            board.brown_out(t_ns)
        elif moment is Moment.HANG:
            board.hang(t_ns)
        elif moment is Moment.RESTART:
            board.reset(t_ns)
        elif moment is Moment.STOP_REQUEST:
            self._stopping = True
        elif moment is Moment.WALL_CLOCK_BACK:
            _set_wall_clock_back()

    def _is_over(self) -> bool:
        return self._stopping or self._clock.now_ns() >= self._plan.until_ns

    def _pressed(self) -> bool:
        before_ns, self._asked_ns = self._asked_ns, self._clock.now_ns()
        press_ns = self._plan.press_ns
        return press_ns is not None and before_ns < press_ns <= self._asked_ns

    def _reopen(self) -> FaultySource:
        if self._plan.begin_ns <= self._clock.now_ns() < self._plan.end_ns:
            raise SourceError("camera: still gone")
        return self._source

    def _shown_ns(self, servo: PulseTable) -> int | None:
        """When the car began not to turn as it is steered, where it then went on so for a while."""
        pins, place, since_ns = self._pins.pins, 0, None
        for scene in self._scenes:
            while place + 1 < len(pins) and pins[place + 1][0] <= scene.t_ns:
                place += 1
            told = scene.car.speed_mps * math.tan(servo.value(pins[place][1])) / self._car.vehicle.wheelbase_m
            apart = abs(scene.car.yaw_rate_radps - told) > _SHOWN_RADPS + _SHOWN_SHARE * abs(told)
            if not apart or scene.t_ns < self._plan.begin_ns:
                since_ns = None
            elif since_ns is None:
                since_ns = scene.t_ns
            elif scene.t_ns - since_ns >= _SHOWN_NS:
                return since_ns
        return None

    def _motor(self) -> PulseTable:
        motor = self._car.link.motor
        return PulseTable(motor.pulse_us, motor.speed_mps)


def run_fault(car: CarConfig, pipeline: str, fault: Fault, seed: int, index: int) -> Verdict:
    """The verdict on the fault's run number `index`."""
    plan = draw_plan(fault, seed, index, LOOKS)
    car = dataclasses.replace(car, control=dataclasses.replace(car.control, speed_mps=plan.speed_mps))
    seen = FaultRig(car, pipeline, plan, fault.hooks(plan.hooks_random(), plan.end_ns)).run()
    without = FaultRig(car, pipeline, plan, Hooks()).run() if fault.the_same else None
    return judge(fault, plan, seen, without)


def _set_wall_clock_back() -> None:
    """Whoever asks for the wall clock's time from now on is told an hour less."""
    for name, hour in _WALL_CLOCKS.items():
        setattr(time, name, functools.partial(_earlier, getattr(time, name), hour))


def _earlier(clock: Callable[[], float], by: float) -> float:
    return clock() - by


@contextlib.contextmanager
def _wall_clock_kept() -> Iterator[None]:
    """The wall clock is right again afterwards."""
    kept = {name: getattr(time, name) for name in _WALL_CLOCKS}
    try:
        yield
    finally:
        for name, function in kept.items():
            setattr(time, name, function)
