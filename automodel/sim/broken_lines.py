"""Where the edge lines of a circuit have worn off altogether."""

from __future__ import annotations

import numpy as np

from automodel.sim.circuit_sections import BrokenLines

Span = tuple[float, float]

# of eight broken stretches three are on the left alone, three on the right alone, two on both sides
_SIDES = (("left",), ("left",), ("left",), ("right",), ("right",), ("right",), ("left", "right"), ("left", "right"))
_LINES_EACH = 5.0 / 8.0  # of the stretches hit one line
_APART_M = 5.0  # between two stretches, at least


def broken_spans(length_m: float, broken: BrokenLines) -> dict[str, list[Span]]:
    """Spans of the reference line over which the "left" and the "right" edge line are missing."""
    rng = np.random.default_rng((broken.seed, 31))
    mean_m = 0.5 * (broken.shortest_m + broken.longest_m)
    count = round(broken.share / _LINES_EACH * length_m / mean_m)
    # every length as often as every other, and every side: the share that is missing comes out as it was asked for
    drawn = (rng.permutation(count) + rng.uniform(0.0, 1.0, count)) / max(count, 1)
    lengths = broken.shortest_m + (broken.longest_m - broken.shortest_m) * drawn
    free_m = length_m - float((lengths + _APART_M).sum())
    if free_m < 0.0:
        raise ValueError(f"share: {broken.share} in pieces of {mean_m} m does not fit a road of {length_m:.0f} m")
    begins = np.sort(rng.uniform(0.0, free_m, count)) + np.cumsum(lengths + _APART_M) - lengths
    sides = [_SIDES[k % len(_SIDES)] for k in rng.permutation(count)]
    spans: dict[str, list[Span]] = {"left": [], "right": []}
    for begin, length, names in zip(begins.tolist(), lengths.tolist(), sides, strict=True):
        for name in names:
            spans[name].append((begin, begin + length))
    return spans
