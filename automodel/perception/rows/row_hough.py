"""A lane without prediction, by a Hough transform on a few image rows: its two lines, or one.

Ridges of a marking's width are searched along whole rows. Then every lane of a table is tried: the image columns at
which its lines cross the rows are precomputed, and each row with a ridge there votes for it. So no ridge is projected
onto the ground. A line of the table is a circle with a curvature c, a heading h and a lateral place a; an accumulator
(c, h, a) holds the votes.

On roads with large radii `LineIntegralSearch` is tried first: lines there are often rows of dots, and further ahead.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from automodel.compiled import compiled
from automodel.curves.foot import foot_on_circle
from automodel.geometry import GroundCamera
from automodel.geometry.line_projection import LineProjection
from automodel.perception.rows.brightness import Brightness
from automodel.perception.rows.lane_pair_search import InitialLane, LaneSearchConfig, LineIntegralSearch
from automodel.perception.rows.row_ground_lookup import GENTLE_LANES
from automodel.perception.rows.row_ridges import BLURRED, LINE, MARGIN, PER_MARKING, RowRidgeFilter
from automodel.types import Bools, Float32Array, Floats, Image, Ints

Votes = NDArray[np.int32]
Best = tuple[float, int, int, int, int]


@compiled
def row_peaks(height: Votes, within: Bools, least: Float32Array, reach: int) -> tuple[Ints, Ints]:
    """Row and column (n,) of the values above their row's `least`, `within` the image, highest within `reach`."""
    rows, columns = np.empty(height.size, np.intp), np.empty(height.size, np.intp)
    count, last = 0, height.shape[1] - 1
    for r in range(len(height)):
        for c in range(last + 1):
            if height[r, c] <= least[r] or not within[r, c]:
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
def row_votes(row: Ints, place: Floats, tolerance: Ints, rows: int, samples: int) -> Votes:
    """The votes (rows * samples + 1,) of the samples for a line that passes there; the last is for lines out of view.

    1 within the `tolerance` of a row about a ridge's place (n,).
    """
    votes = np.zeros(rows * samples + 1, np.int32)
    for i in range(len(row)):
        reach, middle = tolerance[row[i]], int(np.rint(place[i]))
        for k in range(max(middle - reach, 0), min(middle + reach + 1, samples)):
            votes[row[i] * samples + k] = 1
    return votes


@compiled
def accumulate(votes: Votes, table: Votes) -> Votes:
    """The accumulator (c, h, a): the sum of all rows' votes; `table` (rows, c, h, a) is the sample a line passes."""
    lines = np.zeros(table.shape[1:], np.int32)
    for r in range(table.shape[0]):
        for c in range(table.shape[1]):
            for h in range(table.shape[2]):
                for a in range(table.shape[3]):
                    lines[c, h, a] += votes[table[r, c, h, a]]
    return lines


@compiled
def best_pair(
    lines: Votes,
    fewest: int,
    loss: Floats,
    place: Floats,
    lateral: Floats,
    apart: Ints,
    width_loss: Floats,
    offset_loss: float,
) -> Best:
    """The best lane whose two lines have at least `fewest` votes each: score, (c, h, a) of its right line, and w.

    The left line lies `apart` (w,) steps of `lateral` (a,) [m] to the left of the right one. The score is the votes
    less `loss` (c, h), `width_loss` (w,), and `offset_loss` times the square of the car's offset; the car, at `place`
    (c, h) [m], must be in the lane.
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
                    offset = place[c, h] - lateral[a] - half
                    total = (
                        lines[c, h, a] + lines[c, h, left] - loss[c, h] - offset_loss * offset * offset - width_loss[w]
                    )
                    if abs(offset) <= half and total > best:
                        best, at_c, at_h, at_a, at_w = total, c, h, a, w
    return best, at_c, at_h, at_a, at_w


@compiled
def best_single(
    lines: Votes,
    fewest: int,
    loss: Floats,
    place: Floats,
    lateral: Floats,
    half_m: float,
    most_m: float,
    offset_loss: float,
) -> Best:
    """The best single line: score, (c, h, a), and the side of the car on which it lies (1: left, -1: right).

    As in `best_pair`; the middle of its lane is `half_m` beside it on the car's side, at most `most_m` from the car.
    """
    best, at_c, at_h, at_a, side = -np.inf, 0, 0, 0, 0
    for c in range(lines.shape[0]):
        for h in range(lines.shape[1]):
            for a in range(lines.shape[2]):
                if lines[c, h, a] < fewest:
                    continue
                distance = lateral[a] - place[c, h]
                offset = half_m - distance if distance > 0.0 else -half_m - distance
                total = lines[c, h, a] - loss[c, h] - offset_loss * offset * offset
                if abs(offset) <= most_m and total > best:
                    best, at_c, at_h, at_a, side = total, c, h, a, 1 if distance > 0.0 else -1
    return best, at_c, at_h, at_a, side


def _grid(most: float, step: float) -> Floats:
    """Evenly spaced values (n,) from -`most` to `most`, at most a `step` apart, with 0 in the middle."""
    return np.linspace(-most, most, 2 * math.ceil(most / step) + 1)


class RowHough:
    """Searches a lane on some rows of single images of one camera. Raises ValueError where no row shows the ground.

    With `both` the markings may be of either polarity: that of the last lane found is tried first.
    """

    TOLERANCE = 0.06  # lane widths: distance of a ridge from a lane's line
    SHARP = 0.75  # quantile of the edges that represents paint

    def __init__(
        self, camera: GroundCamera, config: LaneSearchConfig, brightness: Brightness, both: bool = False
    ) -> None:
        self.config, self._polarities = config, (brightness, brightness.negative())[: 1 + both]
        gentle = config.radius_lanes >= GENTLE_LANES
        self._integrals = LineIntegralSearch(camera, config) if gentle else None
        unit, near = config.lane_width_m, max(camera.first_visible_x_m(), config.reference_x_m)
        self._axis_x_m = near + 0.25 * config.ahead * unit
        x, self._rows, self._steps = self._choose_rows(camera, near, config.rows)
        width = camera.camera.width_px
        samples = max(math.ceil(width / self._steps.min()), 2 * MARGIN + 1)
        self._filter = RowRidgeFilter(len(x), samples, config.contrast)
        columns = np.minimum(np.rint(np.arange(samples) * self._steps[:, None]), width - 1.0)
        self._pixels: Ints = (self._rows[:, None] * width + columns).astype(np.intp)
        self._within = np.arange(samples) <= ((width - 1.0) / self._steps)[:, None] - MARGIN
        tolerance = math.ceil(self.TOLERANCE * unit / config.marking_m * PER_MARKING)
        self._tolerance: Ints = np.full(len(x), tolerance, np.intp)
        # Lines of the table that are next to each other part by twice the tolerance at most, on the farthest row.
        tightest, arm, apart = 1.0 / config.radius_lanes, 0.75 * config.ahead, 2.0 * self.TOLERANCE
        kappa, self._theta = _grid(tightest, apart / (0.5 * arm * arm)), _grid(config.heading_rad, apart / arm)
        self._kappa, self._lateral = kappa / unit, _grid(1.0 / config.narrowest, self.TOLERANCE) * unit
        self._kappa[self._kappa == 0.0] = 1e-6 / unit
        self._table = self._crossings(camera)
        self._edge = 0.0
        kappa, theta = self._kappa[:, None, None], self._theta[None, :, None]
        ahead = config.reference_x_m - self._axis_x_m
        feet = np.vectorize(foot_on_circle)(ahead * np.cos(theta), -ahead * np.sin(theta), kappa)
        # The reference point about each axis (c, h): arc length and distance to the left.
        self._s, self._d = (np.ascontiguousarray(part[..., 0]) for part in feet)
        heading = theta[..., 0] + kappa[..., 0] * self._s
        # The prior in nats, as the votes are; of heading and curvature one sigma is the largest of the table.
        self._loss = 0.5 * ((heading / config.heading_rad) ** 2 + (kappa[..., 0] * unit / tightest) ** 2)
        self._offset_loss = 0.5 / (config.sigma * unit) ** 2
        step = float(self._lateral[1] - self._lateral[0])
        narrow, wide = (round(width * unit / step) for width in (config.narrowest, 1.0 / config.narrowest))
        self._apart: Ints = np.arange(narrow, wide + 1)
        self._width_loss = 0.5 * (np.log(self._apart * step / unit) / config.sigma) ** 2

    def step(self, image: Image) -> InitialLane | None:
        """The lane with the most votes, less its prior loss; None where no lane has enough."""
        for brightness in self._polarities:
            lane = self._search(image, brightness)
            if lane is not None:
                self._polarities = tuple(sorted(self._polarities, key=lambda each: each is not brightness))
                return replace(lane, dark=brightness.dark)
        return None

    def _search(self, image: Image, brightness: Brightness) -> InitialLane | None:
        fitted = self._integrals.step(image, brightness) if self._integrals is not None else None
        if fitted is not None:
            return fitted
        lines = accumulate(self._votes(image, brightness), self._table)
        return max(self._pair(lines), self._single(lines), key=lambda found: found[0])[1]

    def _choose_rows(self, camera: GroundCamera, near_m: float, count: int) -> tuple[Floats, Ints, Floats]:
        """Rows evenly spaced in the image: ground ahead (r,) [m], row indices (r,), and width of a sample (r,) [px]."""
        config, unit = self.config, self.config.lane_width_m
        x = np.geomspace(near_m, near_m + config.ahead * unit, 8 * config.rows)
        line = LineProjection(camera).project(x + 0j, np.ones_like(x) + 0j, 0.0)
        v = line.place[1, : len(x)]
        good = (v >= 0.0) & (v <= camera.camera.height_px - 1.0)
        if np.count_nonzero(good) < 2:
            raise ValueError("pitch_rad: the image shows no ground where the lane's lines start")
        wanted = np.linspace(v[good].max(), v[good].min(), count)
        rows = np.unique(np.rint(wanted).astype(np.intp))
        at = [int(np.argmin(np.where(good, np.abs(v - row), np.inf))) for row in rows]
        step = -line.area[at] / line.along[1, at] * (config.marking_m / PER_MARKING)
        return x[at], rows, np.abs(step)

    def _votes(self, image: Image, brightness: Brightness) -> Votes:
        """The votes (rows * samples + 1,) of each sample, as in `row_votes`."""
        values = brightness.read(image, self._pixels)
        height = self._filter.heights(values, MARGIN, values.shape[1] - MARGIN)
        within = self._within[:, MARGIN:-MARGIN]
        least = self._filter.thresholds(height, within)
        row, at = row_peaks(height, within, least, PER_MARKING // 2)
        at += MARGIN
        ridges = self._filter.measure(values, row, at, least)
        line = ridges.flags[LINE]
        edges = ridges.edge[line]
        self._edge = float(np.sort(edges)[int(self.SHARP * len(edges))]) if len(edges) else 0.0
        line[line] = edges > BLURRED * self._edge  # a reflection is blurred
        return row_votes(row[line], (at + ridges.place)[line], self._tolerance, len(values), values.shape[1])

    def _pair(self, lines: Votes) -> tuple[float, InitialLane | None]:
        """The score of the best lane whose two lines are seen on enough rows, and the lane."""
        fewest = self.config.least_rows
        grid = self._loss, self._d, self._lateral
        score, c, h, a, w = best_pair(lines, fewest, *grid, self._apart, self._width_loss, self._offset_loss)
        if score == -math.inf:
            return score, None
        left = a + int(self._apart[w])
        if self._has_third_line(lines[c, h], a, left):
            return score, None
        right_m, left_m = float(self._lateral[a]), float(self._lateral[left])
        offset = float(self._d[c, h]) - 0.5 * (right_m + left_m)
        return score, self._lane(c, h, offset, left_m - right_m, True)

    def _has_third_line(self, lines: Votes, right: int, left: int) -> bool:
        """Whether a line as strong as the weaker of two places of `lines` (a,) lies amid the lane: joints of tiles."""
        margin = (left - right) // 4
        amid = int(lines[max(right + margin, 0) : max(left - margin, 0)].max(initial=0))
        beside = min(int(lines[place]) for place in (right, left) if 0 <= place < len(lines))
        return amid >= max(beside, self.config.least_rows)

    def _single(self, lines: Votes) -> tuple[float, InitialLane | None]:
        """The score of the best single line within a lane width of the car, and its lane."""
        unit, fewest = self.config.lane_width_m, 2 * self.config.least_rows
        grid = self._loss, self._d, self._lateral
        score, c, h, a, side = best_single(lines, fewest, *grid, 0.5 * unit, 0.45 * unit, self._offset_loss)
        if score == -math.inf:
            return score, None
        apart = round(unit / float(self._lateral[1] - self._lateral[0]))
        right = a if side < 0 else a - apart
        if self._has_third_line(lines[c, h], right, right + apart):
            return score, None
        offset = float(self._d[c, h] - self._lateral[a]) + 0.5 * side * unit
        return score, self._lane(c, h, offset, unit, False)

    def _lane(self, c: int, h: int, offset_m: float, width_m: float, pair: bool) -> InitialLane:
        """The lane at the foot of the reference point, for a curvature and a heading of the table."""
        kappa, s = float(self._kappa[c]), float(self._s[c, h])
        return InitialLane(
            offset_m=offset_m,
            heading_rad=float(self._theta[h]) + kappa * s,
            width_m=width_m,
            curvature_per_m=kappa / (1.0 - kappa * (float(self._d[c, h]) - offset_m)),
            measured_at_m=abs(s),
            pair=pair,
            edge=self._edge,
        )

    def _crossings(self, camera: GroundCamera) -> Votes:
        """The samples (rows, c, h, a) at which the lines cross the rows: indices of the votes.

        The axes are arcs through a point on body x ahead of the car; a line a to the left of one is a circle of radius
        1 / kappa - a about the same centre.
        """
        kappa, theta, a = self._kappa[:, None, None], self._theta[None, :, None], self._lateral[None, None, :]
        centre_x, centre_y = self._axis_x_m - np.sin(theta) / kappa, np.cos(theta) / kappa
        radius = 1.0 / kappa - a
        width, samples = camera.camera.width_px, self._within.shape[1]
        u = np.linspace(0.0, width - 1.0, 65)
        table = np.full(
            (len(self._rows), *np.broadcast_shapes(kappa.shape, theta.shape, a.shape)), len(self._rows) * samples
        )
        for r, row in enumerate(self._rows.tolist()):
            ground = camera.px_to_ground(np.stack((u, np.full_like(u, row)), axis=-1))
            known = np.isfinite(ground[:, 0])
            if not known.any():  # rounded to a row above the horizon, in an image of a few rows
                continue
            ground_x, ground_y, ground_u = ground[known, 0][::-1], ground[known, 1][::-1], u[known][::-1]
            x: Any = float(np.median(ground_x))
            for _ in range(3):  # a row of a tilted or distorted image is no line of equal distance ahead
                sine = (x - centre_x) / radius
                y = centre_y - radius * np.sqrt(np.maximum(1.0 - sine * sine, 0.0))
                x = np.interp(y, ground_y, ground_x)
            column = np.interp(y, ground_y, ground_u, left=np.nan, right=np.nan)
            good = (np.abs(sine) < 0.9) & np.isfinite(column)
            place = np.rint(np.where(good, column, 0.0) / self._steps[r]).astype(np.intp)
            table[r][good] = r * samples + np.minimum(place, samples - 1)[good]
        return table.astype(np.int32)
