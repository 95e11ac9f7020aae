"""The right camera of a pair from a drive: the lines and dash ends that both cameras see, and odometry.

The left camera tells where the road's lines lie; the right one is where it sees them there. Its car.toml place, from a
ruler, is the start and a weak prior. What the drive does not show stays as it is, and is named.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from automodel.config import CarConfig, Extrinsics
from automodel.geometry import CameraModel, GroundCamera
from automodel.types import FloatArray
from calibration.camera import Check, graded
from calibration.ground import NAMES
from calibration.lane_bundle import BODY, Bundle, BundleFit, Prior
from calibration.lane_scene import END_LANES, MATCHED_PX, Scene
from calibration.lane_sights import DrivenPair, SightReader
from calibration.views import CalibrationError

RULER_RAD, RULER_SHARE, RULER_M = math.radians(2.0), 0.025, 0.01  # one sigma of car.toml's place: angles; of the
# baseline, and at least, of lengths
SHOWN = 0.7  # share of the prior's sigma that is left, from which on the drive shows nothing of a number
ODOMETRY = 0.02  # one sigma of the length of a metre of odometry, in the whole drive
BLOOM_PX, DRIFT_PX = 0.5, 0.1  # one sigma of how much longer, and farther, one camera sees a dash than the other
LENS_FOCAL, LENS_PX = 1e-3, 0.3  # one sigma of a calibrated lens: share of the focal length, and centre
# One sigma of x, y, z that all stretches of a drive share, so that their scatter does not show it: in camera heights,
# by 13 simulated drives with the car pitching by a degree. Ridges and ends are off by 0.03 to 0.1 px there.
SHARED = (8e-3, 1e-3, 1e-3)
_LOOSE_RAD, _USELESS_RAD = math.radians(0.4) / 3.0, math.radians(1.2) / 3.0
_BASELINE_OFF = 0.01, 0.05


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StereoFromLanes:
    """The right camera found, and its accuracy.

    `std` has one sigma of each of the extrinsics beside the left camera, `correlation` (6, 6) of their errors. Of those
    in `unknown` the drive shows next to nothing: their sigma is the ruler's. `ridge_px`, `end_px`: noise of a line's
    middle and of a dash's end, None without any; `ridges` and `ends` count the right camera's. `windows` of
    `windows_seen` stretches were used. `moved_sigmas`: how far it is from where it was, in sigmas of a ruler.
    """

    extrinsics: Extrinsics
    std: dict[str, float]
    correlation: FloatArray
    unknown: tuple[str, ...]
    baseline_m: float
    ridge_px: float
    end_px: float | None
    ridges: int
    ends: int
    pairs: int
    windows: int
    windows_seen: int
    moved_sigmas: float


def calibrate_stereo_from_lanes(
    windows: Sequence[Sequence[DrivenPair]], car: CarConfig, right: CameraModel, start: Extrinsics
) -> StereoFromLanes:
    """The right camera, whose lens is known and which is about at `start`, beside the car's left one.

    Raises CalibrationError where too little of a road is seen, or by the left camera only.
    """
    left, unit = GroundCamera.from_config(car.camera), car.lane.width_m
    reader, prior = SightReader(car), _prior(start, left)
    scene = Scene(windows, [[reader.look(pair.images[0], left) for pair in window] for window in windows], left, unit)
    pose = prior.start
    for number, (matched_px, end_lanes) in enumerate(zip(MATCHED_PX, END_LANES, strict=True)):
        if number < 2:  # again where the camera is known better
            camera = GroundCamera(right, _extrinsics(pose))
            scene.see_right(right, [[reader.look(pair.images[1], camera) for pair in window] for window in scene.used])
        if number == 0:
            pose = scene.searched(prior)
        bundle, unknowns = scene.bundle(pose, prior, matched_px, end_lanes * (number > 0))
        fit = bundle.fit(unknowns)
        scene.learn(fit.unknowns)
        pose = fit.unknowns.common
    return _result(fit, bundle, prior, left, scene, len(windows))


def _numbers(extrinsics: Extrinsics) -> FloatArray:
    return np.array([getattr(extrinsics, name) for name in NAMES])


def _extrinsics(pose: FloatArray) -> Extrinsics:
    try:
        return Extrinsics(**dict(zip(NAMES, pose[:6].round(6).tolist(), strict=True)))
    except ValueError as error:
        raise CalibrationError(
            f"the drive gives an impossible right camera ({error}); is [camera.right.extrinsics] about right?"
        ) from None


def _prior(start: Extrinsics, left: GroundCamera) -> Prior:
    """The ruler's; the bodies' is the scene's."""
    place = _numbers(start)
    length = max(RULER_SHARE * float(np.linalg.norm(place[:3] - left.centre_m)), RULER_M)
    return Prior(
        start=np.concatenate((place, (1.0, 0.0, 0.0, 0.0, 0.0, 0.0))),
        common=np.array([length] * 3 + [RULER_RAD] * 3 + [ODOMETRY, BLOOM_PX, DRIFT_PX, LENS_FOCAL, LENS_PX, LENS_PX]),
        body=np.empty((0, BODY)),
    )


def _result(
    fit: BundleFit, bundle: Bundle, prior: Prior, left: GroundCamera, scene: Scene, seen: int
) -> StereoFromLanes:
    pose, rows, number = fit.unknowns.common, bundle.rows, len(NAMES)
    shared = np.zeros(len(pose))
    shared[:3] = np.array(SHARED) * left.centre_m[2]
    covariance = fit.covariance + np.diag(shared**2)
    sigma = np.sqrt(np.diag(covariance))
    return StereoFromLanes(
        extrinsics=_extrinsics(pose),
        std=dict(zip(NAMES, sigma[:number].tolist(), strict=True)),
        correlation=(covariance / np.outer(sigma, sigma))[:number, :number],
        unknown=tuple(name for k, name in enumerate(NAMES) if sigma[k] > SHOWN * prior.common[k]),
        baseline_m=float(np.linalg.norm(pose[:3] - left.centre_m)),
        ridge_px=fit.sigma_px[0],
        end_px=fit.sigma_px[1] if (rows.end >= 0).any() else None,
        ridges=int(((rows.eye == 1) & (rows.end < 0)).sum()),
        ends=int(((rows.eye == 1) & (rows.end >= 0)).sum()),
        pairs=scene.pairs,
        windows=len(scene.used),
        windows_seen=seen,
        moved_sigmas=float(np.abs((pose - prior.start) / prior.common)[:number].max()),
    )


def check_from_lanes(found: StereoFromLanes) -> tuple[Check, ...]:
    """All checks of a calibration, the most important first."""
    off = max(found.std[name] for name in NAMES if name.endswith("_rad"))
    place = max(found.std[name] for name in NAMES if name.endswith("_m"))
    return (
        graded(
            "lines",
            found.ridge_px,
            (0.6, 2.0),
            f"{found.ridge_px:.2f} px over {found.ridges} points of the right camera",
            "calibrate both lenses and the ground again; take both images of a pair at the same time",
        ),
        graded(
            "direction",
            off,
            (_LOOSE_RAD, _USELESS_RAD),
            f"+- {math.degrees(off):.3f} deg",
            "drive farther, and weave in the lane: where the car heads and stands always alike, roll and place are one",
        ),
        graded(
            "baseline",
            place / max(found.baseline_m, 1e-9),
            _BASELINE_OFF,
            f"{found.baseline_m:.4f} m, each of x, y, z +- {1e3 * place:.1f} mm",
            "drive farther; x needs the ends of dashes, which both cameras see",
        ),
        graded(
            "beside car.toml",
            found.moved_sigmas,
            (2.5, 4.0),
            f"{found.moved_sigmas:.1f} times what a ruler is wrong by ({math.degrees(RULER_RAD):g} deg, "
            f"{100 * RULER_SHARE:g} % of the baseline)",
            "measure [camera.right.extrinsics] again: the lines of other lanes may have been taken for the same",
        ),
    )
