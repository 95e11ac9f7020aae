"""A run of the full-size car on its CAN bus with a fault built in, by the true lane: no image shows what a bus does.

What is the motor's pin to `judge` is here whether the car is commanded: as the vehicle sees it, or as the host does.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib.resources
import itertools
from random import Random

from automodel.assembly.can_parts import can_functions
from automodel.assembly.links import can_link
from automodel.assembly.parts import build_run, make_loop, run_config
from automodel.assembly.simulated_car import LATENCY_NS
from automodel.bench.faults.fault import Fault, Hooks
from automodel.bench.faults.faulty_parts import Person, approach_images, driven, outside_m
from automodel.bench.faults.judge import Observed, Pin, Plan, Verdict, judge
from automodel.config import CarConfig, parse_car
from automodel.runtime.clocks import VirtualClock
from automodel.runtime.input_checks import InputChecks
from automodel.runtime.runner import Runner
from automodel.sim.full_size import FullSizeConfig, FullSizePlant
from automodel.sim.sources import LockStepSource
from automodel.sim.track import Lane
from automodel.sim.track_files import load_track
from automodel.sim.truth import TruthFollower
from automodel.sim.world import FullSizeWorld, Scene, TrueLane
from automodel.types import Image
from firmware_link.can_limits import (
    ACCEL_JERK_MAX_MPS3,
    BANK_TOLERANCE_MPS2,
    DT_MAX_S,
    LATERAL_ACCEL_MAX_MPS2,
    LATERAL_JERK_MAX_MPS3,
    lateral_accel_mps2,
)
from firmware_link.can_port import Received
from firmware_link.can_receiver import load_dbc
from firmware_link.emulator.can_vehicle import Driver, EmulatedCanVehicle, MemoryCanPort, Misbehaviour

TRACK = "ring"
SPEED_MPS = (5.0, 15.0)
_RESOLUTION = 0.05  # of the bounds: the wire's steps of angle and acceleration, and the speed a few ms before
_AFTER_S = 0.3  # the bus is watched for so long after the program has ended


@functools.lru_cache
def full_size_car() -> CarConfig:
    """The car of `automodel init full-size`."""
    kit = importlib.resources.files("automodel") / "cli" / "kits" / "full-size.toml"
    return parse_car(kit.read_text(encoding="utf-8"), "full-size.toml")


@functools.lru_cache
def _lane() -> Lane:
    return load_track(TRACK).lane()


class _Camera:
    """Images that differ, without a road: nobody looks for one in them."""

    def __init__(self, car: CarConfig) -> None:
        self._images = approach_images(car.camera.height_px, car.camera.width_px)

    def render(
        self, x_m: float, y_m: float, yaw_rad: float, speed_mps: float, yaw_rate_radps: float, index: int
    ) -> Image:
        """The next one."""
        return self._images[index % len(self._images)]


class _Ear:
    """A port that notes when the first frame of some messages came after a time."""

    def __init__(self, port: MemoryCanPort, frame_ids: frozenset[int], from_ns: int) -> None:
        self.place, self.open, self.send, self.close = port.place, port.open, port.send, port.close
        self._port, self._frame_ids, self._from_ns = port, frame_ids, from_ns
        self.first_ns: int | None = None

    def receive(self, now_ns: int) -> Received:
        """What has come."""
        received = self._port.receive(now_ns)
        times = (f.t_ns for f in received.frames if f.frame_id in self._frame_ids and f.t_ns > self._from_ns)
        self.first_ns = next(times, None) if self.first_ns is None else self.first_ns
        return received


class CanRig:
    """All parts of one run."""

    def __init__(self, plan: Plan, hooks: Hooks, fault: Fault) -> None:
        car, lane = full_size_car(), _lane()
        self._plan, self._hooks, self._by_host = plan, hooks, bool(fault.shown_by)
        speed_mps = Random(f"{plan.seed}/speed").uniform(*SPEED_MPS)
        self._car = dataclasses.replace(car, control=dataclasses.replace(car.control, speed_mps=speed_mps))
        s_m = plan.place * lane.centerline.length_m
        start, bend_per_m = lane.pose(s_m, plan.offset_m), float(lane.centerline.curvature(s_m))
        follower = TruthFollower(lane, car.vehicle.reference_x_m)
        true = FullSizeConfig(wheelbase_m=car.vehicle.wheelbase_m, cg_to_front_m=0.47 * car.vehicle.wheelbase_m)
        plant = FullSizePlant(true, start, start_mps=speed_mps, start_curvature_per_m=bend_per_m)
        self._world = FullSizeWorld(plant, _Camera(car), follower, lambda s: follower.lateral_reach_m(s, car.vehicle))
        config = car.link.can
        database = load_dbc(config.dbc)
        random = Random(f"{plan.seed}/phases")
        phases_ns = {message.name: round(random.uniform(0.0, message.period_s) * 1e9) for message in config.receive}
        self._vehicle = EmulatedCanVehicle(self._world, database, config, can_functions(config), phases_ns)
        self._truth, self._scenes = TrueLane(lane), list[Scene]()
        self._faulty: bool | None = None  # None before the fault, False after it
        self._clock = VirtualClock(0, self._advance)
        shown = frozenset(database.get_message_by_name(name).frame_id for name in fault.shown_by)
        self._ear = _Ear(MemoryCanPort(self._vehicle, self._clock), shown, plan.start_ns)
        self._person = Person(plan, self._clock)
        self._source = LockStepSource(self._world, self._clock, car.camera.rate_hz, LATENCY_NS, self._on_scene)

    def run(self) -> Observed:
        """Drive; raises Interrupted when a signal came."""
        car = self._car
        parts = build_run(
            car,
            source=self._source,
            link=can_link(car, self._ear),
            clock=self._clock,
            loop=make_loop(car, pipeline=self._truth, checks=InputChecks(car)),
        )
        runner = Runner(parts, run_config(car, collector_off=False), arm_requested=self._person.pressed)
        events, error = driven(runner, lambda: self._clock.now_ns() >= self._plan.until_ns)
        self._clock.sleep(_AFTER_S)
        outside = [outside_m(scene) for scene in self._scenes if scene.t_ns >= self._plan.start_ns]
        return Observed(
            pins=self._host_pins() if self._by_host else self._vehicle_pins(),
            events=events,
            left_m=max([0.0, *outside]),
            rolled_m=0.0,
            shown_ns=self._ear.first_ns if self._by_host else self._plan.start_ns,
            error=error,
            neutral_us=0.0,
            straight_us=0.0,
            limits_us=(0.0, 0.0, 0.0, 1.0),
            actuator="the car",
            rest="disengaged",
            also=tuple(self._beyond()),
        )

    def _advance(self, t_ns: int) -> None:
        for moment_ns, faulty in ((self._plan.start_ns, True), (self._plan.end_ns, False)):
            if moment_ns <= t_ns and self._faulty is (None if faulty else True):
                self._vehicle.advance(moment_ns)
                self._faulty = faulty
                self._vehicle.wrong, self._vehicle.driver = Misbehaviour(), Driver()
                if faulty and self._hooks.can is not None:
                    self._hooks.can(self._vehicle)
        self._vehicle.advance(t_ns)
        self._world.settle(t_ns)

    def _on_scene(self, scene: Scene) -> None:
        self._scenes.append(scene)
        self._truth.on_scene(scene)

    def _vehicle_pins(self) -> list[Pin]:
        return [(t_ns, 0.0, float(engaged)) for t_ns, engaged in self._vehicle.engagements]

    def _host_pins(self) -> list[Pin]:
        return [(t_ns, 0.0, told["enable"]) for t_ns, told in self._vehicle.accepted]

    def _beyond(self) -> list[str]:
        """Which of the limits a command on the wire exceeded; none may, whatever is wrong."""
        car, config, found = self._car, self._car.link.can, dict[str, None]()
        times = [scene.t_ns for scene in self._scenes]
        speeds = [scene.car.speed_mps for scene in self._scenes]
        commands = [(t_ns, told) for t_ns, told in self._vehicle.accepted if told["enable"]]
        place = 0
        for (before_ns, before), (t_ns, told) in itertools.pairwise(commands):
            while place + 1 < len(times) and times[place + 1] <= t_ns:
                place += 1
            dt_s = (t_ns - before_ns) * 1e-9
            if dt_s > DT_MAX_S:
                continue  # it was disengaged in between
            speed, wheelbase = speeds[place], car.vehicle.wheelbase_m
            lateral, lateral_before = (
                lateral_accel_mps2(each["steering_rad"], speed, wheelbase) for each in (told, before)
            )
            checks = {
                "lateral acceleration": abs(lateral) - (LATERAL_ACCEL_MAX_MPS2 - BANK_TOLERANCE_MPS2),
                "lateral jerk": abs(lateral - lateral_before) - LATERAL_JERK_MAX_MPS3 * DT_MAX_S,
                "acceleration": told["accel_mps2"] - config.accel_max_mps2,
                "deceleration": -told["accel_mps2"] - config.decel_max_mps2,
                "jerk": abs(told["accel_mps2"] - before["accel_mps2"]) - ACCEL_JERK_MAX_MPS3 * DT_MAX_S,
            }
            found.update(dict.fromkeys(name for name, over in checks.items() if not over <= _RESOLUTION))
        return [f"a command beyond the limit of the {name} was on the bus" for name in found]


def run_can_fault(fault: Fault, plan: Plan) -> Verdict:
    """The verdict on one run of a fault of the bus."""
    return judge(fault, plan, CanRig(plan, fault.hooks(plan.hooks_random(), plan.end_ns), fault).run())
