"""The vanishing point of a straight road: bright points on its lines, and lines fitted through one point.

Only the lens is known. Ridges are searched on image rows, first at several widths. Once the vanishing point is roughly
known, they are searched at the width of markings, which is proportional to the distance below that point. Coordinates
are ideal pixels: those of a lens without distortion and with the camera's fx, relative to the principal point, u right
and v down.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from automodel.compiled import compiled
from automodel.geometry import CameraModel
from automodel.perception.markings.ridge import ridge_sums
from automodel.sources.images import with_channels
from automodel.types import Bools, Float32Array, FloatArray, Image, Ints

WIDTHS_PX = (3, 5, 9, 15, 25)  # of ridges, where nothing is known
MARKINGS = (0.05, 0.08, 0.13, 0.2, 0.3)  # widths of markings, in camera heights
ROWS = 150  # of an image that are searched, about
NOISES, NOISES_OF_MARKING, MOST_NOISES = 4.0, 2.5, 8.0  # contrast of a ridge over the noise: least, largest weight
MOST_SLOPE = 4.5  # |du / dv| of lines
ACROSS, BINS = 2.0, 256  # range of rays on the lower image border, in image widths to each side, and its bins
AROUND = 31  # bins over which a ray is compared with those around it: odd
MOST_OF_ONE = 40.0  # variances: the most that one ray adds, since a single strong line does not show where lines meet
AHEAD = 0.2  # of the image's width: one sigma of the vanishing point of a camera that looks ahead
BELOW = 1.0 / 24.0  # of the image's height: nearer below the vanishing point the lines cannot be separated
_STEP = 0.02  # of slope between samples

MOST_LINES = 8
LEAST_WEIGHT = 3.0  # standard deviations by which the points of a line must outnumber those around it
LEAST_ROWS = 8  # on which a line must be seen
APART = 0.25  # least difference between the slopes of two lines
GATES = ((1.0 / 45.0, 0.0), (1.0 / 90.0, 0.1), (1.0 / 180.0, 0.2))  # in image widths; and APART with each
LEAST_GATE_PX, LEAST_RMS_PX = 1.5, 0.3
BENDING = 1e-3  # of the image's height squared: one sigma of the curvature of a road that counts as straight
CORRELATED = 4.0  # points along a marking with a common error: this many count as one


def bright_points(image: Image, camera: CameraModel) -> FloatArray:
    """Points (n, 3) on bright ridges of any width: ideal u, v [px], and a weight."""
    grey = with_channels(image, False)
    height, width = grey.shape
    rows = np.unique(np.linspace(0, height - 1, min(height, ROWS)).astype(np.intp))
    values = grey[rows].astype(np.float32)
    noise = float(np.median(np.abs(np.diff(values, axis=1)))) + 1.0
    best = np.full(values.shape, -np.inf, np.float32)
    for span in (b for b in WIDTHS_PX if 3 * b <= min(width, height)):
        stands_out = _ridge(values, span, span) * np.float32(np.sqrt(span))
        here = best[:, span + span // 2 :][:, : stands_out.shape[1]]
        np.maximum(here, stands_out, out=here)
    row, column = _summits(best, NOISES * noise, 2)
    rays = camera.rays(np.stack((column, rows[row]), axis=-1).astype(np.float64))
    points = np.column_stack((camera.matrix[0, 0] * rays[:, :2], np.ones(len(row))))
    return points[np.isfinite(points).all(axis=1)]


def marking_points(image: Image, camera: CameraModel, vanishing_px: FloatArray, marking: float) -> FloatArray:
    """Points (n, 3) as of `bright_points`, on ridges of a marking's width; the weight is the contrast over the noise.

    `vanishing_px` (2,) may be wrong by some pixels; `marking` is the width in camera heights.
    """
    focal = camera.matrix[0, 0]
    bottom = camera.rays((camera.matrix[0, 2], camera.height_px - 1.0))[1] * focal
    down = np.linspace(BELOW * camera.height_px, bottom - vanishing_px[1], ROWS)
    slope = np.arange(-MOST_SLOPE, MOST_SLOPE, _STEP)
    if not bottom - vanishing_px[1] > 2.0 * BELOW * camera.height_px:
        return np.empty((0, 3))
    u, v = vanishing_px[0] + slope * down[:, None], np.broadcast_to(vanishing_px[1] + down[:, None], (ROWS, len(slope)))
    pixels = camera.project(np.stack((u, v, np.full_like(u, focal)), axis=-1))
    inside = camera.inside(pixels, 0.5)
    maps = np.where(inside[..., None], pixels, -9.0).astype(np.float32)
    values = cv2.remap(with_channels(image, False), maps[..., 0].copy(), maps[..., 1].copy(), cv2.INTER_LINEAR).astype(
        np.float32
    )
    span = max(round(marking / _STEP), 1)
    apart = span + max(span // 3, 1)
    ridge = _ridge(values, span, apart)
    margin = apart + span // 2
    known = inside[:, : ridge.shape[1]] & inside[:, -ridge.shape[1] :]
    stands_out = np.where(known, ridge / (_noise(ridge, known)[:, None] + 0.5), -np.inf).astype(np.float32)
    row, at = _summits(stands_out, NOISES_OF_MARKING, span // 2)
    weight = np.minimum(stands_out[row, at], MOST_NOISES)
    column = at + margin
    return np.column_stack((u[row, column], v[row, column], weight))


@compiled
def _noise(ridge: Float32Array, known: Bools) -> FloatArray:
    """The median (h,) of the size of what is known of each row (h, w), 0 where nothing is."""
    noise = np.zeros(len(ridge))
    for i in range(len(ridge)):
        there = np.abs(ridge[i][known[i]])
        if len(there):
            noise[i] = np.median(there)
    return noise


def _ridge(values: Float32Array, span: int, apart: int) -> Float32Array:
    """Means of `span` samples minus the brighter of the means `apart` on each side; shorter by the margins."""
    return np.asarray(ridge_sums(np.cumsum(np.pad(values, ((0, 0), (1, 0))), axis=1), span, apart) / np.float32(span))


def _summits(values: Float32Array, least: float, reach: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of values above `least` that are the largest within `reach` columns."""
    summit = values > least
    for k in range(1, reach + 1):
        summit[:, k:] &= values[:, k:] >= values[:, :-k]
        summit[:, :-k] &= values[:, :-k] > values[:, k:]
    row, column = summit.nonzero()
    return row, column


class Rays:
    """Histograms of points over the rays from a point above them, by where a ray meets the lower image border.

    There the bins are equally wide for a high and a low point.
    """

    def __init__(self, camera: CameraModel) -> None:
        self.bottom = float(camera.rays((camera.matrix[0, 2], camera.height_px - 1.0))[1] * camera.matrix[0, 0])
        self._most, self._ahead = ACROSS * camera.width_px, AHEAD * camera.width_px

    def profile(self, points: FloatArray, u0: float, v0: float) -> FloatArray:
        """The weight (BINS,) of the points (n, 3) in each bin of rays from (u0, v0)."""
        return _profile(points, u0, v0, self.bottom, self._most)

    def slopes(self, v0: float) -> FloatArray:
        """The slope du / dv (BINS,) of the ray of each bin."""
        across = (np.arange(BINS) + 0.5 - 0.5 * BINS) * (2.0 * self._most / BINS)
        return np.asarray(across / (self.bottom - v0), dtype=np.float64)

    def sharpness(self, points: FloatArray, u0: float, v0: float, most: float = math.inf) -> float:
        """How far the points are concentrated on few rays from (u0, v0), each of which adds `most` at most."""
        return _sharpness(_profile(points, u0, v0, self.bottom, self._most), most)

    def sharpest(self, images: Sequence[FloatArray], us: FloatArray, vs: FloatArray, below: float | None) -> FloatArray:
        """The node (2,) of a grid with the largest sum of sharpness, of all points or of those that lie `below` it.

        With `below` the points lie on any bright object, so one ray adds `MOST_OF_ONE` at most.
        """
        most = math.inf if below is None else MOST_OF_ONE
        score = np.zeros((len(vs), len(us)))
        for i, v0 in enumerate(vs):
            there = images if below is None else [p[p[:, 1] > v0 + below] for p in images]
            for j, u0 in enumerate(us):
                score[i, j] = sum(self.sharpness(points, u0, v0, most) for points in there)
        score *= np.exp(-0.5 * (us / self._ahead) ** 2)
        row, column = np.unravel_index(int(score.argmax()), score.shape)
        return np.array((us[column], vs[row]))


@compiled
def _profile(points: FloatArray, u0: float, v0: float, bottom: float, most: float) -> FloatArray:
    """The weight (BINS,) of the points (n, 3) in each bin of rays from (u0, v0), which are `most` to each side wide."""
    depth, weights, smooth = bottom - v0, np.zeros(BINS + 2), np.empty(BINS)
    for i in range(len(points)):
        across = (points[i, 0] - u0) * (depth / max(points[i, 1] - v0, 1.0))
        index = math.floor((across + most) * (0.5 * BINS / most))
        if 0 <= index < BINS and abs(across) < MOST_SLOPE * depth:
            weights[index + 1] += points[i, 2]
    for k in range(BINS):
        smooth[k] = 0.5 * weights[k] + weights[k + 1] + 0.5 * weights[k + 2]
    return smooth


@compiled
def moving_average(values: FloatArray) -> FloatArray:
    """The moving average (BINS,) of a profile, over AROUND bins."""
    sums, average = np.zeros(len(values) + AROUND), np.empty(len(values))
    for k in range(len(sums) - 1):
        sums[k + 1] = sums[k] + (values[k - AROUND // 2] if 0 <= k - AROUND // 2 < len(values) else 0.0)
    for k in range(len(values)):
        average[k] = (sums[k + AROUND] - sums[k]) / AROUND
    return average


@compiled
def _sharpness(values: FloatArray, most: float) -> float:
    around, total = moving_average(values), 0.0
    for k in range(len(values)):
        total += min(max(values[k] - around[k], 0.0) ** 2 / (around[k] + 4.0), most)
    return total


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CommonPoint:
    """Where the lines of all images meet: `vanishing_px` (2,) in ideal pixels.

    `points` are the marking points (n, 3) of each image, `marking` the width [camera heights] of markings at which they
    were found. `sharpness` is how far they are concentrated on few rays: larger for the right lens and polarity.
    """

    vanishing_px: FloatArray
    points: list[FloatArray]
    marking: float
    sharpness: float


def common_vanishing_point(images: Sequence[Image], camera: CameraModel) -> CommonPoint:
    """The vanishing point of the lines of all images, which are lighter than the ground."""
    width, height, rays = camera.width_px, camera.height_px, Rays(camera)
    bright = [bright_points(image, camera) for image in images]
    best = np.zeros(2)
    u, v = np.arange(-0.35, 0.3501, 1.0 / 32.0) * width, np.arange(-0.9, 0.3001, 1.0 / 32.0) * height
    for share in (1.0, 0.5, 0.25):
        best = rays.sharpest(bright, u, v, BELOW * height)
        steps = share * np.linspace(-1.0, 1.0, 5) / 40.0
        u, v = best[0] + steps * width, best[1] + steps * height
    found: list[CommonPoint] = []
    for marking in MARKINGS:
        points = list(map(partial(marking_points, camera=camera, vanishing_px=best, marking=marking), images))
        u, v = best[0] + 0.02 * width * np.linspace(-1, 1, 11), best[1] + 0.035 * height * np.linspace(-1, 1, 21)
        place = rays.sharpest(points, u, v, None)
        sharpness = sum(rays.sharpness(p, *place) for p in points)
        found.append(CommonPoint(vanishing_px=place, points=points, marking=marking, sharpness=sharpness))
    return max(found, key=lambda each: each.sharpness)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ConvergingLines:
    """The lines of one image through one vanishing point: u = u0 + m_i (v - v0) + c / (v - v0), in ideal pixels.

    `vanishing_px` (2,) is (u0, v0); `slopes` (k,) are the m_i, rising, and `support` (k,) the shares of the rows below
    on which each line is seen. `bend_px2` is c, common to the lines of a road of one curvature: f^2 z curvature / 2 for
    a camera z above it. `covariance` (3 + k, 3 + k) is that of (u0, v0, c, m_i), and `residual_px` the RMS distance of
    points from their line.
    """

    vanishing_px: FloatArray
    slopes: FloatArray
    support: FloatArray
    bend_px2: float
    covariance: FloatArray
    residual_px: float


def fit_converging_lines(
    points: FloatArray, near_px: FloatArray, rays: Rays, size: tuple[int, int], slack: float
) -> ConvergingLines | None:
    """The lines through a point near `near_px` (2,), by Gauss-Newton with shrinking gates; None for fewer than two.

    `points` (n, 3) as of `marking_points`, `size` (width, height) of the image [px]; `slack` is one sigma of the
    vanishing point in image widths.
    """
    width, height = size
    sigma = slack * width
    steps = sigma * np.linspace(-1.5, 1.5, 9)
    start = rays.sharpest([points], near_px[0] + steps, near_px[1] + 0.5 * steps, None)
    x = np.concatenate((start, (0.0,), _peaks(points, start, rays)))
    points = points[points[:, 1] > start[1] + BELOW * height]
    line: Ints = np.empty(0, np.intp)
    prior = np.diag((sigma**-2, sigma**-2, (BENDING * height**2) ** -2))
    for gate, apart in GATES:
        for _ in range(3):
            line = _assigned(points, x, max(gate * width, LEAST_GATE_PX))
            x, line = _kept(points, x, line, apart)
            if len(x) < 5:
                return None
            step, information, rms = _step(points, x, line, np.concatenate((near_px, (0.0,))), prior)
            x = x + step
    information = information / (max(rms, LEAST_RMS_PX) ** 2 * CORRELATED)
    information[:3, :3] += prior
    order = np.concatenate((np.arange(3), 3 + np.argsort(x[3:])))
    support = np.array(_rows(points, line, len(x) - 3)) / len(np.unique(points[:, 1]))
    return ConvergingLines(
        vanishing_px=x[:2],
        slopes=x[order[3:]],
        support=support[order[3:] - 3],
        bend_px2=float(x[2]),
        covariance=np.asarray(np.linalg.solve(information, np.eye(len(x)))[np.ix_(order, order)], dtype=np.float64),
        residual_px=rms,
    )


def _rows(points: FloatArray, line: Ints, count: int) -> list[int]:
    """The number of rows on which each of `count` lines is seen."""
    return [len(np.unique(points[line == i, 1])) for i in range(count)]


def _peaks(points: FloatArray, start: FloatArray, rays: Rays) -> FloatArray:
    """The slopes (k,) of the rays with the most points."""
    weights = rays.profile(points, *start)
    around = moving_average(weights)
    sigmas = (weights - around) / np.sqrt(4.0 * around + 20.0)
    slopes: list[float] = []
    of_step = rays.slopes(start[1])
    for at in np.argsort(-sigmas):
        if sigmas[at] < LEAST_WEIGHT or len(slopes) == MOST_LINES:
            break
        if all(abs(of_step[at] - other) > APART for other in slopes):
            slopes.append(float(of_step[at]))
    return np.array(slopes)


def _assigned(points: FloatArray, x: FloatArray, gate: float) -> Ints:
    """The line (n,) that each point belongs to, -1 for none."""
    if len(x) == 3:
        return np.full(len(points), -1, np.intp)
    down = np.maximum(points[:, 1:2] - x[1], 1.0)
    away = np.abs(points[:, :1] - (x[0] + x[3:] * down + x[2] / down))
    line = away.argmin(axis=1)
    return np.where(away.min(axis=1) < gate, line, -1)


def _kept(points: FloatArray, x: FloatArray, line: Ints, apart: float) -> tuple[FloatArray, Ints]:
    """Without lines on too few rows, and with the better of two similar ones; and the line (n,) of each point."""
    rows, slopes = _rows(points, line, len(x) - 3), x[3:]
    good: list[int] = []
    for i in np.argsort(rows)[::-1]:
        if rows[i] >= LEAST_ROWS and all(abs(slopes[i] - slopes[j]) > apart for j in good):
            good.append(int(i))
    renamed = np.full(len(rows) + 1, -1, np.intp)
    renamed[good] = np.arange(len(good))
    return np.concatenate((x[:3], x[3:][good])), renamed[line]


def _step(
    points: FloatArray, x: FloatArray, line: Ints, expected: FloatArray, prior: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """A Gauss-Newton step of (u0, v0, c, m_i), the information per px^2, and the RMS residual before it."""
    used = line >= 0
    down, at = np.maximum(points[used, 1] - x[1], 1.0), line[used]
    residual = points[used, 0] - (x[0] + x[3 + at] * down + x[2] / down)
    jacobian = np.zeros((len(down), len(x)))
    jacobian[:, 0], jacobian[:, 1], jacobian[:, 2] = 1.0, x[2] / down**2 - x[3 + at], 1.0 / down
    jacobian[np.arange(len(down)), 3 + at] = down
    information, pull = jacobian.T @ jacobian, jacobian.T @ residual
    matrix = information.copy()
    matrix[:3, :3] += prior
    pull[:3] += prior @ (expected - x[:3])
    return np.linalg.solve(matrix, pull), information, float(np.sqrt(np.mean(residual**2)))
