"""[camera]: where frames come from, the lens, and where the camera sits."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from automodel.config.toml_reader import not_negative, one_of, positive

PIXEL_FORMATS = ("MJPG", "YUYV", "GREY")
FLIPS = ("none", "rotate-180", "horizontal", "vertical")
PAIR_TOLERANCE = 0.25  # of a period: at half of it cameras that take turns would pass for pairs


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
            raise ValueError(f"distortion: expected k1 k2 p1 p2 k3, got {len(self.distortion)} numbers")


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

    def pitched(self, angle_rad: float) -> Extrinsics:
        """Of a camera that looks down by so much more."""
        return replace(self, pitch_rad=self.pitch_rad + angle_rad)

    def __post_init__(self) -> None:
        positive(self, "z_m")
        if not -1.5 < self.pitch_rad < 1.5:
            raise ValueError(f"pitch_rad: expected -1.5 .. 1.5 (radians, positive looks down), got {self.pitch_rad}")


@dataclass(frozen=True, slots=True, kw_only=True)
class SecondCamera:
    """The right camera of a stereo pair.

    `device` is its own as `[camera] device` is the left one's; None where it has none: in recordings, in the simulator,
    or where one driver gives pairs. `flip` and `latency_s` [s] are as in `[camera]`; None: the left one's. All else
    that is set of a camera counts for both. `pair_tolerance_s` is the greatest time between the two images of a pair;
    0: a quarter of the time between two frames.
    """

    device: int | None = None
    flip: str | None = None
    latency_s: float | None = None
    pair_tolerance_s: float = 0.0
    intrinsics: Intrinsics = field(default_factory=Intrinsics)
    extrinsics: Extrinsics = field(default_factory=Extrinsics)

    def __post_init__(self) -> None:
        not_negative(self, "pair_tolerance_s")
        not_negative(self, *(name for name in ("device", "latency_s") if getattr(self, name) is not None))
        if self.flip is not None:
            one_of("flip", self.flip, FLIPS)

    def tolerance_s(self, rate_hz: float) -> float:
        """The greatest time [s] between the two images of a pair, of cameras of this rate."""
        return self.pair_tolerance_s or PAIR_TOLERANCE / rate_hz

    def measured(self) -> bool:
        """Whether lens and place are given, and not those that a simulated camera has by default."""
        return self.intrinsics != Intrinsics() and self.extrinsics != Extrinsics()


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraConfig:
    """The camera: `source` is "sim", "csi", "usb", one that an installed package offers, or a path.

    The intrinsics belong to one `mode`. `gain` is the analogue gain as a factor (CSI, Raspberry Pi) or a number of the
    driver's own (USB).
    """

    source: str = "sim"
    device: int = 0  # the number N of /dev/videoN, or the CSI sensor's id
    width_px: int = 640
    height_px: int = 360
    rate_hz: float = 60.0
    colour: bool = False  # False: frames come grey, which every pipeline is content with
    latency_s: float = 0.0  # from capture to arrival, for cameras that do not say when they captured
    sensor_mode: int = -1  # which part of the sensor is read, by the driver's number (CSI); -1: the driver chooses
    flip: str = "none"
    pixel_format: str = "MJPG"  # of a USB camera, its FOURCC
    exposure_s: float = 0.0  # fixed; 0: automatic
    gain: float = 0.0  # fixed; 0: automatic
    flicker_hz: int = 0  # of the mains that feed the lamps: 50 or 60; 0: the camera's own choice
    intrinsics: Intrinsics = field(default_factory=Intrinsics)
    extrinsics: Extrinsics = field(default_factory=Extrinsics)
    right: SecondCamera | None = None

    def __post_init__(self) -> None:
        positive(self, "width_px", "height_px", "rate_hz")
        not_negative(self, "device", "latency_s", "exposure_s", "gain")
        one_of("flip", self.flip, FLIPS)
        one_of("pixel_format", self.pixel_format, PIXEL_FORMATS)
        if self.sensor_mode < -1:
            raise ValueError(f"sensor_mode: expected -1 (the driver chooses) or 0 and more, got {self.sensor_mode}")
        if self.flicker_hz not in (0, 50, 60):
            raise ValueError(f"flicker_hz: expected 50 or 60, or 0 (the camera's own choice), got {self.flicker_hz}")
        if self.exposure_s > 1.0 / self.rate_hz:
            raise ValueError(
                f"exposure_s: {self.exposure_s} is longer than the time between two frames, {1.0 / self.rate_hz:.4f}"
            )
        if self.right is None:
            return
        if self.right.device == self.device:
            raise ValueError(f"right: device {self.device} is the left camera's, too ([camera] device); give another")
        if self.right.pair_tolerance_s > 0.5 / self.rate_hz:
            raise ValueError(
                f"right: pair_tolerance_s {self.right.pair_tolerance_s} is more than half the time between two frames, "
                f"{0.5 / self.rate_hz:.4f}: an image would fit two others"
            )

    @property
    def mode(self) -> str:
        """What the intrinsics belong to, in words: another mode has another field of view or another centre."""
        part = f"sensor mode {self.sensor_mode}" if self.sensor_mode >= 0 else "the driver's sensor mode"
        turned = "" if self.flip == "none" else f", flip {self.flip}"
        return f"{self.source} {self.width_px}x{self.height_px}, {part}{turned}"

    @property
    def eyes(self) -> tuple[CameraConfig, ...]:
        """Each camera by itself: this one, and the right one where there is a pair."""
        left = replace(self, right=None)
        if self.right is None:
            return (left,)
        right = self.right
        own = {name: getattr(right, name) for name in ("device", "flip", "latency_s")}
        own = {name: value for name, value in own.items() if value is not None}
        return left, replace(left, **own, intrinsics=right.intrinsics, extrinsics=right.extrinsics)
