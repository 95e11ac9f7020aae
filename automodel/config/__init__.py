"""car.toml -> frozen configuration, one class per section.

Every key has a default or is demanded by name. An unknown key, a wrong type or an impossible value raises
`ConfigError` with file, line, key and what to do. Writing back (calibration) goes through tomlkit and keeps comments.
"""

from __future__ import annotations

import dataclasses
import datetime
from dataclasses import dataclass, field
from pathlib import Path

from automodel.config.camera import CameraConfig, Extrinsics, Intrinsics, SecondCamera
from automodel.config.can import CanCommand, CanConfig, CanMessage, CanSignal, CanValue
from automodel.config.link import AutonomosConfig, LinkConfig, MotorConfig, ServoConfig
from automodel.config.parts import CONTROLLERS, PAIR_PIPELINES, PIPELINES
from automodel.config.pipelines import CenterlineConfig, ContourConfig, PipelineConfig, StereoConfig, WindowsConfig
from automodel.config.toml_reader import (
    ConfigError,
    not_negative,
    one_of,
    parse_toml,
    positive,
    read_section,
    read_text,
)

__all__ = [
    "PIPELINE_NAMES",
    "AutonomosConfig",
    "CalibrationRecord",
    "CalibrationRecords",
    "CameraConfig",
    "CanCommand",
    "CanConfig",
    "CanMessage",
    "CanSignal",
    "CanValue",
    "CarConfig",
    "CenterlineConfig",
    "ConfigError",
    "ContourConfig",
    "ControlConfig",
    "Extrinsics",
    "Intrinsics",
    "LaneConfig",
    "LinkConfig",
    "MotorConfig",
    "PipelineConfig",
    "RecordingConfig",
    "SafetyConfig",
    "SecondCamera",
    "ServoConfig",
    "StereoConfig",
    "VehicleConfig",
    "WindowsConfig",
    "load_car",
    "parse_car",
]


# Those that come with automodel and see the lane through one camera, the default first.
PIPELINE_NAMES = tuple(name for name in PIPELINES.names if name not in PAIR_PIPELINES)


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleConfig:
    """The car's measures. `reference_x_m` is the point whose pose is reported, ahead of the rear axle."""

    wheelbase_m: float = 0.26
    reference_x_m: float = 0.13
    width_m: float = 0.20
    front_overhang_m: float = 0.07  # from the front axle to the bumper
    rear_overhang_m: float = 0.07
    ticks_per_m: float = 200.0  # wheel ticks per metre that the rear axle travels
    battery_low_v: float = 6.4  # below this the battery is reported as low; 0: never

    def __post_init__(self) -> None:
        positive(self, "wheelbase_m", "width_m", "ticks_per_m")
        not_negative(self, "front_overhang_m", "rear_overhang_m", "battery_low_v")

    def free_space_m(self, lane_width_m: float) -> float:
        """Distance [m] to either side of the centerline at which the car's side is over the edge of such a lane."""
        return max(0.5 * (lane_width_m - self.width_m), 0.0)


POLARITIES = ("light", "dark", "both")


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneConfig:
    """The expected lane. The width is where the estimate starts; the pipelines follow the real one.

    Who has measured the lanes says how well with `width_sigma_m`: a lamp's reflection beside a line hardly makes a lane
    then.
    `dark_markings` is the older key for `markings`; it is None here.
    """

    width_m: float = 0.40
    width_sigma_m: float = 0.0  # one sigma of the width, all along the road; 0: as any lane's, 12 % of it
    marking_width_m: float = 0.03
    markings: str = ""  # against the floor: "light", "dark" or "both"; empty: light
    dark_markings: bool | None = None
    left: str = "any"  # the left line is "dashed" or "solid": tells which lane it is where that is in doubt
    right: str = "any"

    def __post_init__(self) -> None:
        positive(self, "width_m", "marking_width_m")
        for key in ("left", "right"):
            one_of(key, getattr(self, key), ("any", "dashed", "solid"))
        if self.marking_width_m > 0.5 * self.width_m:
            raise ValueError(f"marking_width_m: {self.marking_width_m} is more than half the lane's width")
        if not 0.0 <= self.width_sigma_m <= 0.3 * self.width_m:
            raise ValueError(f"width_sigma_m: expected 0 to 30 % of width_m, got {self.width_sigma_m}")
        if self.markings and self.dark_markings is not None:
            raise ValueError("dark_markings: remove it; [lane] markings is given")
        object.__setattr__(self, "markings", self.markings or ("dark" if self.dark_markings else "light"))
        object.__setattr__(self, "dark_markings", None)
        one_of("markings", self.markings, POLARITIES)


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlConfig:
    """How the car is steered and how fast it goes."""

    controller: str = "pure_pursuit"
    speed_mps: float = 1.0
    lateral_accel_mps2: float = 1.5  # speed in a bend is chosen to stay below this
    accel_mps2: float = 1.5  # rate at which the wanted speed rises
    decel_mps2: float = 3.0  # and falls
    lookahead_s: float = 0.35  # pure pursuit: time ahead of the target point
    lookahead_min_m: float = 0.28
    stanley_gain_per_s: float = 2.5
    stanley_softening_mps: float = 0.3
    feed_forward: bool = True  # steer for the centerline's curvature
    # from the command to wheels that have turned: wire, servo frame, dead time, lag; made good by prediction, as is the
    # measured time from a frame to its command
    actuator_delay_s: float = 0.067
    speed_delay_s: float = 0.15  # from a lower speed's command to a slower car: dead time and lag of the motor
    obstacle_stop_m: float = 0.35  # stop when the ultrasonic range ahead is below this
    obstacle_go_m: float = 0.45  # and go on above this
    one_line_speed: float = 1.0  # share of the speed with one line seen
    coasting_speed: float = 0.7  # share of the speed while coasting
    late_lanes: float = 0.1  # driven at most from a frame to its command: at 1 m/s slower from 40 ms on, at 2 from 20
    uncertain_speed: float = 0.3  # share that is left however uncertain the offset is: a standing car learns nothing

    def __post_init__(self) -> None:
        CONTROLLERS.check("controller", self.controller)
        positive(self, "lateral_accel_mps2", "accel_mps2", "decel_mps2", "lookahead_s", "lookahead_min_m")
        positive(self, "stanley_gain_per_s", "stanley_softening_mps")
        positive(self, "one_line_speed", "coasting_speed", "uncertain_speed", "late_lanes")
        not_negative(self, "speed_mps", "actuator_delay_s", "speed_delay_s", "obstacle_stop_m", "obstacle_go_m")
        if self.obstacle_go_m < self.obstacle_stop_m:
            raise ValueError(f"obstacle_go_m: {self.obstacle_go_m} is less than obstacle_stop_m")


@dataclass(frozen=True, slots=True, kw_only=True)
class SafetyConfig:
    """The limits applied last before the wire, and the times of the freshness chain.

    The defaults are those of full scale (3 m/s^2, 5 m/s^3) carried to a 1:10 car at equal Froude number: the
    acceleration stays, the jerk grows by sqrt(10).
    """

    steering_max_rad: float = 0.45
    steering_rate_max_radps: float = 6.0
    speed_max_mps: float = 2.0
    lateral_accel_max_mps2: float = 3.0
    lateral_jerk_max_mps3: float = 16.0
    frame_timeout_s: float = 0.06  # no frame for so long: hold the steering, neutral throttle
    command_validity_s: float = 0.10  # a command lives so long after the frame that it came from
    hold_s: float = 0.3  # in HOLD for so long: stop, latched
    holds_max: int = 12  # held so often within holds_window_s, the next one stops: a camera that drops out for a second
    holds_window_s: float = 10.0  # holds the car up to 11 times, and is over then (`bench faults`); what goes on is not
    rearm_s: float = 0.5  # healthy input for so long before arming

    def __post_init__(self) -> None:
        positive(self, *(f.name for f in dataclasses.fields(self)))


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingConfig:
    """How runs are recorded.

    JPEG of quality 90 is a third of the size, and a tenth of the work, of PNG, which keeps every bit: its replay gives
    the drive's estimates to the bit, that of JPEG within millimetres of offset.
    """

    directory: str = "recordings"
    image: str = "jpeg"
    jpeg_quality: int = 90

    def __post_init__(self) -> None:
        one_of("image", self.image, ("png", "jpeg"))
        if not 1 <= self.jpeg_quality <= 100:
            raise ValueError(f"jpeg_quality: expected 1 .. 100, got {self.jpeg_quality}")


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationRecord:
    """What vouches for a calibrated section: when, how, and how large its error was (a text with units).

    `mode` is the camera's (`CameraConfig.mode`) where the section belongs to one; empty where it is not known.
    """

    date: datetime.date
    method: str
    residual: str
    mode: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationRecords:
    """The records that the calibration commands leave; None: never calibrated."""

    camera: CalibrationRecord | None = None  # [camera.intrinsics]
    ground: CalibrationRecord | None = None  # [camera.extrinsics]
    servo: CalibrationRecord | None = None  # [link.servo]
    odometry: CalibrationRecord | None = None  # [vehicle] ticks_per_m, [link.motor]
    stereo: CalibrationRecord | None = None  # [camera.right]


@dataclass(frozen=True, slots=True, kw_only=True)
class CarConfig:
    """The whole of car.toml; the defaults are the simulated car."""

    vehicle: VehicleConfig = field(default_factory=VehicleConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    lane: LaneConfig = field(default_factory=LaneConfig)
    pipeline: PipelineConfig = field(default_factory=PipelineConfig)
    control: ControlConfig = field(default_factory=ControlConfig)
    link: LinkConfig = field(default_factory=LinkConfig)
    safety: SafetyConfig = field(default_factory=SafetyConfig)
    recording: RecordingConfig = field(default_factory=RecordingConfig)
    calibration: CalibrationRecords = field(default_factory=CalibrationRecords)

    @property
    def other_mode(self) -> str | None:
        """The camera mode that the intrinsics were calibrated for, where the camera is set to another one."""
        return _other_mode(self.calibration.camera, self.camera)

    @property
    def other_right_mode(self) -> str | None:
        """As `other_mode`, of the right one of two cameras."""
        return None if self.camera.right is None else _other_mode(self.calibration.stereo, self.camera.eyes[1])


def _other_mode(record: CalibrationRecord | None, camera: CameraConfig) -> str | None:
    return record.mode if record is not None and record.mode not in ("", camera.mode) else None


def load_car(path: str | Path) -> CarConfig:
    """Read car.toml; raises ConfigError (also for a file that is not there)."""
    return parse_car(read_text(path), str(path))


def parse_car(text: str, file: str) -> CarConfig:
    """The configuration in `text`; `file` is its name in errors."""
    return read_section(CarConfig, parse_toml(text, file), text, file)
