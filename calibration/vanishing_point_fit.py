"""The lines of one picture that meet in one point: fitted together, with what that point is worth.

Bright points on the lines of a road, and where those lines meet, with nothing known but the lens.

All lines along a straight road meet in one vanishing point. Ridges are looked for on rows, first at several breadths,
then, once that point is roughly known, at the one breadth that markings have: it grows in proportion with the way below
the point. Coordinates are ideal pixels: those of a lens without distortion and with the camera's fx, counted from the
principal point, u right and v down.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from automodel.geometry import CameraModel
from automodel.types import FloatArray, Image, Ints

MOST_LINES = 8
LEAST_WEIGHT = 3.0  # chance's sigmas by which a line's points outnumber those around it
LEAST_ROWS = 8  # on which a line is seen
APART = 0.25  # slopes of two lines differ by so much
GATES = ((1.0 / 45.0, 0.0), (1.0 / 90.0, 0.1), (1.0 / 180.0, 0.2))  # about a line, of the picture's width; as APART
LEAST_GATE_PX, LEAST_RMS_PX = 1.5, 0.3
BENDING = 1e-3  # of the picture's height squared: how much a road that counts as straight bends, one sigma
CORRELATED = 4.0  # points along one marking err together: so many count as one


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pencil:
    """The lines of one picture through one vanishing point: u = u0 + m_i (v - v0) + c / (v - v0), in ideal pixels.

    `vanishing_px` (2,) is (u0, v0); `slopes` (k,) are the m_i, rising, and `support` (k,) the shares of the rows below
    on which each line is seen. `bend_px2` is c, the same for all lines of a road of one curvature: seen from z above,
    f^2 z curvature / 2. `covariance` (3 + k, 3 + k) is that of (u0, v0, c, m_i), and `residual_px` the RMS distance of
    points from their line.
    """

    vanishing_px: FloatArray
    slopes: FloatArray
    support: FloatArray
    bend_px2: float
    covariance: FloatArray
    residual_px: float


def fit_pencil(
    points: FloatArray, near_px: FloatArray, rays: Rays, size: tuple[int, int], slack: float
) -> Pencil | None:
    """The lines through a point near `near_px` (2,); None where there are not two of them.

    `points` (n, 3) as `marking_points` gives them, `size` (width, height) of the picture [px]; the point keeps within
    about `slack` of the picture's width.
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
            line = _gathered(points, x, max(gate * width, LEAST_GATE_PX))
            x, line = _kept(points, x, line, apart)
            if len(x) < 5:
                return None
            step, information, rms = _step(points, x, line, np.concatenate((near_px, (0.0,))), prior)
            x = x + step
    information = information / (max(rms, LEAST_RMS_PX) ** 2 * CORRELATED)
    information[:3, :3] += prior
    order = np.concatenate((np.arange(3), 3 + np.argsort(x[3:])))
    support = np.array(_rows(points, line, len(x) - 3)) / len(np.unique(points[:, 1]))
    return Pencil(
        vanishing_px=x[:2],
        slopes=x[order[3:]],
        support=support[order[3:] - 3],
        bend_px2=float(x[2]),
        covariance=np.asarray(np.linalg.solve(information, np.eye(len(x)))[np.ix_(order, order)], dtype=np.float64),
        residual_px=rms,
    )


def _rows(points: FloatArray, line: Ints, count: int) -> list[int]:
    """On how many rows each of `count` lines is seen."""
    return [len(np.unique(points[line == i, 1])) for i in range(count)]


def _peaks(points: FloatArray, start: FloatArray, rays: Rays) -> FloatArray:
    """The slopes (k,) of the rays with most points."""
    weights = rays.profile(points, *start)
    around = usual(weights)
    sigmas = (weights - around) / np.sqrt(4.0 * around + 20.0)
    slopes: list[float] = []
    of_step = rays.slopes(start[1])
    for at in np.argsort(-sigmas):
        if sigmas[at] < LEAST_WEIGHT or len(slopes) == MOST_LINES:
            break
        if all(abs(of_step[at] - other) > APART for other in slopes):
            slopes.append(float(of_step[at]))
    return np.array(slopes)


def _gathered(points: FloatArray, x: FloatArray, gate: float) -> Ints:
    """The line (n,) that each point belongs to, -1 where to none."""
    if len(x) == 3:
        return np.full(len(points), -1, np.intp)
    down = np.maximum(points[:, 1:2] - x[1], 1.0)
    away = np.abs(points[:, :1] - (x[0] + x[3:] * down + x[2] / down))
    line = away.argmin(axis=1)
    return np.where(away.min(axis=1) < gate, line, -1)


def _kept(points: FloatArray, x: FloatArray, line: Ints, apart: float) -> tuple[FloatArray, Ints]:
    """The lines that are seen on rows enough, the better of two that are one, and the line (n,) of each point."""
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


Floats32 = NDArray[np.float32]

BREADTHS_PX = (3, 5, 9, 15, 25)
MARKINGS = (0.05, 0.08, 0.13, 0.2, 0.3)  # breadths of markings, in heights of the camera
ROWS = 150  # of a picture that are looked at, about
NOISES, NOISES_OF_MARKING, MOST_NOISES = 4.0, 2.5, 8.0  # by which a ridge stands out; more counts no more
MOST_SLOPE = 4.5  # |du / dv| of lines that are looked for
ACROSS, BINS = 2.0, 256  # widths of the picture, to each side, in which rays meet its lower edge, and their steps
MOST_OF_ONE = 40.0  # variances of chance: a single strong line says little about where lines meet
AHEAD = 0.2  # of the picture's width: a camera on a car looks about straight ahead, one sigma
BELOW = 1.0 / 24.0  # of the picture's height under the vanishing point: nearer to it all lines are one
_STEP = 0.02  # of slope between samples


def grey_of(image: Image) -> Image:
    """The picture (h, w), in grey."""
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def bright_points(image: Image, camera: CameraModel) -> FloatArray:
    """Points (n, 3) on bright ridges of any breadth: ideal u, v [px], and a weight."""
    grey = grey_of(image)
    height, width = grey.shape
    rows = np.unique(np.linspace(0, height - 1, min(height, ROWS)).astype(np.intp))
    values = grey[rows].astype(np.float32)
    noise = float(np.median(np.abs(np.diff(values, axis=1)))) + 1.0
    best = np.full(values.shape, -np.inf, np.float32)
    for breadth in (b for b in BREADTHS_PX if 3 * b <= min(width, height)):
        stands_out = _ridge(values, breadth, breadth) * np.float32(np.sqrt(breadth))
        here = best[:, breadth + breadth // 2 :][:, : stands_out.shape[1]]
        np.maximum(here, stands_out, out=here)
    row, column = _summits(best, NOISES * noise, 2)
    rays = camera.rays(np.stack((column, rows[row]), axis=-1).astype(np.float64))
    points = np.column_stack((camera.matrix[0, 0] * rays[:, :2], np.ones(len(row))))
    return points[np.isfinite(points).all(axis=1)]


def marking_points(image: Image, camera: CameraModel, vanishing_px: FloatArray, marking: float) -> FloatArray:
    """Points (n, 3) as `bright_points` gives them, on ridges that are a marking's breadth wide in their rows.

    `vanishing_px` (2,) may be wrong by some pixels; `marking` is the breadth in heights of the camera. The weight is
    how many noises a ridge stands out.
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
    values = cv2.remap(grey_of(image), maps[..., 0].copy(), maps[..., 1].copy(), cv2.INTER_LINEAR).astype(np.float32)
    breadth = max(round(marking / _STEP), 1)
    apart = breadth + max(breadth // 3, 1)
    ridge = _ridge(values, breadth, apart)
    begin = apart + breadth // 2
    known = inside[:, : ridge.shape[1]] & inside[:, -ridge.shape[1] :]
    noise = [
        float(np.median(np.abs(line[there]))) if there.any() else 0.0 for line, there in zip(ridge, known, strict=True)
    ]
    stands_out = np.where(known, ridge / (np.array(noise)[:, None] + 0.5), -np.inf).astype(np.float32)
    row, at = _summits(stands_out, NOISES_OF_MARKING, breadth // 2)
    weight = np.minimum(stands_out[row, at], MOST_NOISES)
    column = at + begin
    return np.column_stack((u[row, column], v[row, column], weight))


def _ridge(values: Floats32, breadth: int, apart: int) -> Floats32:
    """Means of `breadth` samples above the brighter of those `apart` on each side; shorter by what that needs."""
    sums = np.cumsum(np.pad(values, ((0, 0), (1, 0))), axis=1)
    means = (sums[:, breadth:] - sums[:, :-breadth]) / np.float32(breadth)
    return np.asarray(means[:, apart:-apart] - np.maximum(means[:, : -2 * apart], means[:, 2 * apart :]))


def _summits(values: Floats32, least: float, reach: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of what is above `least` and the largest within `reach` columns."""
    summit = values > least
    for k in range(1, reach + 1):
        summit[:, k:] &= values[:, k:] >= values[:, :-k]
        summit[:, :-k] &= values[:, :-k] > values[:, k:]
    row, column = summit.nonzero()
    return row, column


class Rays:
    """Sorts points by the rays from a point above, told apart by where they meet the picture's lower edge.

    Counted there the rays of a point high above are as far apart as those of a low one.
    """

    def __init__(self, camera: CameraModel) -> None:
        self.bottom = float(camera.rays((camera.matrix[0, 2], camera.height_px - 1.0))[1] * camera.matrix[0, 0])
        self._most, self._ahead = ACROSS * camera.width_px, AHEAD * camera.width_px

    def profile(self, points: FloatArray, u0: float, v0: float) -> FloatArray:
        """The weight (BINS,) of the points (n, 3) on each step of rays from (u0, v0)."""
        depth = self.bottom - v0
        across = (points[:, 0] - u0) * (depth / np.maximum(points[:, 1] - v0, 1.0))
        index = np.floor((across + self._most) * (0.5 * BINS / self._most))
        there = (index >= 0) & (index < BINS) & (np.abs(across) < MOST_SLOPE * depth)
        weights = np.bincount(index[there].astype(np.intp), weights=points[there, 2], minlength=BINS)
        return np.convolve(weights, (0.5, 1.0, 0.5), "same")

    def slopes(self, v0: float) -> FloatArray:
        """The slope du / dv (BINS,) of each step's ray."""
        across = (np.arange(BINS) + 0.5 - 0.5 * BINS) * (2.0 * self._most / BINS)
        return np.asarray(across / (self.bottom - v0), dtype=np.float64)

    def sharpness(self, points: FloatArray, u0: float, v0: float, most: float = math.inf) -> float:
        """How much the points lie on few rays from (u0, v0), each of which counts for `most` at most."""
        values = self.profile(points, u0, v0)
        around = usual(values)
        return float(np.minimum(np.maximum(values - around, 0.0) ** 2 / (around + 4.0), most).sum())

    def sharpest(
        self, pictures: Sequence[FloatArray], us: FloatArray, vs: FloatArray, below: float | None
    ) -> FloatArray:
        """The place (2,) of a grid with the largest sum of sharpness: of all points, or of those that lie `below` it.

        These are many, on anything: one ray of them counts for `MOST_OF_ONE` at most.
        """
        most = math.inf if below is None else MOST_OF_ONE
        score = np.zeros((len(vs), len(us)))
        for i, v0 in enumerate(vs):
            there = pictures if below is None else [p[p[:, 1] > v0 + below] for p in pictures]
            for j, u0 in enumerate(us):
                score[i, j] = sum(self.sharpness(points, u0, v0, most) for points in there)
        score *= np.exp(-0.5 * (us / self._ahead) ** 2)
        row, column = np.unravel_index(int(score.argmax()), score.shape)
        return np.array((us[column], vs[row]))


def usual(values: FloatArray) -> FloatArray:
    """What is usual around each of the steps of a profile."""
    return np.convolve(values, np.full(31, 1.0 / 31.0), "same")


def common_vanishing_point(pictures: Sequence[Image], camera: CameraModel) -> tuple[FloatArray, list[FloatArray]]:
    """Where (2,) the lines of all pictures meet, in ideal pixels, and the points (n, 3) on markings of each picture."""
    width, height, rays = camera.width_px, camera.height_px, Rays(camera)
    bright = [bright_points(image, camera) for image in pictures]
    best = np.zeros(2)
    u, v = np.arange(-0.35, 0.3501, 1.0 / 32.0) * width, np.arange(-0.9, 0.3001, 1.0 / 32.0) * height
    for share in (1.0, 0.5, 0.25):
        best = rays.sharpest(bright, u, v, BELOW * height)
        steps = share * np.linspace(-1.0, 1.0, 5) / 40.0
        u, v = best[0] + steps * width, best[1] + steps * height
    found: list[tuple[float, FloatArray, list[FloatArray]]] = []
    for marking in MARKINGS:
        points = list(map(partial(marking_points, camera=camera, vanishing_px=best, marking=marking), pictures))
        u, v = best[0] + 0.02 * width * np.linspace(-1, 1, 11), best[1] + 0.035 * height * np.linspace(-1, 1, 21)
        place = rays.sharpest(points, u, v, None)
        found.append((sum(rays.sharpness(p, *place) for p in points), place, points))
    return max(found, key=lambda each: each[0])[1:]
