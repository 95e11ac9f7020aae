"""The noise of a ridge filter, and the height that is no noise: a threshold is a number of false alarms.

What the bare ground makes of a filter is its noise. It is measured on the filter's own response, so that it includes
the sensor's noise, averaged over the filter's length, and the ground's texture of that length. A median is used because
most places show bare ground.
"""

from __future__ import annotations

import math

import numpy as np

FALSE_ALARMS = 1.0  # among all places that are searched at once; ten times as many lower thresholds by a quarter


def _exceeded(height: float) -> float:
    """The probability that m - max(l, r) exceeds a height, for independent standard normal m, l and r."""
    m = np.linspace(-8.0, 8.0, 161)
    below = np.array([0.5 + 0.5 * math.erf((x - height) / math.sqrt(2.0)) for x in m])
    density = np.exp(-0.5 * m * m) / math.sqrt(2.0 * math.pi)
    return float((density * below**2).sum() * (m[1] - m[0]))


def _root(rising: float, low: float, high: float, of_absolute: bool) -> float:
    """The height that is exceeded with a probability, by bisection; `of_absolute`: the absolute value exceeds it."""
    for _ in range(50):
        middle = 0.5 * (low + high)
        exceeded = _exceeded(middle) + ((1.0 - _exceeded(-middle)) if of_absolute else 0.0)
        low, high = (middle, high) if exceeded > rising else (low, middle)
    return 0.5 * (low + high)


MEDIAN = _root(0.5, 0.0, 8.0, True)  # the median of |m - max(l, r)| over the standard deviation of m


def least_ridge(places: float) -> float:
    """The height m - max(l, r) that white noise exceeds at `FALSE_ALARMS` of so many places, over its median.

    m, l, r are the means of three windows of equal length that do not overlap, the median is that of the absolute
    value; `places` is the number of independent ones.
    """
    return _root(min(FALSE_ALARMS / places, 0.25), 0.0, 8.0, False) / MEDIAN
