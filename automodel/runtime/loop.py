"""One pure tick of the chain: frame -> estimate -> wanted command -> limited command.

The same object runs in a live car, in a lock-step simulation and in a replay: it reads no clock but the injected
stopwatch, whose readings go into `Tick.stages_ns` and nowhere else. An exception of a stage goes up to the caller: the
runner is the one place that catches everything, and it sends the safe command first.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from automodel.interfaces import Controller, Driver, Pipeline, cameras_of
from automodel.runtime.clocks import NS_PER_S
from automodel.runtime.eye_check import EyeCheck
from automodel.signals import (
    Command,
    DriverInput,
    Frame,
    LaneEstimate,
    LaneStatus,
    Motion,
    MotionSource,
    StageView,
    StereoFrame,
    VehicleState,
)

STAGES = ("pipeline", "controller", "limits")
LOOK_AGAIN_S = 0.5  # a car that stands looks for its lane anew so often, while it knows none that it may be armed in
STANDING_MPS = 0.02  # a slower car stands
FAILURES = 4  # in a row, after which a pipeline is reset: finding a lane in a bend takes longer than a car is held


class Limited(Protocol):
    """A command after the limits, and the names of those that took hold."""

    @property
    def command(self) -> Command:
        """The command that may be sent."""
        ...

    @property
    def reasons(self) -> tuple[str, ...]:
        """The limits that changed it, empty where none did."""
        ...


class Limits(Protocol):
    """The limits applied last before the wire."""

    def step(self, command: Command, motion: Motion, t_ns: int) -> Limited:
        """The nearest command that breaks no limit at `t_ns`."""
        ...

    def reset(self, sent: Command | None = None) -> None:
        """Forget the past but for `sent`, the command that is on the wire: rates are counted from it."""
        ...


class Checks(Protocol):
    """Whether the inputs can be true; texts of what cannot."""

    def misfit(self, frame: Frame | StereoFrame) -> str | None:
        """Why nothing can be made of the frame, None where it can be looked at."""
        ...

    def of_frame(self, frame: Frame | StereoFrame, seen: Frame | StereoFrame) -> tuple[str, ...]:
        """What is wrong with a frame that fits; `seen` is what of it the pipeline is given: all, or one eye's image."""
        ...

    def of_estimate(self, estimate: LaneEstimate, motion: Motion, state: VehicleState | None) -> tuple[str, ...]:
        """What is wrong with the lane, or with how the car moves."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tick:
    """What one frame gave.

    `motion` is the one that the pipeline was given, unknown in place of one that was not finite.
    `wanted` is the command of the controller, or of the person who drove by `driver`; `command` the one after the
    limits, with `limited_by` naming those. `faults` are texts of what was not finite, each already replaced by
    something safe, and of what cannot be true; `lane_faults` those that a person who drives judges better: of the lane
    and of how the car turns. `stages_ns` are durations [ns] in the order of `STAGES`, zero without a stopwatch.
    """

    estimate: LaneEstimate
    motion: Motion
    wanted: Command
    command: Command
    limited_by: tuple[str, ...] = ()
    faults: tuple[str, ...] = ()
    lane_faults: tuple[str, ...] = ()
    driver: DriverInput | None = None
    stages_ns: tuple[int, ...] = (0, 0, 0)


def _no_stopwatch() -> int:
    return 0


class Loop:
    """Pipeline, controller and limits in a row.

    `validity_s` is the time after a frame's capture for which its command may be obeyed; `stopwatch` gives integer
    nanoseconds (`time.perf_counter_ns`) and is only read for the durations. `checks` look at what comes in where a car
    is driven; they change nothing but the faults of the `Tick`, and keep a frame that does not fit away from the
    pipeline. `driver` makes commands of what a person wants, where one may drive. A pipeline of two cameras gets the
    good one's image alone while the other one is dark or stuck (`EyeCheck`).
    """

    def __init__(
        self,
        pipeline: Pipeline,
        controller: Controller,
        limits: Limits,
        *,
        validity_s: float,
        stopwatch: Callable[[], int] = _no_stopwatch,
        checks: Checks | None = None,
        driver: Driver | None = None,
    ) -> None:
        if not validity_s > 0:
            raise ValueError(f"validity_s: expected a positive number, got {validity_s}")
        self._pipeline = pipeline
        self._cameras = cameras_of(pipeline)
        self._eyes = EyeCheck() if self._cameras == 2 else None
        self._controller = controller
        self._limits = limits
        self._validity_ns = round(validity_s * NS_PER_S)
        self._stopwatch = stopwatch
        self._checks = checks
        self._driver = driver
        self._failures = 0  # of the pipeline, in a row
        self._looked_ns: int | None = None  # when the lane was last looked for anew

    @property
    def warning(self) -> str:
        """What was wrong with a pair's images, and what the pipeline found wrong in car.toml, in one line; or empty."""
        warnings = ("" if self._eyes is None else self._eyes.warning, str(getattr(self._pipeline, "warning", "")))
        return "; ".join(filter(None, warnings))

    @property
    def eye_trouble(self) -> str:
        """Why the pipeline was given one image of the last pair alone, in one line; "" where it was not."""
        return "" if self._eyes is None else self._eyes.trouble

    @property
    def cameras(self) -> int:
        """How many cameras the pipeline looks through."""
        return self._cameras

    @property
    def stage_views(self) -> tuple[StageView, ...] | None:
        """What the pipeline's stages found in the last frame, to be drawn; None of a pipeline that does not show it."""
        views: tuple[StageView, ...] | None = getattr(self._pipeline, "stage_views", None)
        return views

    def tick(
        self,
        frame: Frame | StereoFrame,
        motion: Motion,
        state: VehicleState | None,
        t_ns: int,
        wanted_by_hand: DriverInput | None = None,
    ) -> Tick:
        """The chain for one frame; `motion` is the car's since the frame before.

        `t_ns` is the time at which the command goes out, as far as it is known before. A value that is not finite makes
        the motion unknown, the estimate LOST or the command a standstill; the faults say so. `wanted_by_hand` takes the
        controller's place: the pipeline goes on looking, and the limits are the same.
        """
        valid_until_ns = min(frame.t_ns, t_ns) + self._validity_ns
        start = self._stopwatch()
        faults = motion_faults(motion)
        if faults:
            motion = Motion(t_ns=motion.t_ns, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)
        estimate, wrong, lane_faults = self._see(frame, motion, state)
        faults += wrong
        seen = self._stopwatch()
        driver = wanted_by_hand if self._driver is not None else None
        if self._driver is not None and driver is not None:
            wanted = self._driver.step(driver, t_ns)
        else:
            wanted = self._controller.step(estimate, motion, state, t_ns)
        if not _is_finite(wanted):
            faults += (f"the controller gave {_numbers(wanted)}",)
            wanted = _standstill(t_ns, valid_until_ns)
            self._controller.reset()
        steered = self._stopwatch()
        limited = self._limits.step(wanted, motion, t_ns)
        command = limited.command
        if not _is_finite(command):
            faults += (f"the limits gave {_numbers(command)}",)
            command = _standstill(t_ns, valid_until_ns)
            self._limits.reset()
        return Tick(
            estimate=estimate,
            motion=motion,
            wanted=wanted,
            # A stage may shorten a command's life, never stretch it beyond what the frame it came from allows.
            command=replace(command, valid_until_ns=min(command.valid_until_ns, valid_until_ns)),
            limited_by=limited.reasons,
            faults=faults,
            lane_faults=lane_faults,
            driver=driver,
            stages_ns=(seen - start, steered - seen, self._stopwatch() - steered),
        )

    def _look(self, frame: Frame | StereoFrame, motion: Motion) -> LaneEstimate:
        """The pipeline's estimate; one of a single camera sees the left image of a pair, which is `[camera]`'s."""
        if isinstance(frame, StereoFrame) and self._cameras == 1:
            frame = Frame(t_ns=frame.t_ns, index=frame.index, image=frame.left)
        step: Callable[..., LaneEstimate] = self._pipeline.step
        return step(frame, motion)

    def _see(
        self, frame: Frame | StereoFrame, motion: Motion, state: VehicleState | None
    ) -> tuple[LaneEstimate, tuple[str, ...], tuple[str, ...]]:
        """The estimate, what is wrong with the frame, and what with the lane."""
        checks = self._checks
        lost = LaneEstimate(t_ns=frame.t_ns, status=LaneStatus.LOST)
        misfit = None if checks is None else checks.misfit(frame)
        if isinstance(frame, Frame) and frame.eye and self._cameras == 1:
            misfit = "the left camera gives no image, and this pipeline sees through that one alone"
        if misfit is not None:
            return lost, (misfit,), ()
        seen = frame if self._eyes is None else self._eyes.step(frame)
        wrong = () if checks is None else checks.of_frame(frame, seen)
        estimate = self._look(seen, motion)
        faults = estimate_faults(estimate)
        if faults:
            self.failed()
            return lost, wrong + faults, ()
        self._failures = 0
        self._look_again(estimate, motion, state)
        unfit = () if checks is None else checks.of_estimate(estimate, motion, state)
        trouble = str(getattr(self._pipeline, "trouble", ""))
        return estimate, wrong, (*unfit, trouble) if trouble else unfit

    def _look_again(self, estimate: LaneEstimate, motion: Motion, state: VehicleState | None) -> None:
        """Forget a lane that nobody may be armed in, where the car stands and is not armed.

        A lane that is found after a loss may be the next one, and only driving tells. A car that stands would never
        know, and never be armed again. But before it is, a person looks where it stands, as at the start: so its lane
        is looked for as at the start. Bounds of half the lane or more are those that `OffsetBoundCheck` refuses.
        """
        pose, t_ns = estimate.pose, estimate.t_ns
        if pose is None or math.isinf(pose.offset_bound_m) or pose.offset_bound_m < 0.5 * pose.width_m:
            return
        stands = motion.source is not MotionSource.NONE and abs(motion.speed_mps) < STANDING_MPS
        if state is None or state.armed or not stands:
            return
        if self._looked_ns is None or not 0 <= t_ns - self._looked_ns < LOOK_AGAIN_S * NS_PER_S:
            self._looked_ns = t_ns
            self._pipeline.reset()

    def overruled(self, sent: Command | None) -> None:
        """The last command was not sent, but `sent` was (None: nothing): controller and limits go on from there.

        Without this the controller's speed would ramp up while the car is held, and the car would leap when freed.
        """
        self._controller.reset()
        if self._driver is not None:
            self._driver.reset()
        self._limits.reset(sent)

    def failed(self) -> None:
        """The last tick raised: a pipeline that goes on failing must forget what it knows, which may be spoilt."""
        self._failures += 1
        if self._failures % FAILURES == 0:
            self._pipeline.reset()

    def reset(self) -> None:
        """Forget everything but the configuration."""
        self._failures, self._looked_ns = 0, None
        self._pipeline.reset()
        self._controller.reset()
        if self._driver is not None:
            self._driver.reset()
        self._limits.reset()


def estimate_faults(estimate: LaneEstimate) -> tuple[str, ...]:
    """What in an estimate is not finite, or is missing from one that claims to be valid; empty when all is well."""
    if not estimate.valid:
        return ()
    if estimate.pose is None or estimate.centerline is None:
        return (f"the estimate is {estimate.status.value} but has no pose or no centerline",)
    pose = estimate.pose
    numbers = [pose.offset_m, pose.heading_rad, pose.width_m, pose.curvature_per_m]
    numbers += pose.covariance.ravel().tolist()
    faults: tuple[str, ...] = ()
    if not all(map(math.isfinite, numbers)):
        faults += ("the estimate's pose is not finite",)
    if not (pose.offset_bound_m >= 0 and pose.heading_bound_rad >= 0):  # also where it is not a number
        faults += ("a bound of the estimate's pose is not a number >= 0",)
    if estimate.crossing is not None:
        crossing = estimate.crossing
        if not (math.isfinite(crossing.distance_m) and math.isfinite(crossing.angle_rad)):
            faults += ("the estimate's crossing is not finite",)
    ends_m = estimate.centerline.position(np.array((0.0, estimate.centerline.length_m)))
    if not np.isfinite(ends_m).all():
        faults += ("the estimate's centerline is not finite",)
    return faults


def motion_faults(motion: Motion) -> tuple[str, ...]:
    """What in a motion is not finite; empty when all is well."""
    if math.isfinite(motion.speed_mps) and math.isfinite(motion.yaw_rate_radps):
        return ()
    return (f"the motion is {motion.speed_mps} m/s and {motion.yaw_rate_radps} rad/s",)


def state_faults(state: VehicleState) -> tuple[str, ...]:
    """What in a vehicle's state is not finite; empty when all is well."""
    said = (state.speed_mps, state.yaw_rate_radps, state.steering_rad, state.battery_v, *state.ranges_m)
    if all(value is None or math.isfinite(value) for value in said):
        return ()
    return ("the vehicle's state is not finite",)


def _is_finite(command: Command) -> bool:
    return math.isfinite(command.steering_rad) and math.isfinite(command.speed_mps)


def _numbers(command: Command) -> str:
    return f"{command.steering_rad} rad and {command.speed_mps} m/s"


def _standstill(t_ns: int, valid_until_ns: int) -> Command:
    return Command(t_ns=t_ns, steering_rad=0.0, speed_mps=0.0, valid_until_ns=valid_until_ns)
