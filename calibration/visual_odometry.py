"""The car's motion from its camera's images of the floor, for cars without a gyro.

Bird's-eye views of the floor ahead are kept while the car drives and compared afterwards. What is equal in all of them
(vignetting, reflections of lamps, a bumper) moves with the camera and is subtracted first; otherwise a plain floor
under a lamp would seem to stand still.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from automodel.geometry import GroundCamera
from automodel.geometry.birdseye import BirdsEye, View
from automodel.geometry.se2 import SE2, wrap_angle
from automodel.types import FloatArray, Image

Float32Array = NDArray[np.float32]

_REACH_HEIGHTS = 4.5  # length of the view beyond the first visible ground, in camera heights
_HALF_WIDTH_HEIGHTS = 2.7
_ROWS = 200
_BLUR_PX = 1.5
_BROAD_PX = 31  # slower changes of brightness are light, not floor
_CLIP = 3.0  # times the median contrast; without it one bright line would dominate, which has no texture along itself
_SAME_FLOOR = 0.3  # least correlation of two views of the same floor
_SURE = 0.75  # correlation from which no other start is tried
_TURNS_RAD = (0.0, 0.06, -0.06, 0.14, -0.14)  # starts, relative to the motion before
_STOP = (3, 30, 1e-5)  # cv2.TERM_CRITERIA_EPS + MAX_ITER
_LEAST_SHARE = 0.6  # of the pairs that must be registered


class FloorError(ValueError):
    """The floor shows too little to measure the motion; the text says what to do."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Driven:
    """The motion between successive views, at `t_ns` (n,) midway: `speed_mps` (n,) and `yaw_rate_radps` (n,)."""

    t_ns: NDArray[np.int64]
    speed_mps: FloatArray
    yaw_rate_radps: FloatArray


def floor_view(camera: GroundCamera) -> BirdsEye:
    """The bird's-eye view of the floor for `motion_of`; raises ValueError where the camera sees no floor."""
    near = camera.first_visible_x_m()
    height = float(camera.centre_m[2])
    reach = _REACH_HEIGHTS * height
    return BirdsEye(
        camera,
        View(x_near_m=near, x_far_m=near + reach, half_width_m=_HALF_WIDTH_HEIGHTS * height, m_per_px=reach / _ROWS),
    )


def motion_of(views: Sequence[Image], t_ns: Sequence[int], floor: BirdsEye) -> Driven:
    """The motion between successive `views` (h, w) grey, taken at `t_ns`; raises FloorError.

    Each pair is registered with a rotation and a shift by the enhanced correlation coefficient (Evangelidis and
    Psarakis 2008); pairs that do not correlate are left out.
    """
    if len(views) < 3:
        raise FloorError(f"{len(views)} images of the floor were taken; does the camera work?")
    shown = _without_fixed([_floor_only(view) for view in views])
    mask = cv2.erode(np.pad(floor.mask, 1), np.ones((_BROAD_PX - 6, _BROAD_PX - 6), np.uint8))[1:-1, 1:-1].copy()
    middles, distances, turns, spans = [], [], [], []
    distance, turn = 0.0, 0.0
    for i in range(1, len(views)):
        found = _registered(shown[i - 1], shown[i], mask, floor.view, (distance, turn))
        if found is None:
            continue
        distance, turn = found
        distances.append(distance)
        turns.append(turn)
        spans.append((t_ns[i] - t_ns[i - 1]) * 1e-9)
        middles.append((t_ns[i] + t_ns[i - 1]) // 2)
    if len(distances) < _LEAST_SHARE * (len(views) - 1):
        raise FloorError(
            f"only {len(distances)} of {len(views) - 1} pairs of images show the motion: the floor is too plain or too "
            "dark; spread newspapers on it, or switch a light on"
        )
    span = np.array(spans)
    return Driven(
        t_ns=np.array(middles, dtype=np.int64),
        speed_mps=np.array(distances) / span,
        yaw_rate_radps=np.array(turns) / span,
    )


def _floor_only(view: Image) -> Float32Array:
    grey = view.astype(np.float32)
    return np.asarray(cv2.GaussianBlur(grey, (0, 0), _BLUR_PX) - cv2.blur(grey, (_BROAD_PX, _BROAD_PX)))


def _without_fixed(views: list[Float32Array]) -> list[Float32Array]:
    fixed = np.mean(views, axis=0)
    limit = _CLIP * float(np.median([np.median(np.abs(view - fixed)) for view in views[:: max(len(views) // 20, 1)]]))
    return [np.clip(view - fixed, -limit - 1e-3, limit + 1e-3).astype(np.float32) for view in views]


def _registered(
    before: Float32Array, after: Float32Array, mask: Image, view: View, last: tuple[float, float]
) -> tuple[float, float] | None:
    """(distance [m], rotation [rad]) from one view to the next, None where they do not correlate."""
    best, warp = _SAME_FLOOR, None
    for turn in _TURNS_RAD:
        guess = _warp_of(last[0], last[1] + turn, view)
        with contextlib.suppress(cv2.error):  # it has not converged
            correlation, found = cv2.findTransformECC(before, after, guess, cv2.MOTION_EUCLIDEAN, _STOP, mask, 1)
            if correlation > best:
                best, warp = correlation, found.astype(np.float32)
        if best > _SURE:
            break
    return None if warp is None else _motion_of_warp(warp, view)


def _warp_of(distance_m: float, turn_rad: float, view: View) -> Float32Array:
    """The affine transform (2, 3) of view pixels by a motion along an arc."""
    corners = np.array([(0.0, 0.0), (view.width_px - 1.0, 0.0), (0.0, view.height_px - 1.0)])
    after_m = SE2.arc(distance_m, turn_rad).inverse().apply(view.to_body(corners))
    affine = cv2.getAffineTransform(corners.astype(np.float32), view.to_px(after_m).astype(np.float32))
    return affine.astype(np.float32)


def _motion_of_warp(warp: Float32Array, view: View) -> tuple[float, float]:
    """Distance [m] and rotation [rad] of the rear axle: the inverse of `_warp_of`, side slip ignored."""
    pixels = np.array([(0.0, 0.0), (view.width_px - 1.0, 0.0)])
    before = view.to_body(pixels)
    after = view.to_body(pixels @ warp[:, :2].T + warp[:, 2])
    across_before, across_after = before[1] - before[0], after[1] - after[0]
    turn = math.atan2(across_before[1], across_before[0]) - math.atan2(across_after[1], across_after[0])
    turn = wrap_angle(turn)
    shift = before[0] - SE2(yaw_rad=turn).apply(after[0])
    half = 0.5 * turn
    chord = float(shift[0] * math.cos(half) + shift[1] * math.sin(half))
    return chord * (half / math.sin(half) if abs(half) > 1e-9 else 1.0), turn
