"""Drives a car along a plan of pulses and speeds, to calibrate it.

Runner, safety machine, limits and link are those of every run. Only the pipeline is replaced, by a straight lane that
is always seen, and the controller, by one that follows the plan.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from automodel.config import CarConfig
from automodel.console.messages import EventPrinter, say
from automodel.control.limits import Limits
from automodel.control.longitudinal import ObstacleGuard
from automodel.curves import line
from automodel.interfaces import Controller, VehicleLink
from automodel.runtime.clocks import NS_PER_S, SleepingClock
from automodel.runtime.loop import Loop
from automodel.runtime.run_types import RunConfig, RunEnd, RunParts, TickRecord
from automodel.runtime.runner import Runner
from automodel.runtime.safety import SafetyMode
from automodel.signals import Command, Frame, LaneEstimate, LanePose, LaneStatus, Motion, VehicleState
from automodel.sim.plant import Plant, PlantConfig
from automodel.types import Image
from firmware_link.transport import LoggedTransport

STAND_S = 2.0  # standstill at both ends of a servo drive: the gyro's bias is its median there
HOLD_S = 0.9  # at each pulse of a sweep: the wheels settle in 0.4 s
_STEPS = (0.6, -0.6, 0.3, -0.3, 0.6, 0.0, -0.6, 0.6, -0.3, 0.6, -0.6, 0.3)  # shares of the distance to the end
_STEP_S = 0.66
PERIOD_S = 0.02  # of a run without a camera
QUIET = frozenset({"end"})
_ARMING_S = 9.0  # a board that arms by itself takes less: its start, its hello and the arming
_HEADING_GAIN = 1.5  # [rad of steering per rad of heading] where a drive must go straight


@dataclass(frozen=True, slots=True, kw_only=True)
class Leg:
    """A part of a drive: for `duration_s` the steering is at `steering` and the motor at `speed_mps`."""

    duration_s: float
    steering: float  # in the plan's own units: a pulse [us], or an angle [rad]
    speed_mps: float


class DrivePlan:
    """Legs one after the other, from the drive's time 0 on; raises ValueError without legs."""

    def __init__(self, legs: tuple[Leg, ...]) -> None:
        if not legs or not all(leg.duration_s > 0 for leg in legs):
            raise ValueError("legs: expected at least one, each longer than 0 s")
        self.legs = legs
        self._ends_s = np.cumsum([leg.duration_s for leg in legs]).tolist()

    @property
    def duration_s(self) -> float:
        """How long the drive takes [s]."""
        return float(self._ends_s[-1])

    def at(self, t_s: float) -> Leg | None:
        """The leg at `t_s`; None when the drive is over."""
        i = bisect_right(self._ends_s, t_s)
        return self.legs[i] if i < len(self.legs) else None


def servo_plan(low_us: float, high_us: float, speed_mps: float, levels: int = 13) -> DrivePlan:
    """The drive that measures a servo: two sweeps up and down, the second between the pulses of the first, then steps.

    Every pulse but the two ends is reached from both sides, in steps of (high - low) / (levels - 1), which must be
    larger than the play.
    """
    if not high_us > low_us or levels < 5:
        raise ValueError(f"low_us, high_us, levels: {low_us}, {high_us}, {levels} give no sweep")
    coarse = np.linspace(low_us, high_us, levels)
    between = 0.5 * (coarse[:-1] + coarse[1:])
    middle, half = 0.5 * (low_us + high_us), 0.5 * (high_us - low_us)
    sweeps = (middle, *coarse, *between[::-1], low_us, *between, *coarse[::-1])
    legs = [Leg(duration_s=STAND_S, steering=middle, speed_mps=0.0)]
    legs += [Leg(duration_s=HOLD_S, steering=float(pulse), speed_mps=speed_mps) for pulse in sweeps]
    legs += [Leg(duration_s=_STEP_S, steering=middle + share * half, speed_mps=speed_mps) for share in _STEPS]
    legs.append(Leg(duration_s=STAND_S, steering=middle, speed_mps=0.0))
    return DrivePlan(tuple(legs))


def straight_plan(distance_m: float, speed_mps: float) -> DrivePlan:
    """A drive straight ahead over `distance_m` at one speed, with a standstill before and after it.

    It lasts half as long again as it should take, for a car that is slower than commanded.
    """
    if not (distance_m > 0 and speed_mps > 0):
        raise ValueError(f"distance_m, speed_mps: expected positive numbers, got {distance_m}, {speed_mps}")
    return DrivePlan(
        (
            Leg(duration_s=1.0, steering=0.0, speed_mps=0.0),
            Leg(duration_s=1.5 * distance_m / speed_mps + 0.5, steering=0.0, speed_mps=speed_mps),
            Leg(duration_s=1.5, steering=0.0, speed_mps=0.0),
        )
    )


class DriveEnded(Exception):
    """The drive ended before its plan did; the text says why. The car stands in neutral."""


def nobody() -> bool:
    """The key of a car without a person: never pressed."""
    return False


class Ticks:
    """Implements `Source` without a camera: one frame each period, blank or what `picture` gives for its time [ns]."""

    def __init__(
        self, clock: SleepingClock, picture: Callable[[int], Image] | None = None, period_s: float = PERIOD_S
    ) -> None:
        self._clock, self._period_ns = clock, round(period_s * NS_PER_S)
        self._start_ns, self._index = clock.now_ns(), 0
        blank = np.zeros((1, 1), dtype=np.uint8)
        self._picture = picture or (lambda t_ns: blank)

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame, None when it is not due within `timeout_s`; late frames are skipped."""
        now_ns = self._clock.now_ns()
        index = max(self._index + 1, (now_ns - self._start_ns) // self._period_ns)
        wait_s = (self._start_ns + index * self._period_ns - now_ns) / NS_PER_S
        if wait_s > timeout_s:
            self._clock.sleep(timeout_s)
            return None
        self._clock.sleep(max(wait_s, 0.0))
        self._index = index
        t_ns = self._clock.now_ns()
        return Frame(t_ns=t_ns, index=index, image=self._picture(t_ns))

    def close(self) -> None:
        """Nothing to release."""


class NoLane:
    """Implements `Pipeline`: a straight lane, whatever the image shows; `look` gets every frame."""

    name = "no lane"

    def __init__(self, look: Callable[[Frame], None] | None = None) -> None:
        self._look = look
        self._ahead = line(0.0, 0.0, 0.0, 1.0)
        self._pose = LanePose(
            offset_m=0.0, heading_rad=0.0, width_m=1.0, curvature_per_m=0.0, covariance=np.zeros((3, 3))
        )

    def step(self, frame: Frame, motion: Motion) -> LaneEstimate:
        """Straight ahead."""
        if self._look is not None:
            self._look(frame)
        return LaneEstimate(t_ns=frame.t_ns, status=LaneStatus.TRACKING, centerline=self._ahead, pose=self._pose)

    def reset(self) -> None:
        """No state."""


class PlanFollower:
    """Implements `Controller`: the legs of a plan, from the moment when the car is armed.

    `steering_of` turns a leg's steering into an angle [rad]. With `straight` the gyro holds the heading, too.
    `far_enough` ends a moving leg early and starts the last leg, the standstill. `why` is the reason when the drive
    ended early: an obstacle within `[control] obstacle_stop_m`, or the text that `check` returned.
    """

    def __init__(
        self,
        plan: DrivePlan,
        car: CarConfig,
        steering_of: Callable[[float], float],
        *,
        straight: bool = False,
        far_enough: Callable[[], bool] = lambda: False,
        check: Callable[[VehicleState], str | None] = lambda state: None,
    ) -> None:
        self._plan, self._steering_of = plan, steering_of
        self._straight, self._check, self._far_enough = straight, check, far_enough
        self._validity_ns = round(car.safety.command_validity_s * NS_PER_S)
        self._skipped_s = 0.0
        self._guard = ObstacleGuard(car.control.obstacle_stop_m, car.control.obstacle_go_m)
        self._started_ns: int | None = None
        self._heading_rad, self._before_ns = 0.0, 0
        self.over = False
        self.why: str | None = None

    def step(self, estimate: LaneEstimate, motion: Motion, state: VehicleState | None, t_ns: int) -> Command:
        """The command of the current leg; a standstill before the car is armed and after the plan."""
        self._guard.step(state, t_ns)
        if self._guard.blocked:
            self._end(f"something is {self._guard.range_m:.2f} m ahead; make room, or see [control] obstacle_stop_m")
        if state is not None and state.armed:
            if self._started_ns is None:
                self._started_ns = self._before_ns = t_ns
            self._end(self._check(state))
        leg = None
        if self._started_ns is not None and not self.over:
            leg = self._leg((t_ns - self._started_ns) / NS_PER_S)
            self.over = leg is None
        steering = 0.0 if leg is None else self._steering_of(leg.steering)
        if self._straight and leg is not None:
            self._heading_rad += motion.yaw_rate_radps * (t_ns - self._before_ns) / NS_PER_S
            steering -= _HEADING_GAIN * self._heading_rad
        self._before_ns = t_ns
        speed = 0.0 if leg is None else leg.speed_mps
        return Command(t_ns=t_ns, steering_rad=steering, speed_mps=speed, valid_until_ns=t_ns + self._validity_ns)

    def _leg(self, t_s: float) -> Leg | None:
        leg = self._plan.at(t_s + self._skipped_s)
        if leg is not None and leg.speed_mps != 0.0 and self._far_enough():
            self._skipped_s = self._plan.duration_s - self._plan.legs[-1].duration_s - t_s
            leg = self._plan.legs[-1]
        return leg

    def _end(self, why: str | None) -> None:
        if why is not None and not self.over:
            self.over, self.why = True, why

    def reset(self) -> None:
        """Keeps its place: the plan goes on after a hold."""


class StopWatch:
    """Observes a run: whether the car drove, and `why` it was stopped then; `on_record` gets every tick."""

    def __init__(self, on_record: Callable[[TickRecord], None] | None = None) -> None:
        self.drove = False
        self.why: str | None = None
        self._on_record = on_record

    def on_tick(self, record: TickRecord) -> None:
        """One tick of the run."""
        mode = record.decision.mode
        self.drove = self.drove or mode is SafetyMode.DRIVING
        if self.drove and mode is SafetyMode.STOPPED and self.why is None:
            self.why = next((e.text for e in record.decision.events if e.kind == "stop"), "the car was stopped")
        if self._on_record is not None:
            self._on_record(record)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rig:
    """A car to be calibrated, as the command put it together.

    `run_parts` makes the parts of a run around a loop. `auto_arm`: the car arms by itself. `board` keeps the pulses,
    ticks and yaw rates that the board reports. `plant` is the simulated car, None for a real one.
    """

    car: CarConfig
    link: VehicleLink
    clock: SleepingClock
    auto_arm: bool
    board: LoggedTransport
    plant: Plant | None
    run_parts: Callable[[Loop], RunParts]


class RigMaker(Protocol):
    """Opens the car to be calibrated, or a simulated one."""

    def __call__(
        self, car: CarConfig, *, plant: PlantConfig | None = None, camera: bool = False, auto_arm: bool = False
    ) -> AbstractContextManager[Rig]:
        """The car at the port of car.toml, or with `plant` a simulated one in virtual time; raises OSError.

        Without `camera` the rig has no images.
        """
        ...


def plant_of(car: CarConfig, seed: int, gyro: bool = True) -> PlantConfig:
    """The simulated car as car.toml describes it."""
    vehicle = car.vehicle
    return PlantConfig(wheelbase_m=vehicle.wheelbase_m, ticks_per_m=vehicle.ticks_per_m, seed=seed, gyro=gyro)


def follow_plan(
    rig: Rig, follower: PlanFollower, pressed: Callable[[], bool], *, look: Callable[[Frame], None] | None = None
) -> None:
    """Drive the plan to its end; raises DriveEnded where the drive ended early, OSError without a vehicle.

    `pressed` returns True once for each press of the key: it arms before the drive and stops during it.
    """
    watch = StopWatch()
    asked: list[str] = []
    start_ns = rig.clock.now_ns()

    def arm() -> bool:
        if not pressed():
            return False
        if watch.drove:
            asked.append("stopped by key")
        return not watch.drove

    def stop() -> bool:
        if rig.auto_arm and not watch.drove and rig.clock.now_ns() - start_ns > _ARMING_S * NS_PER_S:
            asked.append("the vehicle did not arm")
        return follower.over or watch.why is not None or bool(asked)

    run_chain(rig, follower, arm=arm, stop=stop, watch=watch, look=look)
    why = follower.why or watch.why or (asked[0] if asked else None)
    if why is not None:
        raise DriveEnded(why)


def run_chain(
    rig: Rig,
    controller: Controller,
    *,
    arm: Callable[[], bool],
    stop: Callable[[], bool],
    watch: StopWatch | None = None,
    look: Callable[[Frame], None] | None = None,
) -> None:
    """Run the car with a controller until `stop`; raises DriveEnded for a signal or where something failed."""
    safety = rig.car.safety
    limits = Limits(safety, rig.car.vehicle)
    loop = Loop(NoLane(look), controller, limits, validity_s=safety.command_validity_s)
    config = RunConfig(command_validity_s=safety.command_validity_s, period_s=PERIOD_S, collector_off=False)
    quiet = QUIET | ({"arming", "driving"} if rig.auto_arm else set())
    teller = EventPrinter(rig.clock, frozenset(quiet))
    result = Runner(rig.run_parts(loop), config, observer=watch, arm_requested=arm, on_event=teller).run(stop=stop)
    if result.traceback is not None:
        say(result.traceback.rstrip())
    if result.end is RunEnd.SIGNAL:
        raise DriveEnded(f"stopped by {result.events[-1].text}")
    if result.end is not RunEnd.STOP:
        raise DriveEnded(result.end.value)
