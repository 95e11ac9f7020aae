"""car.toml -> frozen configuration, one class per section.

Every key has a default or is demanded by name. An unknown key, a wrong type or an impossible value raises
`ConfigError` with file, line, key and what to do. Writing back (calibration) goes through tomlkit and keeps comments.
"""

from __future__ import annotations

import dataclasses
import difflib
import itertools
from dataclasses import dataclass, field
from pathlib import Path

from automodel.reading import ConfigError, not_negative, parse_toml, positive, read_section, read_text

__all__ = ["CarConfig", "ConfigError", "load_car", "parse_car"]


def _one_of(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        close = difflib.get_close_matches(value, choices, 1)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        raise ValueError(f"{name}: {value!r} is none of {', '.join(choices)}{hint}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Intrinsics:
    """OpenCV's pinhole + Brown model; distortion is k1 k2 p1 p2 k3."""

    fx_px: float = 480.0
    fy_px: float = 480.0
    cx_px: float = 319.5
    cy_px: float = 179.5
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        positive(self, "fx_px", "fy_px")
        if len(self.distortion) != 5:
            raise ValueError(f"distortion: {len(self.distortion)} numbers where k1 k2 p1 p2 k3 are wanted")


@dataclass(frozen=True, slots=True, kw_only=True)
class Extrinsics:
    """The camera's optical centre and attitude in the body frame.

    Positive pitch looks down, positive yaw looks left, positive roll leans the right side down.
    """

    x_m: float = 0.20
    y_m: float = 0.0
    z_m: float = 0.18
    pitch_rad: float = 0.26
    yaw_rad: float = 0.0
    roll_rad: float = 0.0

    def __post_init__(self) -> None:
        positive(self, "z_m")
        if not -1.5 < self.pitch_rad < 1.5:
            raise ValueError(f"pitch_rad: {self.pitch_rad} where -1.5 .. 1.5 is wanted (radians, positive looks down)")


@dataclass(frozen=True, slots=True, kw_only=True)
class SecondCamera:
    """The right camera of a stereo pair."""

    intrinsics: Intrinsics = field(default_factory=Intrinsics)
    extrinsics: Extrinsics = field(default_factory=Extrinsics)


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraConfig:
    """The camera: `source` is "sim", "csi", "usb" or a path."""

    source: str = "sim"
    device: int = 0  # the number N of /dev/videoN, or the CSI sensor's id
    width_px: int = 640
    height_px: int = 360
    rate_hz: float = 60.0
    colour: bool = False  # False: frames come grey, which every pipeline is content with
    intrinsics: Intrinsics = field(default_factory=Intrinsics)
    extrinsics: Extrinsics = field(default_factory=Extrinsics)
    right: SecondCamera | None = None

    def __post_init__(self) -> None:
        positive(self, "width_px", "height_px", "rate_hz")
        not_negative(self, "device")


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleConfig:
    """The car's measures. `reference_x_m` is the point whose pose is reported, ahead of the rear axle."""

    wheelbase_m: float = 0.26
    reference_x_m: float = 0.13
    width_m: float = 0.20
    front_overhang_m: float = 0.07  # from the front axle to the bumper
    rear_overhang_m: float = 0.07
    ticks_per_m: float = 200.0  # wheel ticks a metre of the rear axle's way

    def __post_init__(self) -> None:
        positive(self, "wheelbase_m", "width_m", "ticks_per_m")
        not_negative(self, "front_overhang_m", "rear_overhang_m")


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneConfig:
    """The lane as it is expected: the width is a start value, the pipelines estimate it."""

    width_m: float = 0.40
    marking_width_m: float = 0.03
    dark_markings: bool = False  # True: dark lines on a bright floor

    def __post_init__(self) -> None:
        positive(self, "width_m", "marking_width_m")
        if self.marking_width_m > 0.5 * self.width_m:
            raise ValueError(f"marking_width_m: {self.marking_width_m} is more than half the lane's width")


PIPELINES = ("centerline", "windows")


@dataclass(frozen=True, slots=True, kw_only=True)
class WindowsConfig:
    """`windows` (seed 003). Lengths are multiples of the lane's width, so that they hold at any scale."""

    view_ahead_lanes: float = 3.0  # how far ahead of the first visible ground the bird's-eye view reaches
    view_half_lanes: float = 1.6  # half the bird's-eye view's breadth
    marking_px: float = 5.0  # pixels that the marking is wide in the bird's-eye view
    contrast: float = 12.0  # grey levels that a marking stands above its surroundings, at least
    coast_m: float = 1.6  # way [m] that the lane is carried on without any line, at most
    coast_s: float = 2.0  # and for how long at most

    def __post_init__(self) -> None:
        positive(self, "view_ahead_lanes", "view_half_lanes", "marking_px", "contrast")
        not_negative(self, "coast_m", "coast_s")


@dataclass(frozen=True, slots=True, kw_only=True)
class CenterlineConfig:
    """`centerline` (seed 001). Lengths are multiples of the lane's width, so that they hold at any scale."""

    markings: str = "unet"  # what finds the markings: the network, or the classical "ridge" filter
    network: str = "512x256"  # size of the network's picture: 512x256, or 256x128 for a small board
    model: str = ""  # an ONNX file; empty: the weights that are shipped
    providers: tuple[str, ...] = ("tensorrt", "cuda", "cpu")  # tried in this order
    threads: int = 0  # of the network on the CPU; 0: half of the cores
    threshold: float = 0.5  # probability from which a pixel is a marking
    view_ahead_lanes: float = 3.0  # how far ahead of the first visible ground the bird's-eye view reaches
    view_half_lanes: float = 1.8  # half the bird's-eye view's breadth
    marking_px: float = 4.0  # pixels that the marking is wide in the bird's-eye view
    coast_lanes: float = 5.0  # way that the lane is carried on without any line, at most
    coast_s: float = 2.5  # and for how long at most

    def __post_init__(self) -> None:
        _one_of("markings", self.markings, ("unet", "ridge"))
        _one_of("network", self.network, ("512x256", "256x128"))
        for name in self.providers:
            _one_of("providers", name, ("tensorrt", "cuda", "cpu"))
        positive(self, "threshold", "view_ahead_lanes", "view_half_lanes", "marking_px")
        not_negative(self, "threads", "coast_lanes", "coast_s")
        if self.threshold >= 1.0:
            raise ValueError(f"threshold: {self.threshold} where a probability below 1 is wanted")


@dataclass(frozen=True, slots=True, kw_only=True)
class PipelineConfig:
    """Which paper sees the lane, and each one's own keys."""

    name: str = "centerline"
    centerline: CenterlineConfig = field(default_factory=CenterlineConfig)
    windows: WindowsConfig = field(default_factory=WindowsConfig)

    def __post_init__(self) -> None:
        _one_of("name", self.name, PIPELINES)


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
    actuator_delay_s: float = 0.07  # frame to wheels: loop, wire, servo frame, dead time, lag; made good by prediction
    obstacle_stop_m: float = 0.35  # stop when the ultrasonic range ahead is below this
    obstacle_go_m: float = 0.45  # and go on above this
    one_line_speed: float = 1.0  # share of the speed with one line seen
    coasting_speed: float = 0.7  # share of the speed while coasting

    def __post_init__(self) -> None:
        _one_of("controller", self.controller, ("stanley", "pure_pursuit"))
        positive(self, "lateral_accel_mps2", "accel_mps2", "decel_mps2", "lookahead_s", "lookahead_min_m")
        positive(self, "stanley_gain_per_s", "stanley_softening_mps", "one_line_speed", "coasting_speed")
        not_negative(self, "speed_mps", "actuator_delay_s", "obstacle_stop_m", "obstacle_go_m")
        if self.obstacle_go_m < self.obstacle_stop_m:
            raise ValueError(f"obstacle_go_m: {self.obstacle_go_m} is less than obstacle_stop_m")


def _check_table(name: str, pulses_us: tuple[float, ...], values: tuple[float, ...]) -> None:
    if len(pulses_us) != len(values) or len(pulses_us) < 2:
        raise ValueError(f"{name}: {len(values)} values for {len(pulses_us)} pulses; as many are wanted, two at least")
    if any(b <= a for a, b in itertools.pairwise(pulses_us)):
        raise ValueError("pulse_us: must rise from entry to entry")
    if not all(500 <= p <= 2500 for p in pulses_us):
        raise ValueError("pulse_us: servo pulses lie between 500 and 2500 us")
    steps = [b - a for a, b in itertools.pairwise(values)]
    if not (all(d > 0 for d in steps) or all(d < 0 for d in steps)):
        raise ValueError(f"{name}: must rise throughout or fall throughout")
    if not min(values) <= 0 <= max(values):
        raise ValueError(f"{name}: must span 0, the neutral position")


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoConfig:
    """Pulse width -> road-wheel angle: piecewise linear through (pulse_us[i], steering_rad[i])."""

    pulse_us: tuple[float, ...] = (1050.0, 1500.0, 1950.0)
    steering_rad: tuple[float, ...] = (0.45, 0.0, -0.45)

    def __post_init__(self) -> None:
        _check_table("steering_rad", self.pulse_us, self.steering_rad)


@dataclass(frozen=True, slots=True, kw_only=True)
class MotorConfig:
    """Pulse width -> speed: piecewise linear through (pulse_us[i], speed_mps[i])."""

    pulse_us: tuple[float, ...] = (1100.0, 1500.0, 1900.0)
    speed_mps: tuple[float, ...] = (-4.0, 0.0, 4.0)

    def __post_init__(self) -> None:
        _check_table("speed_mps", self.pulse_us, self.speed_mps)


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkConfig:
    """The vehicle's controller: `port` is "sim" or a serial port."""

    kind: str = "arduino"
    port: str = "sim"
    baud: int = 115200
    servo: ServoConfig = field(default_factory=ServoConfig)
    motor: MotorConfig = field(default_factory=MotorConfig)

    def __post_init__(self) -> None:
        _one_of("kind", self.kind, ("arduino",))
        positive(self, "baud")


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
    rearm_s: float = 0.5  # healthy input for so long before arming

    def __post_init__(self) -> None:
        positive(self, *(f.name for f in dataclasses.fields(self)))


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingConfig:
    """How runs are recorded: PNG keeps every bit, so that a replay gives the same estimates; JPEG is smaller."""

    directory: str = "recordings"
    image: str = "png"
    jpeg_quality: int = 90

    def __post_init__(self) -> None:
        _one_of("image", self.image, ("png", "jpeg"))
        if not 1 <= self.jpeg_quality <= 100:
            raise ValueError(f"jpeg_quality: {self.jpeg_quality} where 1 .. 100 is wanted")


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


def load_car(path: str | Path) -> CarConfig:
    """Read car.toml; raises ConfigError (also for a file that is not there)."""
    return parse_car(read_text(path), str(path))


def parse_car(text: str, file: str) -> CarConfig:
    """The configuration in `text`; `file` is its name in errors."""
    return read_section(CarConfig, parse_toml(text, file), text, file)
