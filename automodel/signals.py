"""The values that pass between stages: frozen, slotted, keyword-only.

SI units; ISO 8855 signs (left and anticlockwise positive). Arrays inside are read-only. Time is integer nanoseconds of
the monotonic clock, taken at capture.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, field

import numpy as np

from automodel.curves.base import Curve
from automodel.types import FloatArray, Image

SIDES = ("left", "right")  # the cameras of a pair, by `Frame.eye`
EXCEEDED = 1e-3  # share of frames in which an error may exceed its bound
FALSE_LANE = 0.25  # a valid estimate whose offset is wrong by more than this share of the lane's width


def _read_only(values: object, shape: tuple[int | None, ...], name: str) -> FloatArray:
    if type(values) is np.ndarray and values.base is None and not values.flags.writeable and values.dtype == np.float64:
        array: FloatArray = values  # nobody writes to it
    else:
        array = values.astype(np.float64) if isinstance(values, np.ndarray) else np.array(values, dtype=np.float64)
        array.flags.writeable = False
    if array.shape != shape and not _fits(array.shape, shape):
        raise ValueError(f"{name}: expected shape {shape}, got {array.shape}")
    return array


def _fits(got: tuple[int, ...], shape: tuple[int | None, ...]) -> bool:
    return len(got) == len(shape) and all(size in (n, None) for n, size in zip(got, shape, strict=True))


def _frozen_image(image: Image, name: str) -> Image:
    if image.dtype != np.uint8 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)):
        raise ValueError(f"{name}: expected uint8 (h, w) or (h, w, 3), got {image.dtype} {image.shape}")
    view = image.view()  # no copy: the source does not write to the buffer again
    view.flags.writeable = False
    return view


def same_image(a: Image, b: Image) -> bool:
    """Whether two images are the same to the last bit, which those of a sensor never are."""
    if a.shape != b.shape:
        return False
    return np.array_equal(a[::32], b[::32]) and np.array_equal(a, b)  # a few rows tell nearly always


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame:
    """One camera image.

    `t_ns` is the time of capture, `index` counts what the source delivered, `image` is uint8, (h, w) grey or
    (h, w, 3) BGR. `eye` is the camera: 0 the only one or the left one, 1 the right one of a pair whose left one is
    missing.
    """

    t_ns: int
    index: int
    image: Image
    eye: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "image", _frozen_image(self.image, "Frame.image"))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StereoFrame:
    """Two images taken at the same time, or nearly; as in `Frame`.

    `t_ns` is the time of the left one, `right_late_ns` how much later the right one was taken.
    """

    t_ns: int
    index: int
    left: Image
    right: Image
    right_late_ns: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "left", _frozen_image(self.left, "StereoFrame.left"))
        object.__setattr__(self, "right", _frozen_image(self.right, "StereoFrame.right"))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Observation:
    """One frame's line points in the body frame: `left_m`, `right_m` (n, 2), and their standard deviations (n,) [m]."""

    left_m: FloatArray
    right_m: FloatArray
    left_sigma_m: FloatArray
    right_sigma_m: FloatArray


class MotionSource(enum.Enum):
    """The source of a `Motion`, the best first."""

    MEASURED = "measured"  # speed and yaw rate both measured
    MODEL = "model"  # speed measured, yaw rate from the bicycle model on the applied steering
    COMMAND = "command"  # speed or steering as commanded
    RECORDED = "recorded"  # read from a recording or motion.csv
    IMAGES = "images"  # seen in the images: the ground's own motion
    NONE = "none"  # unknown: both values are 0 and must not be used


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """The car's motion at `t_ns`: speed [m/s] of the rear axle's centre, forward positive, and yaw rate [rad/s]."""

    t_ns: int
    speed_mps: float
    yaw_rate_radps: float
    source: MotionSource = MotionSource.MEASURED

    @property
    def known(self) -> bool:
        """Whether the values may be used for dead reckoning."""
        return self.source is not MotionSource.NONE


class LaneStatus(enum.Enum):
    """What supports an estimate."""

    TRACKING = "TRACKING"  # both lines seen in this frame
    ONE_LINE = "ONE_LINE"  # one line seen, the other one placed by the lane's width
    COASTING = "COASTING"  # no line seen: dead reckoning, for a limited time
    LOST = "LOST"  # no estimate; pose, lines and centerline are None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LaneLine:
    """One line of the lane in the body frame.

    `points_m` (n, 2) are this frame's measured points [m], empty where `seen` is False; `curve` runs away from the car.
    """

    curve: Curve
    points_m: FloatArray
    seen: bool

    def __post_init__(self) -> None:
        object.__setattr__(self, "points_m", _read_only(self.points_m, (None, 2), "LaneLine.points_m"))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LanePose:
    """The car's pose in the lane, at the vehicle's reference point.

    `offset_m`: the car's distance from the centerline, left positive. `heading_rad`: the car's direction relative to
    the centerline's tangent, left positive. `width_m`: the lane's width. `curvature_per_m`: the centerline's
    curvature at the foot of the perpendicular, positive where the road bends left. `covariance` (3, 3) of
    (offset, heading, width) in [m, rad, m]: noise alone. `offset_bound_m`, `heading_bound_rad`: errors that are
    exceeded in at most 1 of 1,000 frames, whatever their cause; infinite where the maker of the pose states none: then
    nothing slows, holds or stops the car for it, and files leave it empty.
    """

    offset_m: float
    heading_rad: float
    width_m: float
    curvature_per_m: float
    covariance: FloatArray
    offset_bound_m: float = math.inf
    heading_bound_rad: float = math.inf

    def __post_init__(self) -> None:
        object.__setattr__(self, "covariance", _read_only(self.covariance, (3, 3), "LanePose.covariance"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Crossing:
    """A line across the lane: distance [m] ahead of the reference point along the lane, and its angle [rad].

    The angle is the line's direction in the body frame, pi/2 where it lies square across the car's path.
    """

    distance_m: float
    angle_rad: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LaneEstimate:
    """A pipeline's estimate of the lane in one frame; body frame, metres.

    `frame_age_ns` is the age of the last frame in which a line was seen: 0 while one is seen. `lane_change` is +1 or -1
    in the frame in which the lane on the left or on the right became the lane, else 0. `camera_pitch_rad` is by how
    much the camera looks further down than car.toml says, as the lane has shown: the metres were measured so.
    """

    t_ns: int
    status: LaneStatus
    left: LaneLine | None = None
    right: LaneLine | None = None
    centerline: Curve | None = None
    pose: LanePose | None = None
    crossing: Crossing | None = None
    frame_age_ns: int = 0
    lane_change: int = 0
    camera_pitch_rad: float = 0.0

    @property
    def valid(self) -> bool:
        """Whether there is a pose and a centerline to drive by."""
        return self.status is not LaneStatus.LOST


class Role(enum.Enum):
    """What a mark in an image is to a pipeline's stage."""

    EXPECTED = "expected"  # calibrated, or predicted before the image was looked at
    FOUND = "found"
    USED = "used"
    LEFT_OUT = "left out"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StageMark:
    """Points, or a polyline where `joined`, at `pixels` (n, 2); NaN where there is none, which parts a polyline."""

    role: Role
    pixels: FloatArray
    joined: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "pixels", _read_only(self.pixels, (None, 2), "StageMark.pixels"))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StageView:
    """What one stage of a pipeline found in the image of one camera (`Frame.eye`), to be drawn in this order."""

    stage: str
    eye: int
    marks: tuple[StageMark, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """A command until `valid_until_ns`: road-wheel angle [rad], left positive, and speed [m/s]."""

    t_ns: int
    steering_rad: float
    speed_mps: float
    valid_until_ns: int


NEUTRAL = Command(t_ns=0, steering_rad=0.0, speed_mps=0.0, valid_until_ns=0)


@dataclass(frozen=True, slots=True, kw_only=True)
class DriverInput:
    """What a person who drives wants, heard at `t_ns`.

    Shares -1 .. 1 of the greatest steering, left positive, and of the greatest speed.
    """

    t_ns: int
    steering: float
    speed: float

    def __post_init__(self) -> None:
        for name in ("steering", "speed"):
            if not -1.0 <= getattr(self, name) <= 1.0:  # NaN too
                raise ValueError(f"DriverInput.{name}: expected a share from -1 to 1, got {getattr(self, name)}")


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleState:
    """The state that a vehicle reports; None for a value that it does not report.

    `ranges_m`: ultrasonic ranges (left, centre, right) [m], None without an echo. `steering_rad` is the last angle sent
    to the actuator, or the measured one. `faults` are names. `boot_id` changes whenever the vehicle's controller
    restarts. `engaged`: the vehicle follows our commands. `driver_override`: a person steers, brakes or accelerates.
    `gear`: "P", "R", "N" or "D".
    """

    t_ns: int
    speed_mps: float | None = None
    yaw_rate_radps: float | None = None
    steering_rad: float | None = None
    ranges_m: tuple[float | None, ...] = ()
    battery_v: float | None = None
    armed: bool = False
    faults: tuple[str, ...] = field(default=())
    boot_id: int | None = None
    engaged: bool | None = None
    driver_override: bool | None = None
    gear: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """An event for the recording: `kind` is a fixed word, `text` one line for people."""

    t_ns: int
    kind: str
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class BoardSensors:
    """Readings of the sensors on the controller board at one time.

    `ranges_m`: ultrasonic ranges (left, centre, right) [m], None without an echo. `wheel_ticks` counts from power-on,
    down in reverse. `yaw_rate_radps` is None without a gyro.
    """

    ranges_m: tuple[float | None, float | None, float | None]
    wheel_ticks: int
    battery_v: float
    yaw_rate_radps: float | None
