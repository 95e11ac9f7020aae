"""The centerline between two lines: their samples mapped onto it, and one cubic theta(s) fitted to them.

Cudrano et al. 2020, section V. Lines and centerline share the centre of curvature at each place, so a point keeps its
direction when it is mapped, and only its arc length changes. With d the line's signed distance from the centerline
(left positive) and kappa the centerline's curvature, ds_line = r ds_centre with r = 1 - kappa d; the paper's eq. (17)
multiplies by r where it has to divide. As kappa ds_centre = d theta,

    ds_centre = ds_line / (1 - kappa d) = ds_line + d dtheta

which has a closed integral, holds for parallel lines of any shape, and needs no centre of curvature: neither that of
the last frame, eq. (15), nor one at infinity.
"""

from __future__ import annotations

import math
import operator
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from automodel.estimation.theta.heading_polynomial import ORDER, HeadingPolynomial
from automodel.estimation.theta.theta_rls import ThetaRls, ThetaRlsConfig
from automodel.estimation.theta.tracked_line import TrackedLine
from automodel.types import FloatArray

_NOTHING = np.empty(0)


def to_centerline(s_line_m: ArrayLike, theta_rad: ArrayLike, theta_foot_rad: float, distance_m: float) -> FloatArray:
    """Arc length (n,) on the centerline of points at arc lengths (n,) on a line, both from the same perpendicular.

    `theta_rad` (n,) are the directions at the points and `theta_foot_rad` that at s = 0; `distance_m` is the line's
    distance from the centerline, left positive.
    """
    turn = np.asarray(theta_rad, dtype=np.float64) - theta_foot_rad
    return np.asarray(np.asarray(s_line_m, dtype=np.float64) + distance_m * turn)


class _Side(NamedTuple):
    rls: ThetaRls
    line: HeadingPolynomial
    lateral: float  # [lane widths] distance of the line from the centerline


class CenterlineFusion:
    """The centerline over time: `rls.line` is its curve, None until a line was seen.

    `config` is that of the lines.
    """

    def __init__(self, config: ThetaRlsConfig) -> None:
        self.rls = ThetaRls(config)

    def update(self, left: ThetaRls | None, right: ThetaRls | None, width_m: float, width_variance_m2: float) -> None:
        """Update by this frame's lines, either of which may be missing, and the estimate of the lane's width.

        The centerline bisects the lines; the width stands in, by its weight, for a line that is missing or uncertain.
        Without any line nothing changes.
        """
        pairs = ((left, 0.5), (right, -0.5))
        sides = [_Side(rls, rls.line, lateral) for rls, lateral in pairs if rls is not None and rls.line is not None]
        if not sides:
            return
        s, theta, weight = _mapped(sides, _width(sides, width_m, width_variance_m2))
        if not len(s):
            return
        lateral, variance = _distance(sides, width_m, width_variance_m2)
        if self.rls.line is None:
            self.rls.start(s, theta, weight, lateral, variance)
        else:
            self.rls.update(s, theta, weight, lateral, variance)


def _width(sides: list[_Side], width_m: float, width_variance_m2: float) -> float:
    """The lane's width [m] at the car: the estimate and the lines' distance, weighted by their variances."""
    if len(sides) < 2:
        return width_m
    left, right = sides
    variance = left.rls.lateral_variance_m2 + right.rls.lateral_variance_m2
    measured = min(max(left.line.lateral_m - right.line.lateral_m, 0.3 * width_m), 3.0 * width_m)
    return (measured * width_variance_m2 + width_m * variance) / max(width_variance_m2 + variance, 1e-12)


def _mapped(sides: list[_Side], width_m: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Samples of the lines mapped onto the centerline: arc lengths, directions and weights (n,)."""
    directions = [side.line.heading_at(0.0) for side in sides]
    shares = [1.0 / (side.rls.heading_variance_here() + side.rls.config.model_rad**2) for side in sides]
    direction = sum(map(operator.mul, directions, shares)) / sum(shares)
    parts = []
    for (rls, line, lateral), own in zip(sides, directions, strict=True):
        d = lateral * width_m
        if not line.s_max_m > line.s_min_m:
            continue
        count = math.ceil((line.s_max_m - line.s_min_m) / (TrackedLine.STEP_LANES * rls.config.lane_width_m))
        s = np.linspace(line.s_min_m, line.s_max_m, max(count, ORDER) + 1)
        theta, weight = rls.samples(s)
        on_centre = to_centerline(s, theta, own, d)
        # eq. (16): the feet on lines that are not parallel do not lie on one perpendicular
        on_centre += line.lateral_m * math.sin(direction - own) * (1.0 + line.curvature_at(0.0) * d)
        parts.append((on_centre, theta, weight))
    if len(parts) < 2:
        return parts[0] if parts else (_NOTHING, _NOTHING, _NOTHING)
    # a longer line has its samples farther apart: weigh both lines equally where both are
    spans = [max(float(on_centre[-1] - on_centre[0]), 0.0) for on_centre, _, _ in parts]
    longest = max(*spans, 1e-9)
    s, theta, weight = (np.concatenate(part) for part in zip(*parts, strict=True))
    return s, theta, weight * np.repeat([span / longest for span in spans], [len(part[0]) for part in parts])


def _distance(sides: list[_Side], width_m: float, width_variance_m2: float) -> tuple[float, float]:
    """The centerline's distance from the reference point [m] and its variance: least squares over lines and width.

    With two certain lines this is their bisector, whatever the width; with one, that line and half the width.
    """
    if len(sides) < 2:
        (rls, line, lateral), *_ = sides
        return line.lateral_m - lateral * width_m, rls.lateral_variance_m2 + 0.25 * width_variance_m2
    left, right = sides
    skew = max(math.cos(0.5 * (left.line.heading_at(0.0) - right.line.heading_at(0.0))), 0.5)
    from_left, from_right = left.line.lateral_m / skew - 0.5 * width_m, right.line.lateral_m / skew + 0.5 * width_m
    v_left, v_right = left.rls.lateral_variance_m2, right.rls.lateral_variance_m2
    share_left, share_right = v_right + 0.5 * width_variance_m2, v_left + 0.5 * width_variance_m2
    total = max(v_left + v_right + width_variance_m2, 1e-12)
    distance = (share_left * from_left + share_right * from_right) / total
    return distance, (v_left * v_right + 0.25 * (v_left + v_right) * width_variance_m2) / total
