"""The car's own motion from what its camera saw of the floor, for cars without a gyro.

Bird's-eye views of the floor before the car are kept while it drives and compared afterwards. What is the same in all
of them (vignetting, reflections of lamps, a bumper) moves with the camera and is taken away first; else a plain floor
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
from automodel.types import FloatArray, Image

Float32Array = NDArray[np.float32]

_REACH_HEIGHTS = 4.5  # how far the view reaches beyond the first visible ground, in camera heights
_HALF_WIDTH_HEIGHTS = 2.7
_ROWS = 200
_BLUR_PX = 1.5
_BROAD_PX = 31  # brightness that changes over more than this is light, no floor
_CLIP = 3.0  # times the usual contrast: else one bright line would be all that counts, and it says nothing along itself
_ALIKE = 0.3  # correlation from which two views are taken for the same floor
_SURE = 0.75  # from which no other guess is tried
_TURNS_RAD = (0.0, 0.06, -0.06, 0.14, -0.14)  # guesses around the motion before
_STOP = (3, 30, 1e-5)  # cv2.TERM_CRITERIA_EPS + MAX_ITER
_LEAST_SHARE = 0.6  # of the pairs that must tell a motion


class FloorError(ValueError):
    """The floor shows too little to tell the motion; the text says what to do."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Driven:
    """The motion between successive views: at `t_ns` (n,), midway, speed `speed_mps` (n,) and `yaw_rate_radps` (n,)."""

    t_ns: NDArray[np.int64]
    speed_mps: FloatArray
    yaw_rate_radps: FloatArray


def floor_view(camera: GroundCamera) -> BirdsEye:
    """The bird's-eye view of the floor that motion is told from; raises ValueError where the camera sees no floor."""
    near = camera.first_visible_x_m()
    height = float(camera.centre_m[2])
    reach = _REACH_HEIGHTS * height
    return BirdsEye(
        camera,
        View(
            x_near_m=near,
            x_far_m=near + reach,
            half_width_m=_HALF_WIDTH_HEIGHTS * height,
            m_per_px=reach / _ROWS,
        ),
    )


def motion_of(views: Sequence[Image], t_ns: Sequence[int], floor: BirdsEye) -> Driven:
    """The motion between each two successive `views` (h, w) grey, taken at `t_ns`; raises FloorError.

    Each pair is registered by the enhanced correlation coefficient (Evangelidis and Psarakis 2008) with a rotation and
    a shift; pairs that do not correlate are left out.
    """
    if len(views) < 3:
        raise FloorError(f"{len(views)} pictures of the floor were taken; does the camera work?")
    shown = _without_fixed([_floor_only(view) for view in views])
    mask = cv2.erode(np.pad(floor.mask, 1), np.ones((_BROAD_PX - 6, _BROAD_PX - 6), np.uint8))[1:-1, 1:-1].copy()
    middles, ways, turns, spans = [], [], [], []
    way, turn = 0.0, 0.0
    for i in range(1, len(views)):
        found = _registered(shown[i - 1], shown[i], mask, floor.view, (way, turn))
        if found is None:
            continue
        way, turn = found
        ways.append(way)
        turns.append(turn)
        spans.append((t_ns[i] - t_ns[i - 1]) * 1e-9)
        middles.append((t_ns[i] + t_ns[i - 1]) // 2)
    if len(ways) < _LEAST_SHARE * (len(views) - 1):
        raise FloorError(
            f"only {len(ways)} of {len(views) - 1} pairs of pictures tell how the car moved: the floor is too plain or "
            "too dark; spread newspapers on it, or switch a light on"
        )
    span = np.array(spans)
    return Driven(
        t_ns=np.array(middles, dtype=np.int64), speed_mps=np.array(ways) / span, yaw_rate_radps=np.array(turns) / span
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
    """(way [m], turn [rad]) from one view to the next, None where they are not alike."""
    best, warp = _ALIKE, None
    for turn in _TURNS_RAD:
        guess = _warp_of(last[0], last[1] + turn, view)
        with contextlib.suppress(cv2.error):  # it has not converged
            alike, found = cv2.findTransformECC(before, after, guess, cv2.MOTION_EUCLIDEAN, _STOP, mask, 1)
            if alike > best:
                best, warp = alike, found.astype(np.float32)
        if best > _SURE:
            break
    return None if warp is None else _motion_of_warp(warp, view)


def _warp_of(way_m: float, turn_rad: float, view: View) -> Float32Array:
    """The affine (2, 3) that carries view pixels before a motion along an arc to where the same floor is after it."""
    corners = np.array([(0.0, 0.0), (view.width_px - 1.0, 0.0), (0.0, view.height_px - 1.0)])
    half = 0.5 * turn_rad
    chord = way_m * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
    shift = chord * np.array((math.cos(half), math.sin(half)))
    c, s = math.cos(turn_rad), math.sin(turn_rad)
    after_m = (view.to_body(corners) - shift) @ np.array(((c, -s), (s, c)))
    affine = cv2.getAffineTransform(corners.astype(np.float32), view.to_px(after_m).astype(np.float32))
    return affine.astype(np.float32)


def _motion_of_warp(warp: Float32Array, view: View) -> tuple[float, float]:
    """Way [m] and turn [rad] of the rear axle, the inverse of `_warp_of` but for the side slip, which is left out."""
    pixels = np.array([(0.0, 0.0), (view.width_px - 1.0, 0.0)])
    before = view.to_body(pixels)
    after = view.to_body(pixels @ warp[:, :2].T + warp[:, 2])
    across_before, across_after = before[1] - before[0], after[1] - after[0]
    turn = math.atan2(across_before[1], across_before[0]) - math.atan2(across_after[1], across_after[0])
    turn = (turn + math.pi) % (2.0 * math.pi) - math.pi
    c, s = math.cos(turn), math.sin(turn)
    shift = before[0] - np.array(((c, -s), (s, c))) @ after[0]
    half = 0.5 * turn
    chord = float(shift[0] * math.cos(half) + shift[1] * math.sin(half))
    return chord * (half / math.sin(half) if abs(half) > 1e-9 else 1.0), turn
