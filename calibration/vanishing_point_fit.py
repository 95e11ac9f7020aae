"""The lines of one picture that meet in one point: fitted together, with what that point is worth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from automodel.types import FloatArray, Ints
from calibration.picture_lines import BELOW, Rays, usual

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
