"""Stripes of a drive as two cameras see them: mid-lines and ends of dashes, gathered over short windows of the road.

A window is some pairs of images in a row, a few lane widths of road. Its frame is the body frame of its middle pair;
odometry places the other pairs in it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from automodel.config import CarConfig
from automodel.geometry import GroundCamera
from automodel.perception.stereo.stripes import Stripes, StripeSearch
from automodel.signals import Motion, MotionSource
from automodel.types import FloatArray, Image, Ints
from calibration.views import CalibrationError

PAIRS = 8  # of a window
WINDOWS = 24  # of a drive at most, evenly over it: 400 images of it are kept
APART_LANES = 0.3  # lane widths of road between two pairs at least
AHEAD_LANES = 10.0  # lane widths ahead of the camera that are read
HALF_LANES = 2.0  # lane widths to each side
ROWS = 120  # of an image
RIDGES = 24  # of a stripe at most: neighbours err together
LEAST_PX = 2.0  # width of a stripe from which on its middle is measured
REACH_PX = 10  # of the profile along a stripe, to each side of its end
FALL = 0.6  # share of a stripe's contrast that is lost at its end, at least: else it is worn or hidden
NEAR, FAR = 0, 1  # kinds of ends


class EyeSight(NamedTuple):
    """What one camera sees in an image: ridges `px` (n, 2) of `stripe` (n,), and ends of dashes.

    `across` (n, 2): the unit vector [px] across the stripe: along a row a flat one is measured worse.
    `end_px` (m, 2), `end_out` (m, 2) the unit vector [px] out of the dash, `end_kind` (m,) NEAR or FAR, `end_stripe`.
    """

    px: FloatArray
    across: FloatArray
    stripe: Ints
    end_px: FloatArray
    end_out: FloatArray
    end_kind: Ints
    end_stripe: Ints


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DrivenPair:
    """A pair of grey images of a drive; `place` (3,): x, y [m] and yaw [rad] in the frame of the odometry."""

    name: str
    place: FloatArray
    images: tuple[Image, Image]


class Drive:
    """Gathers the pairs of a drive in windows, evenly over however long it is."""

    def __init__(self, lane_width_m: float) -> None:
        self.windows: list[list[DrivenPair]] = []
        self.travelled_m = 0.0
        self._apart_m = APART_LANES * lane_width_m
        self._place, self._last = np.zeros(3), -math.inf
        self._before: Motion | None = None
        self._row: list[DrivenPair] = []
        self._count, self._every = 0, 1  # pairs apart; of so many windows one is kept

    def add(self, name: str, left: Image, right: Image, motion: Motion) -> None:
        """One more pair, with the motion since the one before it; raises CalibrationError without odometry."""
        if motion.source is MotionSource.NONE:
            raise CalibrationError(
                f"{name}: the car's motion is not known; give a recording with odometry, or a table with --motion"
            )
        self._move(motion)
        if self.travelled_m - self._last < self._apart_m:
            return
        self._last = self.travelled_m
        if self._count // PAIRS % self._every == 0:
            self._row.append(DrivenPair(name=name, place=self._place.copy(), images=(_grey(left), _grey(right))))
        self._count += 1
        if len(self._row) == PAIRS:
            self.windows.append(self._row)
            self._row = []
        if len(self.windows) > WINDOWS:
            self.windows, self._every = self.windows[::2], 2 * self._every

    def _move(self, motion: Motion) -> None:
        """Dead reckoning along arcs."""
        if self._before is not None:
            dt_s = (motion.t_ns - self._before.t_ns) * 1e-9
            turn, length = motion.yaw_rate_radps * dt_s, motion.speed_mps * dt_s
            middle = self._place[2] + 0.5 * turn
            self._place += np.array((length * math.cos(middle), length * math.sin(middle), turn))
            self.travelled_m += abs(length)
        self._before = motion


def _grey(image: Image) -> Image:
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


class SightReader:
    """Finds stripes and ends in the images of a car's cameras."""

    def __init__(self, car: CarConfig) -> None:
        lane, size = car.lane, (car.camera.height_px, car.camera.width_px)
        self._unit = lane.width_m
        self._searches = [
            StripeSearch(lane.marking_width_m, lane.width_m, HALF_LANES, 0.0, size, ROWS, dark)
            for dark in (False, True)
            if lane.markings in ("both", "dark" if dark else "light")
        ]

    def look(self, image: Image, camera: GroundCamera) -> EyeSight:
        """What a camera, about over the ground as given, sees in a grey image."""
        near = camera.first_visible_x_m()
        place = np.linspace(near, near + AHEAD_LANES * self._unit, 60).astype(np.complex128)
        found = [search.look(image, camera, place) for search in self._searches]
        return self._sight(image, max(found, key=lambda stripes: len(stripes.stripe)))

    def _sight(self, image: Image, stripes: Stripes) -> EyeSight:
        sharp: NDArray[np.float32] = image.astype(np.float32)
        ridges, across, numbers, ends = [], [], [], list[tuple[FloatArray, FloatArray, int, int]]()
        for k in range(stripes.count):
            its = np.flatnonzero(stripes.stripe == k)
            pixels, wide = stripes.pixels[its], stripes.width_px[its]
            good = np.flatnonzero(wide > LEAST_PX)
            good = good[np.unique(np.linspace(0, len(good) - 1, min(len(good), RIDGES)).round().astype(int))]
            ridges.append(pixels[good])
            across.append(_normals(pixels)[good])
            numbers.append(np.full(len(good), k))
            for kind, order in ((NEAR, slice(None, None, 1)), (FAR, slice(None, None, -1))):
                end = dash_end(sharp, pixels[order], float(np.median(wide[order][:5])))
                if end is not None:
                    ends.append((*end, kind, k))
        empty = np.empty((0, 2))
        return EyeSight(
            px=np.concatenate(ridges) if ridges else empty,
            across=np.concatenate(across) if across else empty,
            stripe=np.concatenate(numbers) if numbers else np.empty(0, np.intp),
            end_px=np.array([end[0] for end in ends]).reshape(-1, 2),
            end_out=np.array([end[1] for end in ends]).reshape(-1, 2),
            end_kind=np.array([end[2] for end in ends], np.intp),
            end_stripe=np.array([end[3] for end in ends], np.intp),
        )


def _normals(pixels: FloatArray) -> FloatArray:
    """Unit vectors (n, 2) across a stripe of ridges (n, 2), n > 1, by the direction of the neighbours."""
    at = np.arange(len(pixels))
    along = pixels[np.minimum(at + 3, at[-1])] - pixels[np.maximum(at - 3, 0)]
    normal = along[:, ::-1] * (-1.0, 1.0)
    return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


def dash_end(image: NDArray[np.float32], pixels: FloatArray, width_px: float) -> tuple[FloatArray, FloatArray] | None:
    """The end (2,) [px] of a stripe whose ridges (n, 2) begin there, and the direction (2,) out of it.

    It is where the grey level along the stripe is half way between that of the stripe and that of the ground ahead of
    it. None where it is not seen: cut off by the image's edge, worn, or hidden.
    """
    behind = pixels[min(6, len(pixels) - 1)]
    length = float(np.linalg.norm(pixels[0] - pixels[-1]))
    gap = float(np.linalg.norm(pixels[0] - behind))
    if width_px < LEAST_PX or gap < 4.0 or length < REACH_PX:
        return None
    out = (pixels[0] - behind) / gap
    along = np.arange(-REACH_PX, REACH_PX + 0.25, 0.5)
    line = pixels[0] + along[:, None] * out
    across = np.array((-0.15, 0.0, 0.15)) * width_px
    beside = np.array((-1.5, 1.5)) * width_px
    sampled = _sampled(image, line, np.concatenate((across, beside)))
    if sampled is None:
        return None
    profile, ground = sampled[:, :3].mean(axis=1), sampled[:, 3:].mean(axis=1)
    third = len(along) // 3
    paint, beyond, floor = np.median(profile[:third]), np.median(profile[-third:]), np.median(ground[:third])
    if abs(paint - beyond) < FALL * abs(paint - floor) or abs(paint - floor) < 8.0:
        return None
    share = (profile - beyond) / (paint - beyond)
    passed = np.flatnonzero((share[:-1] >= 0.5) & (share[1:] < 0.5))
    if len(passed) != 1 or abs(along[passed[0]]) > 0.6 * REACH_PX:
        return None
    k = int(passed[0])
    at = along[k] + 0.5 * (share[k] - 0.5) / (share[k] - share[k + 1])
    return pixels[0] + at * out, out


def _sampled(image: NDArray[np.float32], line: FloatArray, across_px: FloatArray) -> FloatArray | None:
    """Grey levels (n, k) beside a line (n, 2), shifted along rows by `across_px` (k,); None outside the image."""
    u = (line[:, :1] + across_px).astype(np.float32)
    v = np.broadcast_to(line[:, 1:], u.shape).astype(np.float32)
    height, width = image.shape
    if u.min() < 0.0 or v.min() < 0.0 or u.max() > width - 1 or v.max() > height - 1:
        return None
    return np.asarray(cv2.remap(image, u, v, cv2.INTER_LINEAR), np.float64)


def places(window: Sequence[DrivenPair]) -> FloatArray:
    """Where a window's pairs are in its frame by odometry (p, 3): x, y [m], yaw [rad]."""
    x, y, yaw = window[len(window) // 2].place
    cos, sin = math.cos(yaw), math.sin(yaw)
    back = np.array(((cos, -sin, 0.0), (sin, cos, 0.0), (0.0, 0.0, 1.0)))
    return (np.array([pair.place for pair in window]) - (x, y, yaw)) @ back
