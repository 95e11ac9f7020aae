"""The loops of a start from nothing: peaks of rows, what they say for lines of a table, and the best lane of them.

A table's lines have a curvature c, a heading h and a lateral place a; `lines` (c, h, a) is what rows say for each.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from automodel.compiled import compiled
from automodel.types import Bools, Floats, Ints

Votes = NDArray[np.int32]
Best = tuple[float, int, int, int, int]


@compiled
def peaks(height: Votes, within: Bools, least: float, reach: int) -> tuple[Ints, Ints]:
    """Row and column (n,) of what is above `least`, `within`, and no lower than anything `reach` columns beside it."""
    rows, columns = np.empty(height.size, np.intp), np.empty(height.size, np.intp)
    count, last = 0, height.shape[1] - 1
    for r in range(len(height)):
        for c in range(last + 1):
            if height[r, c] <= least or not within[r, c]:
                continue
            highest = True
            for k in range(max(c - reach, 0), min(c + reach, last) + 1):
                if height[r, k] > height[r, c]:
                    highest = False
                    break
            if highest:
                rows[count], columns[count] = r, c
                count += 1
    return rows[:count], columns[:count]


@compiled
def votes(row: Ints, place: Floats, tolerance: Ints, rows: int, samples: int, near: int) -> Votes:
    """What samples (rows * samples + 1,) say for a line that passes there; the last one stands for nowhere.

    1 within the `tolerance` of a row about a ridge's place (n,), `near` within half of it.
    """
    said = np.zeros(rows * samples + 1, np.int32)
    for share in range(1, 3):
        for i in range(len(row)):
            reach, middle = tolerance[row[i]] // share, int(np.rint(place[i]))
            for k in range(max(middle - reach, 0), min(middle + reach + 1, samples)):
                said[row[i] * samples + k] = 1 if share == 1 else near
    return said


@compiled
def summed(said: Votes, table: Votes) -> Votes:
    """What all rows say for the lines: `table` (rows, c, h, a) tells which sample a line passes."""
    lines = np.zeros(table.shape[1:], np.int32)
    for r in range(table.shape[0]):
        for c in range(table.shape[1]):
            for h in range(table.shape[2]):
                for a in range(table.shape[3]):
                    lines[c, h, a] += said[table[r, c, h, a]]
    return lines


@compiled
def best_pair(
    lines: Votes, fewest: int, loss: Floats, aside: Floats, lateral: Floats, apart: Ints, width_loss: Floats, off: float
) -> Best:
    """The score of the best lane whose two lines both have `fewest` votes, its right line, and how far its left one is.

    Steps of `lateral` (a,) [m] lie between the two, one of `apart` (w,), which lose `width_loss` (w,). A lane loses
    `loss` (c, h), and `off` for the square of the car's distance from its middle; the car at `aside` (c, h) [m] must
    stand in it.
    """
    best, at_c, at_h, at_a, at_w = -np.inf, 0, 0, 0, 0
    for c in range(lines.shape[0]):
        for h in range(lines.shape[1]):
            for a in range(lines.shape[2]):
                if lines[c, h, a] < fewest:
                    continue
                for w in range(len(apart)):
                    left = a + apart[w]
                    if left >= len(lateral):
                        break
                    if lines[c, h, left] < fewest:
                        continue
                    half = 0.5 * (lateral[left] - lateral[a])
                    offset = aside[c, h] - lateral[a] - half
                    total = lines[c, h, a] + lines[c, h, left] - loss[c, h] - off * offset * offset - width_loss[w]
                    if abs(offset) <= half and total > best:
                        best, at_c, at_h, at_a, at_w = total, c, h, a, w
    return best, at_c, at_h, at_a, at_w


@compiled
def best_single(
    lines: Votes, fewest: int, loss: Floats, aside: Floats, lateral: Floats, half_m: float, most_m: float, off: float
) -> Best:
    """The score of the best line, its place, and the side of the car (1: left) that it lies on.

    As in `best_pair`; the middle of its lane is `half_m` beside it, on the car's side, and `most_m` from it at most.
    """
    best, at_c, at_h, at_a, side = -np.inf, 0, 0, 0, 0
    for c in range(lines.shape[0]):
        for h in range(lines.shape[1]):
            for a in range(lines.shape[2]):
                if lines[c, h, a] < fewest:
                    continue
                distance = lateral[a] - aside[c, h]
                offset = half_m - distance if distance > 0.0 else -half_m - distance
                total = lines[c, h, a] - loss[c, h] - off * offset * offset
                if abs(offset) <= most_m and total > best:
                    best, at_c, at_h, at_a, side = total, c, h, a, 1 if distance > 0.0 else -1
    return best, at_c, at_h, at_a, side
