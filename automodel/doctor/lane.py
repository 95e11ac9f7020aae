"""The lane's width as the camera sees it, against car.toml: what shows a wrong calibration of the ground at once."""

from __future__ import annotations

import statistics
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from automodel.config import CarConfig
from automodel.doctor.findings import Finding, fail, okay, skip, warn
from automodel.signals import LaneEstimate

LEAST_POINTS = 3  # of each line
LEAST_FRAMES = 5
WIDTH_OK, WIDTH_FAIL = 0.08, 0.25  # share of the width; drawn lanes are seen within 0.02
_ROUNDS = 5


def line_distance_m(left_m: NDArray[np.float64], right_m: NDArray[np.float64]) -> float | None:
    """Distance [m] of two parallel lines by their points (n, 2), (m, 2) in the body frame, left first.

    Both follow y = a + b x + c x^2 with b and c in common; the difference of a, seen square to the lines. The weights
    of points far off are reduced. None where there are too few points, or all at one place.
    """
    if min(len(left_m), len(right_m)) < LEAST_POINTS:
        return None
    x, y = np.vstack((left_m, right_m)).T
    middle = float(np.median(x))
    x = x - middle
    is_left = np.arange(len(x)) < len(left_m)
    terms = np.stack((is_left, ~is_left, x, x * x), axis=1).astype(np.float64)
    if np.linalg.matrix_rank(terms) < terms.shape[1]:
        return None
    weight = np.ones(len(x))
    for _ in range(_ROUNDS):
        found = np.linalg.lstsq(terms * weight[:, None], y * weight, rcond=None)[0]
        off = np.abs(terms @ found - y)
        weight = 1.0 / np.sqrt(1.0 + (off / max(2.0 * float(np.median(off)), 1e-4)) ** 2)
    return float((found[0] - found[1]) / np.hypot(1.0, found[2]))


def seen_width_m(estimate: LaneEstimate) -> float | None:
    """The lane's width [m] by this frame's points alone; None where not both lines are seen.

    Not `estimate.pose.width_m`: a filter has that begin at car.toml's width, and lets it go slowly.
    """
    left, right = estimate.left, estimate.right
    if left is None or right is None or not (left.seen and right.seen):
        return None
    return line_distance_m(left.points_m, right.points_m)


def judge_width(widths_m: Sequence[float], car: CarConfig) -> Finding:
    """The widths [m] of the frames in which both lines were seen."""
    name, wanted = "lane width", car.lane.width_m
    if len(widths_m) < LEAST_FRAMES:
        return skip(name, "no lane is seen", "put the car in the middle of a straight piece of the lane and run again")
    width = statistics.median(widths_m)
    off = width / wanted - 1.0
    what = f"{width:.3f} m seen, {wanted:.3f} m in car.toml ({off:+.0%})"
    if abs(off) <= WIDTH_OK:
        return okay(name, what)
    do = "measure the lane and set [lane] width_m; if that is right: automodel calibrate ground"
    return (fail if abs(off) > WIDTH_FAIL else warn)(name, what, do)
