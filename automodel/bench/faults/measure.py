"""`bench faults`: drives of the simulated car with a fault built in, each judged; in parallel.

Track -> camera -> pipeline -> control -> bytes -> board -> car. To save time a run starts at rest with the true lane
for an estimate and images without a road; camera and pipeline take over when the car drives steadily, before the fault.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from automodel.assembly.parts import build_run, make_checks, make_loop, make_pipeline, run_config
from automodel.assembly.simulated_car import LATENCY_NS, renderer
from automodel.bench.accuracy import Row
from automodel.bench.faults.can_rig import run_can_fault
from automodel.bench.faults.catalogue import CAN, chosen
from automodel.bench.faults.fault import At, Fault, Hooks, Moment
from automodel.bench.faults.faulty_parts import (
    FaultyPeripherals,
    FaultyPipeline,
    FaultySource,
    Person,
    Staller,
    approach_images,
    driven,
    faulty_recorder,
    outside_m,
    set_wall_clock_back,
    wall_clock_kept,
)
from automodel.bench.faults.judge import (
    REARM_S,
    Observed,
    Pin,
    Plan,
    Verdict,
    at_another_place,
    draw_plan,
    drives_from,
    judge,
)
from automodel.config import CameraConfig, CarConfig, Intrinsics, LaneConfig, SecondCamera
from automodel.config.parts import PAIR_PIPELINES
from automodel.console.messages import say
from automodel.console.workers import Sweep, Tick, spread
from automodel.interfaces import Recorder
from automodel.runtime.clocks import NS_PER_S, VirtualClock
from automodel.runtime.run_types import TickRecord
from automodel.runtime.runner import Runner
from automodel.signals import Motion
from automodel.sim.appearance import Appearance
from automodel.sim.plant import Plant, PlantConfig, Slip
from automodel.sim.renderer import Renderer
from automodel.sim.sources import LockStepSource, frame_of
from automodel.sim.track import Lane, Track
from automodel.sim.track_files import load_track
from automodel.sim.truth import TruthFollower
from automodel.sim.world import EyePair, Scene, TrueLane, World
from automodel.sources.errors import SourceError
from automodel.types import Image
from firmware_link.arduino import ArduinoLink
from firmware_link.emulator.avr import AvrBoard, AvrProgram, build_avr
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.emulator.faulty_board import FaultyBoard
from firmware_link.emulator.logic import BoardOptions
from firmware_link.messages import TABLE_HASH
from firmware_link.pulses import PulseTable
from firmware_link.transport import MemoryTransport

# Half the usual image in each direction, of the same view: enough to see the lane, and cheap to render. Somebody has
# measured the lanes.
CAR = CarConfig(
    lane=LaneConfig(width_sigma_m=0.005),
    camera=CameraConfig(
        width_px=320, height_px=180, intrinsics=Intrinsics(fx_px=240.0, fy_px=240.0, cx_px=159.5, cy_px=89.5)
    ),
)
EYE_Y_M = 0.125  # of a pair's left camera; the right one is as far to the right
LOOKS = 4
STYLES = ("competition", "varied")  # of random looks
TRUTH = "truth"  # the pipeline that reads it
COLUMNS = ("fault", "runs", "violations", "reaction_p50_ms", "reaction_max_ms", "left_lane", "left_max_m", "moved")
AFTER_S = 0.3  # the pins are watched for so long after the program has ended
STANDSTILL_S = 3.0  # and the car until it stands, and its wheels are straight
PLACES = 32  # on `oval` a pipeline is sure at half of them, so soon after its first image
OTHER_BOOT_ID = 4096  # of another board
_SHOWN_RADPS, _SHOWN_SHARE, _SHOWN_NS = 0.6, 0.5, 300_000_000  # a yaw rate wrong by so much, for so long


@functools.lru_cache
def _track(name: str) -> Track:
    return load_track(name)


@functools.lru_cache
def _lane(name: str) -> Lane:
    return _track(name).lane()


def car_of(pipeline: str) -> CarConfig:
    """The car for a pipeline: with two cameras where it needs a pair."""
    if pipeline not in PAIR_PIPELINES:
        return CAR
    left, right = (dataclasses.replace(CAR.camera.extrinsics, y_m=y_m) for y_m in (EYE_Y_M, -EYE_Y_M))
    second = SecondCamera(intrinsics=CAR.camera.intrinsics, extrinsics=right)
    return dataclasses.replace(CAR, camera=dataclasses.replace(CAR.camera, extrinsics=left, right=second))


@functools.lru_cache(maxsize=8)
def _renderer(camera: CameraConfig, track: str, look: int, eye: int) -> Renderer:
    """A plain floor, cheap to render, of the looks below `LOOKS`; a random one of the others.

    Sensor noise makes every image different, and that of each eye.
    """
    grey, seed = 30.0 + 20.0 * look, look + LOOKS * eye
    floor = Appearance(floor_grey=grey, marking_grey=grey + 120.0, vignetting=0.2, read_noise=2.0, noise_seed=seed)
    if look >= LOOKS:
        floor = dataclasses.replace(Appearance.random(look, style=STYLES[look % len(STYLES)]), noise_seed=seed)
    return renderer(_track(track), CarConfig(camera=camera), floor)


class RoadCamera:
    """A camera, number `eye` of a pair, that shows the road from frame `first` on; never where it is None."""

    def __init__(self, camera: CameraConfig, plan: Plan, first: int | None, eye: int = 0) -> None:
        self._renderer = None if first is None else _renderer(camera, plan.track, plan.look, eye)
        self._first, self._eye = first, eye
        self._approach = approach_images(camera.height_px, camera.width_px)

    def render(
        self, x_m: float, y_m: float, yaw_rad: float, speed_mps: float, yaw_rate_radps: float, index: int
    ) -> Image:
        """An image of the road, or one without."""
        if self._renderer is None or self._first is None or index < self._first:
            return self._approach[(index + self._eye) % len(self._approach)]
        return self._renderer.render(x_m, y_m, yaw_rad, speed_mps, yaw_rate_radps, index)


class FaultRig:
    """All parts of one run."""

    def __init__(
        self, car: CarConfig, pipeline: str, plan: Plan, hooks: Hooks, program: AvrProgram | None = None
    ) -> None:
        self._car, self._plan, self._hooks, self._program = car, plan, hooks, program
        self._scenes: list[Scene] = []
        self._simulated: AvrBoard | None = None
        self._stopping = False
        by_truth = pipeline == TRUTH
        self._first = math.ceil(plan.rendered_ns * 1e-9 * car.camera.rate_hz)  # the first image that shows the road
        self._build_world(None if by_truth else self._first)
        self._clock = VirtualClock(0, self._advance)
        self._person = Person(plan, self._clock)
        self._staller = Staller(hooks.stall, plan, self._clock)
        self._transport = MemoryTransport(self._line, self._clock)
        for after_s, moment in hooks.moments:
            self._line.at(plan.start_ns + round(after_s * 1e9), functools.partial(self._happen, moment))
        self._estimator = None if by_truth else make_pipeline(pipeline, car)
        self._pipeline = FaultyPipeline(self._truth.step, self._estimator, hooks.lane, plan, self._staller, car.vehicle)
        lock_step = LockStepSource(self._world, self._clock, car.camera.rate_hz, LATENCY_NS, self._on_scene)
        self._source = FaultySource(lock_step, hooks, plan, self._clock, self._staller)

    def run(self) -> Observed:
        """Drive; raises Interrupted when a signal came."""
        try:
            return self._observed()
        finally:
            if self._simulated is not None:
                self._simulated.close()

    def _observed(self) -> Observed:
        with faulty_recorder(self._hooks.disk, self._plan, self._clock) as recorder, wall_clock_kept():
            runner = self._runner(recorder)
            events, error = driven(runner, self._is_over)
        self._clock.sleep(AFTER_S)
        rolled_m = self._roll_out()
        link = self._car.link
        servo, motor = PulseTable(link.servo.pulse_us, link.servo.steering_rad), self._motor()
        # without limits, or while it starts, a board gives no pulses: the car rests
        pins = [
            (t_ns, servo_us or servo.zero_us, motor_us or motor.zero_us) for t_ns, servo_us, motor_us in self._pins.pins
        ]
        return Observed(
            pins=pins,
            events=events,
            left_m=max([0.0, *(outside_m(scene) for scene in self._scenes if scene.t_ns >= self._plan.start_ns)]),
            rolled_m=rolled_m,
            shown_ns=self._shown_ns(servo),
            error=error,
            knows=self._pipeline.knows,
            could_start=self._could_start(pins, motor.zero_us),
            neutral_us=motor.zero_us,
            straight_us=servo.zero_us,
            errors_m=self._errors_m(),
            limits_us=(servo.min_us, servo.max_us, motor.min_us, motor.max_us),
        )

    def _errors_m(self) -> list[tuple[int, float]]:
        """By how much [m] the offset that the car drove by was wrong, by the frame's time [ns]."""
        true_m = {scene.t_ns: scene.truth.offset_m for scene in self._scenes}
        found = [(t_ns, abs(offset_m - true_m[t_ns])) for t_ns, offset_m in self._pipeline.offsets_m if t_ns in true_m]
        return [(t_ns, error_m if math.isfinite(error_m) else math.inf) for t_ns, error_m in found]

    def on_tick(self, record: TickRecord) -> None:
        """Called after each turn of the runner, which this observes."""
        self._staller(At.AFTER)

    def _build_world(self, first: int | None) -> None:
        car, plan = self._car, self._plan
        lane = _lane(plan.track)
        start = lane.pose(plan.place * lane.centerline.length_m, plan.offset_m)
        follower = TruthFollower(lane, car.vehicle.reference_x_m)
        vehicle = car.vehicle
        true = PlantConfig(
            wheelbase_m=vehicle.wheelbase_m,
            ticks_per_m=vehicle.ticks_per_m,
            coast_mps2=plan.speed_mps / plan.coast_s,
            slip=self._slip(),
            seed=plan.look,
        )
        eyes = car.camera.eyes if self._hooks.rig is None else self._hooks.rig(car.camera.eyes)
        cameras = [RoadCamera(camera, plan, first, eye) for eye, camera in enumerate(eyes)]
        self._world = World(
            Plant(true, start),
            EyePair(*cameras) if len(cameras) > 1 else cameras[0],
            follower,
            lambda state: follower.lateral_reach_m(state, vehicle),
        )
        self._truth = TrueLane(lane)
        self._pins = FaultyPeripherals(self._world, self._hooks, plan)
        self._line = FaultyBoard(
            self._board(),
            plan.start_ns,
            plan.end_ns,
            to_board=self._hooks.to_board,
            from_board=self._hooks.from_board,
            pulses=self._hooks.pulses,
        )

    def _slip(self) -> Slip | None:
        grip, plan = self._hooks.slip, self._plan
        if grip is None:
            return None
        return Slip(
            start_s=plan.start_ns * 1e-9,
            end_s=plan.end_ns * 1e-9,
            share=grip.share,
            lateral_max_mps2=grip.lateral_max_mps2,
        )

    def _roll_out(self) -> float:
        """Wait until the car stands straight; how far its body is outside its lane then [m], 0 where it is inside."""
        self._clock.sleep(STANDSTILL_S)
        _, scene = self._world.capture(self._clock.now_ns(), 0)
        return outside_m(scene)

    def _could_start(self, pins: Sequence[Pin], neutral_us: float) -> bool:
        """Whether a pipeline that is started where the car stands knows a lane to be armed in.

        Looked at only where the car was not armed again: True otherwise.
        """
        press_ns, camera = self._plan.press_ns, self._car.camera
        asked = self._plan.drives_again and press_ns is not None and not drives_from(pins, press_ns, neutral_us)
        if not asked or self._estimator is None:
            return True
        anew, armable = make_pipeline(self._estimator.name, self._car), False
        for index in range(round(REARM_S * camera.rate_hz)):
            t_ns = self._clock.now_ns() + round(index * NS_PER_S / camera.rate_hz)
            image, scene = self._world.capture(t_ns, self._first + index)
            motion, step = Motion(t_ns=t_ns, speed_mps=0.0, yaw_rate_radps=0.0), anew.step
            frame: Any = frame_of(scene, image, pair=camera.right is not None)
            pose = step(frame, motion).pose
            armable = pose is not None and pose.offset_bound_m < 0.5 * pose.width_m
        return armable

    def _board(self) -> EmulatedArduino | AvrBoard:
        if self._program is None:
            return EmulatedArduino(self._pins, self._car.link.baud)
        self._simulated = AvrBoard(self._program, self._pins, self._car.link.baud)
        return self._simulated

    def _runner(self, recorder: Recorder | None) -> Runner:
        car = self._car
        parts = build_run(
            car,
            source=self._source,
            link=ArduinoLink(self._transport, car.link, car.vehicle),
            clock=self._clock,
            loop=make_loop(car, pipeline=self._pipeline, checks=make_checks(car)),
            recorder=recorder,
        )
        config = run_config(car, collector_off=False)
        return Runner(
            parts,
            config,
            observer=self,
            arm_requested=self._person.pressed,
            stop_requested=self._person.stop_asked,
            reopen=self._reopen,
        )

    def _advance(self, t_ns: int) -> None:
        self._line.advance(t_ns)
        self._world.settle(t_ns)

    def _on_scene(self, scene: Scene) -> None:
        self._scenes.append(scene)
        self._truth.on_scene(scene)

    def _happen(self, moment: Moment, t_ns: int) -> None:
        board = self._line.board
        assert isinstance(board, EmulatedArduino | AvrBoard)
        if moment is Moment.UNPLUG:
            self._transport.unplug()
        elif moment is Moment.REPLUG:
            self._transport.replug()
        elif moment is Moment.OTHER_FIRMWARE:
            other = BoardOptions(table_hash=TABLE_HASH ^ 1, boot_id=OTHER_BOOT_ID)
            self._line.board = EmulatedArduino(self._pins, self._car.link.baud, other)
        elif moment is Moment.BROWN_OUT:
            board.brown_out(t_ns)
        elif moment is Moment.HANG:
            board.hang(t_ns)
        elif moment is Moment.RESTART:
            board.reset(t_ns)
        elif moment is Moment.STOP_REQUEST:
            self._stopping = True
        elif moment is Moment.PERSON_STOPS:
            self._person.stop()
        elif moment is Moment.WALL_CLOCK_BACK:
            set_wall_clock_back()

    def _is_over(self) -> bool:
        now_ns = self._clock.now_ns()
        in_vain = now_ns > self._plan.start_ns and not self._pipeline.knows
        return self._stopping or in_vain or now_ns >= self._plan.until_ns

    def _reopen(self) -> FaultySource:
        if self._plan.start_ns <= self._clock.now_ns() < self._plan.end_ns:
            raise SourceError("camera: still gone")
        return self._source

    def _shown_ns(self, servo: PulseTable) -> int | None:
        """When the car's yaw rate began to differ from the steered one, if it then did so for a while."""
        pins, place, since_ns = self._pins.pins, 0, None
        for scene in self._scenes:
            while place + 1 < len(pins) and pins[place + 1][0] <= scene.t_ns:
                place += 1
            steered = scene.car.speed_mps * math.tan(servo.value(pins[place][1])) / self._car.vehicle.wheelbase_m
            differs = abs(scene.car.yaw_rate_radps - steered) > _SHOWN_RADPS + _SHOWN_SHARE * abs(steered)
            if not differs or scene.t_ns < self._plan.start_ns:
                since_ns = None
            elif since_ns is None:
                since_ns = scene.t_ns
            elif scene.t_ns - since_ns >= _SHOWN_NS:
                return since_ns
        return None

    def _motor(self) -> PulseTable:
        motor = self._car.link.motor
        return PulseTable(motor.pulse_us, motor.speed_mps)


def run_fault(
    car: CarConfig, pipeline: str, fault: Fault, seed: int, index: int, program: AvrProgram | None = None
) -> Verdict:
    """The verdict on the fault's run number `index`; behind `program` on its simulated chip, or the emulated board.

    A fault is built into the run of a car that knows its lane, as nobody could arm another one: where the pipeline is
    not sure of it (it comes upon the lane in the middle of a bend), the run starts elsewhere.
    """
    drawn = draw_plan(fault, seed, index, LOOKS)
    car = dataclasses.replace(car, control=dataclasses.replace(car.control, speed_mps=drawn.speed_mps))
    for attempt in range(PLACES):
        plan = at_another_place(drawn, attempt)
        seen = FaultRig(car, pipeline, plan, fault.built(plan.hooks_random, plan.end_ns), program).run()
        if seen.knows:
            without = FaultRig(car, pipeline, plan, Hooks(), program).run() if fault.same_pulses else None
            return dataclasses.replace(judge(fault, plan, seen, without), moved=attempt)
    return Verdict(violations=(f"the pipeline was sure of its lane at none of {PLACES} places",), reaction_s=None)


def judged(pipeline: str, fault: Fault, seed: int, index: int, program: AvrProgram | None = None) -> Verdict:
    """As `run_fault`, of the car that the pipeline needs; a fault of the bus is that of the full-size car."""
    if fault in CAN:
        return run_can_fault(fault, draw_plan(fault, seed, index, LOOKS))
    return run_fault(car_of(pipeline), pipeline, fault, seed, index, program)


@dataclasses.dataclass(frozen=True, slots=True)
class Case:
    """A run of one fault."""

    name: str
    index: int


def measure(
    names: Sequence[str], runs: int, seed: int, pipeline: str, sweep: Sweep, link: str = "arduino"
) -> list[Row]:
    """A row a fault, `runs` in all shared out evenly; runs with a violation are reported on stderr.

    `names` are the faults (default: those of `link`), `pipeline` may be `TRUTH`, `link` "arduino" (the emulated board),
    "avr" (the firmware on a simulated chip: wire and board) or "can" (the full-size car, which drives by the truth; so
    it does for each of its faults that `names` has). Raises ConfigError for an unknown fault, AvrMissing where the
    firmware cannot be built.
    """
    faults = chosen(names, images=pipeline != TRUTH, link=link, pairs=pipeline in PAIR_PIPELINES)
    cases = [Case(faults[number % len(faults)].name, number // len(faults)) for number in range(runs)]
    verdicts: dict[str, list[Verdict]] = {case.name: [] for case in cases}
    with tempfile.TemporaryDirectory(prefix="avr-") as folder:
        program = build_avr(Path(folder), CAR.link.baud) if link == "avr" else None
        found = spread("bench faults", functools.partial(_verdict, pipeline, seed, program), cases, sweep)
        for case, verdict in found:  # they come while the folder is there
            verdicts[case.name].append(verdict)
            if verdict.violations:
                say(f"{case.name}, run {case.index} of seed {seed}: {'; '.join(verdict.violations)}")
    moved = sum(verdict.moved for judged in verdicts.values() for verdict in judged)
    if moved:
        say(f"{moved} starts at a place where {pipeline} was not sure of its lane yet; those runs started elsewhere")
    return [_row(name, judged) for name, judged in verdicts.items() if judged]


def _verdict(pipeline: str, seed: int, program: AvrProgram | None, case: Case, tick: Tick) -> Verdict:
    (fault,) = chosen((case.name,))
    verdict = judged(pipeline, fault, seed, case.index, program)
    tick(1.0)
    return verdict


def reaction_row(name: str, runs: int, violations: int, reactions_s: Sequence[float | None]) -> Row:
    """The metrics that every lane has; a run without a reaction has None."""
    reactions_ms = [reaction_s * 1e3 for reaction_s in reactions_s if reaction_s is not None]
    return {
        "fault": name,
        "runs": runs,
        "violations": violations,
        "reaction_p50_ms": round(float(np.median(reactions_ms)), 3) if reactions_ms else None,
        "reaction_max_ms": round(max(reactions_ms), 3) if reactions_ms else None,
    }


def _row(name: str, verdicts: Sequence[Verdict]) -> Row:
    violations = sum(bool(verdict.violations) for verdict in verdicts)
    return {
        **reaction_row(name, len(verdicts), violations, [verdict.reaction_s for verdict in verdicts]),
        "left_lane": sum(verdict.left_m > 0 for verdict in verdicts),
        "left_max_m": round(max(verdict.left_m for verdict in verdicts), 3),
        "moved": sum(verdict.moved for verdict in verdicts),
    }
