"""Drives a car along a plan, to calibrate it: the runner, its safety machine, limits and link are those of a race.

There is no lane here: in its place stands a straight line that is always seen, and the controller follows the plan.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from automodel.config import CarConfig
from automodel.console.messages import EventTeller, say
from automodel.control.limits import Limits
from automodel.control.longitudinal import ObstacleGuard
from automodel.curves.theta import line
from automodel.estimation.ego_motion import MotionEstimator
from automodel.interfaces import Controller, Source, VehicleLink
from automodel.runtime.clocks import NS_PER_S, SleepingClock
from automodel.runtime.loop import Loop
from automodel.runtime.run_types import RunConfig, RunEnd, RunParts, TickRecord
from automodel.runtime.runner import Runner
from automodel.runtime.safety import Safety, SafetyMode
from automodel.signals import Command, Frame, LaneEstimate, LanePose, LaneStatus, Motion, VehicleState
from automodel.types import Image
from calibration.drive_plan import DrivePlan, Leg

PERIOD_S = 0.02  # of the turns where no camera gives the pace
QUIET = frozenset({"end"})
_PATIENCE_S = 9.0  # a board that is armed without asking has said hello and armed by then, or never will
_HEADING_GAIN = 1.5  # [rad of steering per rad of heading] on a drive that shall go straight


class DriveEnded(Exception):
    """The drive ended before its plan did; the text says why. The car stands in neutral."""


def nobody() -> bool:
    """Presses no key."""
    return False


class Ticks:
    """Implements `Source` where there is no camera: each period what `picture` shows at that time [ns], or nothing."""

    def __init__(
        self, clock: SleepingClock, picture: Callable[[int], Image] | None = None, period_s: float = PERIOD_S
    ) -> None:
        self._clock, self._period_ns = clock, round(period_s * NS_PER_S)
        self._start_ns, self._index = clock.now_ns(), 0
        nothing = np.zeros((1, 1), dtype=np.uint8)
        self._picture = picture or (lambda t_ns: nothing)

    def read(self, timeout_s: float) -> Frame | None:
        """The next one, None when it is not due within `timeout_s`; late ones are left out."""
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
        """Nothing to give back."""


class NoLane:
    """Implements `Pipeline`: a straight lane, whatever is seen; `look` is shown every frame."""

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
        """Nothing is remembered."""


class PlanFollower:
    """Implements `Controller`: the plan's legs from the moment when the car is armed.

    `steering_of` turns a leg's steering into an angle [rad]. With `straight` the heading is held by the gyro, too.
    `far_enough` ends the leg that drives early; the last one, a standstill, follows.
    `why` says what ended the drive early: something ahead within `[control] obstacle_stop_m`, or what `check` says.
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
        self._plan, self._car, self._steering_of = plan, car, steering_of
        self._straight, self._check, self._far_enough = straight, check, far_enough
        self._skipped_s = 0.0
        self._guard = ObstacleGuard(car.control.obstacle_stop_m, car.control.obstacle_go_m)
        self._started_ns: int | None = None
        self._heading_rad, self._before_ns = 0.0, 0
        self.over = False
        self.why: str | None = None

    def step(self, estimate: LaneEstimate, motion: Motion, state: VehicleState | None, t_ns: int) -> Command:
        """The leg's command; a standstill before the car is armed and after the plan."""
        self._guard.step(state, t_ns)
        if self._guard.blocked:
            self._end(f"something is {self._guard.range_m:.2f} m ahead; make room, or see [control] obstacle_stop_m")
        if state is not None and state.armed:
            if self._started_ns is None:
                self._started_ns = self._before_ns = t_ns
            self._end(self._check(state))
        validity_ns = round(self._car.safety.command_validity_s * NS_PER_S)
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
        return Command(t_ns=t_ns, steering_rad=steering, speed_mps=speed, valid_until_ns=t_ns + validity_ns)

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
        """Nothing: the plan goes on where it is, whatever was sent in its place."""


class Watch:
    """Notes whether the safety machine has stopped a car that drove, and why."""

    def __init__(self, tell: Callable[[TickRecord], None] | None) -> None:
        self.drove = False
        self.why: str | None = None
        self._tell = tell

    def on_tick(self, record: TickRecord) -> None:
        """One turn."""
        mode = record.decision.mode
        self.drove = self.drove or mode is SafetyMode.DRIVING
        if self.drove and mode is SafetyMode.STOPPED and self.why is None:
            self.why = next((e.text for e in record.decision.events if e.kind == "stop"), "the car was stopped")
        if self._tell is not None:
            self._tell(record)


@dataclass(frozen=True, slots=True, kw_only=True)
class Rig:
    """A car to be calibrated: its pictures, link and clock. `auto_arm` stands for a person's wish given before."""

    source: Source
    link: VehicleLink
    clock: SleepingClock
    auto_arm: bool


def follow_plan(
    rig: Rig,
    car: CarConfig,
    follower: PlanFollower,
    pressed: Callable[[], bool],
    *,
    look: Callable[[Frame], None] | None = None,
) -> None:
    """Drive the plan to its end; raises DriveEnded where it was not driven to the end, OSError without a vehicle.

    `pressed` tells once that a person pressed the key: before the drive that arms, in it that stops.
    """
    watch = Watch(None)
    asked: list[str] = []
    begun_ns = rig.clock.now_ns()

    def arm() -> bool:
        if not pressed():
            return False
        if watch.drove:
            asked.append("stopped by key")
        return not watch.drove

    def stop() -> bool:
        if rig.auto_arm and not watch.drove and rig.clock.now_ns() - begun_ns > _PATIENCE_S * NS_PER_S:
            asked.append("the vehicle did not arm")
        return follower.over or watch.why is not None or bool(asked)

    run_chain(rig, car, follower, arm=arm, stop=stop, watch=watch, look=look)
    why = follower.why or watch.why or (asked[0] if asked else None)
    if why is not None:
        raise DriveEnded(why)


def run_chain(
    rig: Rig,
    car: CarConfig,
    controller: Controller,
    *,
    arm: Callable[[], bool],
    stop: Callable[[], bool],
    watch: Watch | None = None,
    look: Callable[[Frame], None] | None = None,
) -> None:
    """The runner around a controller, until `stop`; raises DriveEnded for a signal or where something failed."""
    loop = Loop(NoLane(look), controller, Limits(car.safety, car.vehicle), validity_s=car.safety.command_validity_s)
    parts = RunParts(
        source=rig.source,
        link=rig.link,
        recorder=None,
        motion=MotionEstimator(car.vehicle),
        loop=loop,
        safety=Safety(car.safety, auto_arm=rig.auto_arm),
        clock=rig.clock,
    )
    config = RunConfig(command_validity_s=car.safety.command_validity_s, period_s=PERIOD_S, collector_off=False)
    quiet = QUIET | ({"arming", "driving"} if rig.auto_arm else set())
    runner = Runner(parts, config, observer=watch, arm_requested=arm, on_event=EventTeller(rig.clock, frozenset(quiet)))
    result = runner.run(stop=stop)
    if result.traceback is not None:
        say(result.traceback.rstrip())
    if result.end is RunEnd.SIGNAL:
        raise DriveEnded(f"stopped by {result.events[-1].text}")
    if result.end is not RunEnd.STOP:
        raise DriveEnded(result.end.value)
