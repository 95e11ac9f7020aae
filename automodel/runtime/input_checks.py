"""Whether what a run is given can be true, and is certain enough: images, the lane that a pipeline reports, the turns.

- `ImageCheck`: an image has the camera's size, is a new one, and shows anything at all.
- `PairTimesCheck`: both images of a pair were taken at the same time, or nearly.
- `LaneJumpCheck`: the lane is still the one that was followed; a car cannot move sideways, or turn, between two frames.
- `width_fault`: the lane has a width that a lane can have.
- `OffsetBoundCheck`: the car is in its lane, whatever its pose may be wrong by.
- `SteeringCheck`: the car turns as it is steered, by the gyro where there is one.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from automodel.config import CarConfig, VehicleConfig
from automodel.signals import (
    Frame,
    LaneEstimate,
    LanePose,
    LaneStatus,
    Motion,
    MotionSource,
    StereoFrame,
    VehicleState,
    same_image,
)
from automodel.types import Image

OFFSET_LANES = 0.5  # further to the side than half a lane's width, another line was taken for the lane's
HEADING_RAD = 0.6  # turned by more than this, a line across the road was
UNCERTAIN = "offset uncertain"  # what a text of `OffsetBoundCheck` begins with
KEPT_S = 0.5  # a lane that was seen longer ago is no measure any more; longer than a car is held


class LaneJumpCheck:
    """Compares each estimate with the last one that was right.

    Estimates that jump are wrong until one comes that is near the last right one, or until that is `KEPT_S` old: then
    whoever armed the car anew has looked at where it stands.

    Two poses that are both within their bounds differ by at most the sum of the bounds: a greater step is a jump,
    whatever the status, unless it is too small to bring the car out of its lane (the free space beside it) or to be
    another line (`HEADING_RAD`). Where a pose states no bound, a jump is more than `OFFSET_LANES` or `HEADING_RAD`, and
    after COASTING there is none: dead reckoning drifts, and a line that is seen again outranks it.
    """

    def __init__(self, vehicle: VehicleConfig) -> None:
        self._vehicle = vehicle
        self._right: LaneEstimate | None = None

    def step(self, estimate: LaneEstimate) -> str | None:
        """How the lane has jumped, None where it has not or there is none."""
        jump = self._jump(estimate)
        if jump is None and estimate.pose is not None:
            self._right = estimate
        return jump

    def _jump(self, estimate: LaneEstimate) -> str | None:
        right, pose = self._right, estimate.pose
        if pose is None or right is None or right.pose is None:
            return None
        if not 0 <= estimate.t_ns - right.t_ns < KEPT_S * 1e9:
            return None
        most_m, most_rad = self._most(right.pose, pose, right.status is LaneStatus.COASTING)
        sideways_m = pose.offset_m - right.pose.offset_m
        sideways_m += 0.5 * estimate.lane_change * (right.pose.width_m + pose.width_m)  # measured from the next lane
        if abs(sideways_m) > most_m:
            return f"the lane has jumped sideways by {abs(sideways_m):.2f} m"
        turn_rad = math.remainder(pose.heading_rad - right.pose.heading_rad, math.tau)
        if abs(turn_rad) > most_rad:
            return f"the lane has turned by {abs(turn_rad):.2f} rad at once"
        return None

    def _most(self, right: LanePose, pose: LanePose, coasted: bool) -> tuple[float, float]:
        """The greatest steps [m], [rad] from the right pose to the next that are no jumps."""
        most_m = max(right.offset_bound_m + pose.offset_bound_m, self._vehicle.free_space_m(right.width_m))
        most_rad = max(right.heading_bound_rad + pose.heading_bound_rad, HEADING_RAD)
        if math.isinf(most_m):
            most_m = math.inf if coasted else OFFSET_LANES * right.width_m
        if math.isinf(most_rad):
            most_rad = math.inf if coasted else HEADING_RAD
        return most_m, most_rad


WIDEST_CARS = 10.0  # a lane that is wider than so many cars is none; full-size lanes are twice as wide as a car


def width_fault(estimate: LaneEstimate, vehicle: VehicleConfig) -> str | None:
    """That the lane is narrower than the car or far wider than a lane, None where it is not or there is none."""
    pose = estimate.pose
    if pose is None or vehicle.width_m <= pose.width_m <= WIDEST_CARS * vehicle.width_m:
        return None
    return f"the lane is {pose.width_m:.2f} m wide, the car {vehicle.width_m:.2f} m"


class OffsetBoundCheck:
    """Holds a car that may have left its lane: the offset's bound is more than the free space beside the car.

    A car that drives is given what a car that sees no line is given: `coast_m` [m] of way and `coast_s` [s], whichever
    is over first: what it did not see before it stood there it sees by driving. A car that is not armed is well while
    it is known which lane it stands in: the bound is less than half the lane. Nothing is said of a pose that states no
    bound.
    """

    def __init__(self, vehicle: VehicleConfig, coast_m: float, coast_s: float) -> None:
        self._vehicle = vehicle
        self._coast_m, self._coast_ns = coast_m, coast_s * 1e9
        self._since_ns: int | None = None  # when the bound became too large for the car that drives
        self._last_ns = 0
        self._driven_m = 0.0

    def step(self, estimate: LaneEstimate, motion: Motion, state: VehicleState | None) -> str | None:
        """How uncertain the offset is, None where that is little enough or has not lasted for long enough."""
        pose, t_ns = estimate.pose, estimate.t_ns
        if pose is None:
            return None
        limit_m = self._vehicle.free_space_m(pose.width_m)
        if math.isinf(pose.offset_bound_m) or pose.offset_bound_m <= limit_m:
            self._since_ns = None
            return None
        text = f"{UNCERTAIN}: {pose.offset_bound_m:.2f} m (limit {limit_m:.2f})"
        if state is None or not state.armed:
            self._since_ns = None
            return text if pose.offset_bound_m >= 0.5 * pose.width_m else None
        if self._since_ns is None:
            self._since_ns, self._driven_m = t_ns, 0.0
        else:
            self._driven_m += abs(motion.speed_mps) * max(t_ns - self._last_ns, 0) * 1e-9
        self._last_ns = t_ns
        bridged = self._driven_m < self._coast_m and t_ns - self._since_ns < self._coast_ns
        return None if bridged else text


FLAT_LEVELS = 6  # grey levels between the brightest and the darkest part of a image that shows nothing
_COARSE_PX = (16, 9)  # each of these parts is the mean of many pixels, so that noise makes none of them stand out
_ROWS_READ = 20  # of each part, at least where it has them: all rows of 720 take four times as long and tell no more


class ImageCheck:
    """Counts only images that show something new; says what is wrong when the last of those is too old.

    A sensor's noise never comes twice: a image that is the one before to the last bit was not taken anew, whatever
    its time says, and whether the car moves or not. A simulated camera without noise does repeat itself, where the car
    stands or there is nothing to see; `noiseless` allows that. A lens that is covered, blinded or unplugged gives a
    image without any contrast.

    One bad image is as one that was dropped: only `timeout_s` without a good one is worth a word. While the other
    camera of a pair goes on alone this one's images are not asked for (`excuse`).
    """

    def __init__(self, width_px: int, height_px: int, timeout_s: float, *, noiseless: bool = False) -> None:
        self._shape = (height_px, width_px)
        self._timeout_ns = round(timeout_s * 1e9)
        self._noiseless = noiseless
        self._before: Image | None = None
        self._good_ns: int | None = None  # when the newest good image was taken

    def misfit(self, image: Image) -> str | None:
        """Why nothing can be made of the image, None where its size is the camera's."""
        height, width = image.shape[:2]
        if (height, width) == self._shape:
            return None
        return f"the image has {width}x{height} pixels; the camera has {self._shape[1]}x{self._shape[0]}"

    def step(self, image: Image, t_ns: int) -> str | None:
        """What is wrong with the images up to this one, taken at `t_ns`; None while all is well, or may still be."""
        wrong = self._wrong(image)
        if wrong is None:
            self._good_ns = t_ns
            return None
        if self._good_ns is None:
            return wrong
        age_ns = t_ns - self._good_ns
        return None if age_ns < self._timeout_ns else f"{wrong} for {age_ns * 1e-9:.3f} s"

    def excuse(self, t_ns: int) -> None:
        """Count from `t_ns`, when the other camera of the pair gave a good image, as if this one had."""
        self._good_ns = t_ns

    def _wrong(self, image: Image) -> str | None:
        before, self._before = self._before, image
        if contrast(image) < FLAT_LEVELS:
            return "the image is blank"
        if before is not None and not self._noiseless and same_image(before, image):
            return "the camera repeats the same image"
        return None


def contrast(image: Image) -> int:
    """Grey levels between the brightest and the darkest part of a image, of the channel with the most."""
    every = max(image.shape[0] // (_COARSE_PX[1] * _ROWS_READ), 1)
    coarse = cv2.resize(image[::every], _COARSE_PX, interpolation=cv2.INTER_AREA).reshape(
        _COARSE_PX[0] * _COARSE_PX[1], -1
    )
    return int((coarse.max(axis=0).astype(np.int64) - coarse.min(axis=0)).max())


class PairTimesCheck:
    """Counts only pairs whose images were taken within `tolerance_s` of each other.

    A car moves between two images: what both show is then not where they place it. As in `ImageCheck` a bad pair is as
    one that was dropped: only `timeout_s` without a good one is worth a word.
    """

    def __init__(self, tolerance_s: float, timeout_s: float) -> None:
        self._tolerance_ns, self._timeout_ns = tolerance_s * 1e9, round(timeout_s * 1e9)
        self._good_ns: int | None = None  # when the newest good pair was taken

    def step(self, right_late_ns: int, t_ns: int) -> str | None:
        """What is wrong with the pairs up to this one, taken at `t_ns`; None while all is well, or may still be."""
        if abs(right_late_ns) <= self._tolerance_ns:
            self._good_ns = t_ns
            return None
        if self._good_ns is not None and t_ns - self._good_ns < self._timeout_ns:
            return None
        apart_ms, most_ms = abs(right_late_ns) * 1e-6, self._tolerance_ns * 1e-6
        return f"the images of a pair were taken {apart_ms:.1f} ms apart (limit {most_ms:.3g})"


MIN_MPS = 0.4  # a slower car turns too little to tell
APART_RADPS = 0.5  # between the yaw rates measured and expected: what a servo a few degrees off its table makes
APART_SHARE = 0.4  # and this share of the expected one: tyres slip
LASTING_S = 0.25  # a servo's lag is over in a fifth of this


class SteeringCheck:
    """Compares the gyro's yaw rate with that of a bicycle, v tan(delta) / L (Rajamani 2012, section 2.2).

    delta [rad] is the last steering command, as the vehicle reports it, v [m/s] its speed, L the wheelbase [m]. A servo
    that is stuck, or a linkage that has come off, shows wherever the road is not as straight as the wheels stand.
    """

    def __init__(self, wheelbase_m: float) -> None:
        self._wheelbase_m = wheelbase_m
        self._apart_since_ns: int | None = None
        self._wrong_ns: int | None = None

    def step(self, motion: Motion, state: VehicleState | None) -> str | None:
        """What is wrong at the motion's time; None while all is well, or nothing can be said."""
        t_ns = motion.t_ns
        if not self._apart(motion, state):
            self._apart_since_ns = None
        elif self._apart_since_ns is None:
            self._apart_since_ns = t_ns
        if self._apart_since_ns is not None and t_ns - self._apart_since_ns >= LASTING_S * 1e9:
            self._wrong_ns = t_ns
        if self._wrong_ns is None or t_ns - self._wrong_ns >= KEPT_S * 1e9:
            return None
        return "the car does not turn as it is steered; look at the servo and its linkage"

    def _apart(self, motion: Motion, state: VehicleState | None) -> bool:
        if motion.source is not MotionSource.MEASURED or abs(motion.speed_mps) < MIN_MPS:
            return False
        if state is None or state.steering_rad is None:
            return False
        expected = motion.speed_mps * math.tan(state.steering_rad) / self._wheelbase_m
        return abs(motion.yaw_rate_radps - expected) > APART_RADPS + APART_SHARE * abs(expected)


class InputChecks:
    """Implements `Checks`. They outlive a reset of the chain: what they remember is bounded in time.

    `noiseless` is for a simulated camera whose images have no noise.
    """

    def __init__(self, car: CarConfig, *, noiseless: bool = False) -> None:
        size, timeout_s = (car.camera.width_px, car.camera.height_px), car.safety.frame_timeout_s
        self._pictures = tuple(ImageCheck(*size, timeout_s, noiseless=noiseless) for _ in range(2))
        right = car.camera.right
        tolerance_s = math.inf if right is None else right.tolerance_s(car.camera.rate_hz)
        self._pair_times = PairTimesCheck(tolerance_s, timeout_s)
        self._vehicle = car.vehicle
        self._lane_jump = LaneJumpCheck(car.vehicle)
        self._offset_bound = OffsetBoundCheck(car.vehicle, *car.pipeline.coasting(car.lane.width_m))
        self._steering = SteeringCheck(car.vehicle.wheelbase_m)

    def misfit(self, frame: Frame | StereoFrame) -> str | None:
        """Why nothing can be made of the frame, None where it can be looked at."""
        return next(filter(None, (check.misfit(image) for check, image in self._seen(frame))), None)

    def of_frame(self, frame: Frame | StereoFrame, seen: Frame | StereoFrame) -> tuple[str, ...]:
        """What is wrong with a frame that fits; of a pair of which one eye is `seen` alone, with that one's image."""
        wrong = [check.step(image, frame.t_ns) for check, image in self._seen(seen)]
        if isinstance(frame, StereoFrame):
            wrong.append(self._pair_times.step(frame.right_late_ns, frame.t_ns))
            if isinstance(seen, Frame):
                self._pictures[1 - seen.eye].excuse(frame.t_ns)
        return tuple(filter(None, wrong))

    def of_estimate(self, estimate: LaneEstimate, motion: Motion, state: VehicleState | None) -> tuple[str, ...]:
        """What is wrong with the lane or too uncertain, or wrong with how the car moves."""
        jump, turns = self._lane_jump.step(estimate), self._steering.step(motion, state)
        uncertain, width = self._offset_bound.step(estimate, motion, state), width_fault(estimate, self._vehicle)
        return tuple(filter(None, (jump, width, uncertain, turns)))

    def _seen(self, frame: Frame | StereoFrame) -> list[tuple[ImageCheck, Image]]:
        """Each image with the check of its camera; a single image leaves the other camera's idle."""
        if isinstance(frame, StereoFrame):
            return list(zip(self._pictures, (frame.left, frame.right), strict=True))
        return [(self._pictures[frame.eye], frame.image)]
