"""Where one frame's samples of a line lie beside the car."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from automodel.estimation.line_spline import SampledLine
from automodel.estimation.theta_line import ThetaLine
from automodel.types import FloatArray

NEAR_SAMPLES = 16  # of a line that does not reach the car: those next to it


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Place:
    """Where samples lie: arc lengths (n,) from the reference point's foot, and the line's distance there [m].

    `nearest` is the sample next to the foot; `beside` tells whether the samples reach the foot.
    """

    s_m: FloatArray
    lateral_m: float
    nearest: int
    beside: bool


def locate(sampled: SampledLine, reference_m: tuple[float, float], known: ThetaLine | None) -> Place:
    """Place samples beside the reference point.

    A line that begins ahead of the foot is joined to it along the known line, or else along its own arc.
    """
    away = reference_m - sampled.points_m
    i = int(np.einsum("ij,ij->i", away, away).argmin())
    last = len(sampled.s_m) - 1
    s, theta = float(sampled.s_m[i]), float(sampled.theta_rad[i])
    cos, sin = math.cos(theta), math.sin(theta)
    x, y = away[i].tolist()
    ahead, left = x * cos + y * sin, y * cos - x * sin
    beside = not ((i == 0 and ahead < 0.0) or (i == last and ahead > 0.0))
    if not beside and known is not None:
        start = sampled.points_m[i].tolist()
        foot = known.foot((start[0], start[1]), near_s_m=-ahead)
        return Place(s_m=sampled.s_m + (foot.s_m - s), lateral_m=known.lateral_m, nearest=i, beside=False)
    reach = 1 if beside else NEAR_SAMPLES
    low, high = max(i - reach, 0), min(i + reach, last)
    kappa = float((sampled.theta_rad[high] - sampled.theta_rad[low]) / (sampled.s_m[high] - sampled.s_m[low]))
    u, v = max(1.0 - kappa * left, 0.2), kappa * ahead
    angle = math.atan2(v, u)
    step = angle / kappa if abs(angle) > 1e-6 else ahead / u
    lateral = -(2.0 * left - kappa * (ahead * ahead + left * left)) / (1.0 + math.hypot(u, v))
    return Place(s_m=sampled.s_m - (s + step), lateral_m=lateral, nearest=i, beside=beside)
