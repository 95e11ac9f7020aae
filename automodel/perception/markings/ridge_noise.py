"""The noise of a ridge filter, and the height that is no noise: a threshold is a number of false alarms.

What the bare ground makes of a filter is its noise. It is measured on the filter's own response, so that it includes
the sensor's noise, averaged over the filter's length, and the ground's texture of that length. A median is used because
most places show bare ground.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, partial

import numpy as np

from automodel.compiled import compiled
from automodel.types import IntArray

QUARTILE = 0.6745  # third one of a normal distribution [sigma], and so the median of absolute values
FALSE_ALARMS = 1.0  # among all places that are searched at once; ten times as many lower thresholds by a quarter


def _exceeded(height: float, sides: float = 1.0) -> float:
    """The probability that m - max(l, r) exceeds a height: normal, m of variance 1, l and r of variance `sides`^2."""
    m = np.linspace(-8.0, 8.0, 161)
    below = np.array([0.5 + 0.5 * math.erf((x - height) / (sides * math.sqrt(2.0))) for x in m])
    density = np.exp(-0.5 * m * m) / math.sqrt(2.0 * math.pi)
    return float((density * below**2).sum() * (m[1] - m[0]))


def _height(exceeded: Callable[[float], float], rate: float) -> float:
    """The height that is exceeded at a rate, by bisection."""
    low, high = 0.0, 8.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if exceeded(middle) > rate else (low, middle)
    return 0.5 * (low + high)


def _median() -> float:
    """The median of |m - max(l, r)| over the standard deviation of m."""
    return _height(lambda height: _exceeded(height) + 1.0 - _exceeded(-height), 0.5)


def _many() -> float:
    """The share of places that half of those with a ridge above 0 are: paint and rounding change it little."""
    return 0.5 * _exceeded(0.0)


MEDIAN, MANY = _median(), _many()
FALSE_SAMPLES = 2  # length of a false ridge: so many neighbouring samples exceed a threshold at once


def rounding_noise(window: int) -> float:
    """The median of a filter's |height| [grey levels] by rounding to grey levels alone, for windows of some pixels."""
    return MEDIAN / math.sqrt(12.0 * window)


@cache
def least_ridge(places: float) -> float:
    """The height m - max(l, r) that white noise exceeds at `FALSE_ALARMS` of so many places, over its median.

    m, l, r are the means of three windows of equal length that do not overlap, the median is that of the absolute
    value; `places` is the number of independent ones.
    """
    return _height(_exceeded, _rate(places)) / MEDIAN


@cache
def least_ridge_over_many(places: float, sides: float) -> float:
    """As `least_ridge`, over the height that is exceeded at the share `MANY` of the places.

    The outer windows may be longer: `sides` is the standard deviation of l and r over that of m.
    """
    exceeded = partial(_exceeded, sides=sides)
    return _height(exceeded, _rate(places)) / _height(exceeded, MANY)


def _rate(places: float) -> float:
    return min(FALSE_ALARMS / max(places, 1.0), 0.25)


@compiled
def median(counts: IntArray) -> float:
    """The median of whole numbers from 0 on, so many of each, which stands for all values half a unit around it."""
    below, total = 0, counts.sum()
    for k in range(len(counts)):
        if counts[k] > 0 and 2 * (below + counts[k]) >= total:
            low = max(k - 0.5, 0.0)
            return low + (k + 0.5 - low) * (0.5 * total - below) / counts[k]
        below += counts[k]
    return 0.0
