"""A car.toml guessed from images of a drive along a lane, for a camera of which nothing is known.

The lines' vanishing point gives pitch, yaw and roll, the lane's width gives the height (`from_lanes`), the markings
give their width and polarity, the straightness of the lines gives the lens's distortion. Parallel lines do not show the
focal length: it is that of a usual camera unless it is given, and its uncertainty becomes one of the pitch, in
proportion.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from automodel.config import CameraConfig, CarConfig, Extrinsics, Intrinsics, LaneConfig, VehicleConfig
from automodel.geometry import CameraModel, GroundCamera
from automodel.perception.markings.marking_width import MarkingWidth
from automodel.sources.images import with_channels
from automodel.types import FloatArray, Image
from calibration.from_lanes import (
    STATED,
    WHAT_HELPS,
    LanesCalibration,
    camera_from_lanes,
    check_consistent,
    line_residuals,
    sharpest_markings,
)

# The horizontal field of view of webcams, phones, dashcams and the cameras of car kits lies between 50 and 80 deg (two
# sigmas); a wrong one makes pitch and heading wrong in proportion, offsets hardly.
USUAL_VIEW_RAD, VIEW_SIGMA_RAD = math.radians(64.0), math.radians(8.0)
DISTORTIONS = (-0.45, -0.35, -0.25, -0.15, -0.08, 0.0, 0.08, 0.15)  # k1 that are tried
# One sigma of the k1 of usual cameras where the lines do not tell it from the next one of `DISTORTIONS`: it makes a
# pitch of 20 deg wrong by a degree, and a height by some percent, of which the images themselves show nothing.
K1_SIGMA = 0.1
SIGMA_IMAGES = 24  # in which it is looked for what another lens would make of them
MOUNTED_RAD = math.radians(2.0)  # one sigma of yaw and roll of a camera that was mounted level, to look ahead, by eye
SIGNIFICANT = 3.0  # sigmas by which lines must be straighter with a distortion than without one
LENS_IMAGES = 12  # of those given, in which the lens is looked for
SEARCH_WIDTH_PX = 640  # larger images are made smaller for the search: a marking is still some pixels wide
# Lines of streets are 0.10 to 0.15 m on lanes of 3.0 to 3.7 m (MUTCD 2009, section 3A.06); those of scale tracks are
# wider for their lanes (Carolo-Cup: 20 mm on 350 to 450 mm, tape of 19 to 50 mm elsewhere).
STREET_MARKING = 0.045  # of the lane's width: narrower markings are those of a street
STREET_M, STREET_SIGMA_M = 3.5, 0.25
SCALE_M, SCALE_SIGMA_M = 0.40, 0.10  # Carolo-Cup 0.35 to 0.45, BFMC 0.35, AutoModelCar 0.40, other tracks up to 0.8


@dataclass(frozen=True, slots=True, kw_only=True)
class GuessedCar:
    """A car whose camera and lane are guessed; everything else is scaled to the lane's width.

    `sigma` has one sigma of `fx_px` [px], `pitch_rad`, `yaw_rad`, `roll_rad`, and of the lengths `z_m` and `width_m`,
    which err together; `told` names what was given: "focal length", "lane width". `lanes` is how the camera was found.
    """

    car: CarConfig
    sigma: dict[str, float]
    told: tuple[str, ...]
    lanes: LanesCalibration

    def __post_init__(self) -> None:
        object.__setattr__(self, "sigma", dict(self.sigma))


def guess_car(
    images: Sequence[Image],
    rate_hz: float,
    lane_width_m: float | None = None,
    field_of_view_rad: float | None = None,
    name: str = "guessed",
) -> GuessedCar:
    """The car of `images` (h, w) or (h, w, 3), all of one size, of a drive along a lane that is mostly straight.

    `lane_width_m` and the horizontal `field_of_view_rad` are guessed where they are None. Raises ValueError, in one
    line, where the images do not show such a lane.
    """
    for what, value in (("lane_width_m", lane_width_m), ("field_of_view_rad", field_of_view_rad)):
        if value is not None and not (math.isfinite(value) and value > 0.0):
            raise ValueError(f"{what}: expected a positive number, got {value}")
    if not images:
        raise ValueError("images: there are none")
    size = images[0].shape[1], images[0].shape[0]
    small = [_smaller(image) for image in images]
    share = small[0].shape[1] / size[0]
    view_rad = USUAL_VIEW_RAD if field_of_view_rad is None else field_of_view_rad
    lens = _lens(small, view_rad)
    found = _facing_ahead(camera_from_lanes(small, lens, 1.0, Extrinsics(x_m=0.0), markings="both"), lens)
    check_consistent(small, lens, found)
    marking = _marking_width(small, lens, found)
    width_m, width_sigma_m = _lane_width(lane_width_m, marking)
    sigma = _sigmas(small, lens, found, 0.0 if field_of_view_rad is not None else VIEW_SIGMA_RAD, view_rad)
    sigma["z_m"] = width_m * math.hypot(sigma["z_m"], found.extrinsics.z_m * width_sigma_m / width_m)
    sigma["width_m"] = width_sigma_m
    sigma["fx_px"] /= share
    told = (("focal length",) if field_of_view_rad is not None else ()) + (("lane width",) if lane_width_m else ())
    camera = CameraConfig(
        source=name,
        width_px=size[0],
        height_px=size[1],
        rate_hz=rate_hz,
        intrinsics=_intrinsics(size, lens.matrix[0, 0] / share, float(lens.distortion[0])),
        extrinsics=replace(found.extrinsics, z_m=found.extrinsics.z_m * width_m),
    )
    lane = LaneConfig(width_m=width_m, marking_width_m=marking * width_m, markings=found.markings)
    return GuessedCar(car=_scaled(camera, lane), sigma=sigma, told=told, lanes=found)


def _smaller(image: Image) -> Image:
    grey = with_channels(image, False)
    if grey.shape[1] <= SEARCH_WIDTH_PX:
        return grey
    height = max(round(grey.shape[0] * SEARCH_WIDTH_PX / grey.shape[1]), 1)
    return np.asarray(cv2.resize(grey, (SEARCH_WIDTH_PX, height), interpolation=cv2.INTER_AREA), np.uint8)


def _intrinsics(size: tuple[int, int], focal_px: float, k1: float) -> Intrinsics:
    return Intrinsics(
        fx_px=focal_px,
        fy_px=focal_px,
        cx_px=0.5 * (size[0] - 1),
        cy_px=0.5 * (size[1] - 1),
        distortion=(k1, 0.0, 0.0, 0.0, 0.0),
    )


def _camera(size: tuple[int, int], view_rad: float, k1: float) -> CameraModel:
    focal_px = 0.5 * size[0] / math.tan(0.5 * view_rad)
    return CameraModel(_intrinsics(size, focal_px, k1), *size)


def _lens(images: Sequence[Image], view_rad: float) -> CameraModel:
    """The camera of this field of view with the distortion that makes the lines straightest, none if in doubt."""
    size = images[0].shape[1], images[0].shape[0]
    some = images[:: max(1, math.ceil(len(images) / LENS_IMAGES))]
    plain_camera = _camera(size, view_rad, 0.0)
    markings = sharpest_markings(some, plain_camera, "both")[1]
    plain = line_residuals(some, plain_camera, markings)
    best, largest = 0.0, SIGNIFICANT
    for k1 in DISTORTIONS:
        gain = plain - line_residuals(some, _camera(size, view_rad, k1), markings)
        gain = gain[np.isfinite(gain)]
        if len(gain) < 3:
            continue
        sigmas = float(gain.mean()) / max(float(gain.std(ddof=1)) / math.sqrt(len(gain)), 1e-6)
        if sigmas > largest:
            best, largest = k1, sigmas
    return _camera(size, view_rad, best)


def _facing_ahead(found: LanesCalibration, lens: CameraModel) -> LanesCalibration:
    """With the yaw between straight ahead and the drive's median direction.

    Where the car swerves, or every image shows a bend, that direction is as uncertain as the images' spread of it.
    """
    spread_rad = found.vanishing_sigma_px[0] / lens.matrix[0, 0]
    share = MOUNTED_RAD**2 / (MOUNTED_RAD**2 + spread_rad**2)
    yaw_sigma_rad = math.hypot(found.std["yaw_rad"], spread_rad * math.sqrt(share))
    return replace(
        found,
        extrinsics=replace(found.extrinsics, yaw_rad=found.extrinsics.yaw_rad * share),
        std=found.std | {"yaw_rad": yaw_sigma_rad},
    )


def _marking_width(images: Sequence[Image], lens: CameraModel, found: LanesCalibration) -> float:
    """The width of the markings in widths of the lane, measured where the camera sees the ground near the car."""
    start = min(found.marking_heights * found.extrinsics.z_m, 0.3)
    lane = LaneConfig(width_m=1.0, marking_width_m=start, markings=found.markings)
    width = MarkingWidth(GroundCamera(lens, found.extrinsics), lane, 0.0)
    for image in images:
        width.step(image)
    return min(width.measured_m, 0.3)


def _lane_width(given_m: float | None, marking: float) -> tuple[float, float]:
    """The lane's width and its sigma [m]: that of a street where the markings are narrow for the lane."""
    if given_m is not None:
        return given_m, 0.0
    return (STREET_M, STREET_SIGMA_M) if marking < STREET_MARKING else (SCALE_M, SCALE_SIGMA_M)


def _sigmas(
    images: Sequence[Image], lens: CameraModel, found: LanesCalibration, view_sigma_rad: float, view_rad: float
) -> dict[str, float]:
    """One sigma of each angle [rad], of z_m [lane widths] and of fx_px [px]: the images' own and that of the lens."""
    sigma = {name: found.std[name] for name in STATED} | {"fx_px": 0.0}
    if not found.roll_known:
        sigma["roll_rad"] = MOUNTED_RAD
    size, k1 = (lens.width_px, lens.height_px), float(lens.distortion[0])

    def of_distortion(sigmas: float) -> CameraModel:
        return _camera(size, view_rad, k1 + sigmas * K1_SIGMA)

    def of_view(sigmas: float) -> CameraModel:
        view = view_rad + sigmas * view_sigma_rad
        ratio = math.tan(0.5 * view_rad) / math.tan(0.5 * view)  # of the focal lengths: the same bend in pixels
        return _camera(size, view, k1 * ratio**2)

    some = images[:: max(1, len(images) // SIGMA_IMAGES)]
    for lens_of in (of_distortion, of_view) if view_sigma_rad else (of_distortion,):
        for name, own in _of_one_sigma(some, lens_of, found.markings).items():
            sigma[name] = math.hypot(sigma[name], own)
    return sigma


def _of_one_sigma(images: Sequence[Image], lens_of: Callable[[float], CameraModel], markings: str) -> dict[str, float]:
    """What is found in the images with a lens that is one sigma off, beyond what is found with the right one.

    Raises ValueError where such a lens shows no straight lane, from which nothing follows.
    """
    for share in (1.0, 0.5):
        found: list[FloatArray] = []
        try:
            for lens in (lens_of(-share), lens_of(share)):
                place = camera_from_lanes(images, lens, 1.0, Extrinsics(x_m=0.0), markings=markings).extrinsics
                found.append(np.array([*(getattr(place, name) for name in STATED), lens.matrix[0, 0]]))
        except ValueError:
            continue
        return dict(zip((*STATED, "fx_px"), (0.5 / share * np.abs(found[0] - found[1])).tolist(), strict=True))
    raise ValueError(f"images: with a lens that is a little other they show no straight lane; {WHAT_HELPS}")


def _scaled(camera: CameraConfig, lane: LaneConfig) -> CarConfig:
    """The default car, scaled to the lane, its reference point below the camera."""
    usual = CarConfig()
    scale = lane.width_m / usual.lane.width_m
    vehicle = VehicleConfig(
        wheelbase_m=usual.vehicle.wheelbase_m * scale,
        reference_x_m=0.0,
        width_m=usual.vehicle.width_m * scale,
        front_overhang_m=usual.vehicle.front_overhang_m * scale,
        rear_overhang_m=usual.vehicle.rear_overhang_m * scale,
    )
    control = replace(usual.control, lookahead_min_m=usual.control.lookahead_min_m * scale)
    return replace(usual, camera=camera, lane=lane, vehicle=vehicle, control=control)
