"""Reflections of lamps and windows in a shiny floor, told from paint in one bird's-eye view.

An uneven floor stretches a reflection in the vertical plane through the camera and the lamp. Seen from above it is a
streak that points to the ground below the camera, whatever the lamp, the car's motion and an error of the camera's
height or pitch. Paint does so by chance only. Of what points there, the profile across decides: a marking is as wide as
markings are, with edges as sharp as the image's blur leaves them, on ground of any light; a streak is a bell of any
width.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from automodel.compiled import compiled
from automodel.geometry import GroundCamera, View
from automodel.perception.line_scan import SightedLine
from automodel.perception.markings.marking_width import MarkingWidth
from automodel.perception.markings.ridge_noise import QUARTILE
from automodel.types import Bools, Float32Array, FloatArray, Image, Ints

PIECES = 9  # of a view's length, where it has no windows of its own
SAMPLES = 8  # along a piece: every other row
LEAST = 1e-9  # of a shape's squares that the ground does not explain: a division by 0 is none
RISE = 0.2  # share of a profile's height by which it rises beyond a valley, where another thing begins
WHITE = 250  # grey level from which on a pixel may be cut off, and tells no height
MOST_NATS = 50.0  # log-odds of what is certain


@dataclass(frozen=True, slots=True, kw_only=True)
class ReflectionConfig:
    """Scales of `Reflections`.

    `pointing_rad`: sigma of the direction of a streak's piece; what is three of them off is paint. A larger one puts
    more paint to the test. `blur_px`: standard deviation of an image's blur by a lens that is out of focus; a car that
    turns while a frame is exposed adds its own. With a larger one wide streaks pass for blurred markings: with 5 a lamp
    of two markings' width is undecided. `change`: probability that one of two neighbouring pieces of connected pixels
    is of a streak and the other of paint that points to the camera as well. `reach`: of a profile to both sides, in
    marking widths; over a shorter one a wide streak looks like curved ground.
    """

    pointing_rad: float = 0.035
    blur_px: float = 2.0
    change: float = 0.01
    reach: float = 2.5


class Reflections:
    """Removes reflections from binary views (h, w), 0 or 255, of the ground that `mask` (h, w) says is visible.

    The view's length is cut into `pieces`; connected pixels in one of them are a piece of paint or of a streak.
    """

    def __init__(
        self, camera: GroundCamera, view: View, mask: Image, marking_width_m: float, markings: str, pieces: int = PIECES
    ) -> None:
        self.view, self.config, self._mask, self._pieces = view, ReflectionConfig(), mask, pieces
        self._camera, self._foot = camera, (float(camera.centre_m[0]), float(camera.centre_m[1]))
        self._most_rad = 3.0 * self.config.pointing_rad
        self._marking_px, self._marking_rows = marking_width_m / view.m_per_px, marking_width_m / view.m_per_row
        self._aspect = view.m_per_row / view.m_per_px
        reach = math.ceil(self.config.reach * self._marking_px)
        self._across: FloatArray = np.arange(-reach, reach + 1, dtype=np.float64)  # columns, of a line straight ahead
        self._rows_a_piece = view.height_px / pieces
        sharp_px = 1.0 / math.sqrt(12.0)  # a pixel's own blur
        # Three steps to that of a lens, and two beyond, for fast turns: with half as many, paint in between is lost.
        self._blurs_px: FloatArray = sharp_px * (self.config.blur_px / sharp_px) ** (np.arange(6) / 3.0)
        self._blur_px, self._marking_m = math.inf, marking_width_m
        self.doubtful: Image = np.zeros_like(mask)  # of the last view, what is left that points to the camera
        self._labels: Ints = np.zeros((view.height_px, view.width_px), np.intp)
        self._paint_odds: FloatArray = np.full(pieces, np.nan)
        x = view.x_far_m - (np.arange(pieces) + 0.5) * self._rows_a_piece * view.m_per_row
        self._wide_px = self._pixels_across(np.stack((x, 0.0 * x), axis=1), np.array((0.0, 1.0)))
        shapes = [self._shapes(wide_px) for wide_px in self._wide_px.tolist()]
        paint, streaks = (np.stack(every) for every in zip(*shapes, strict=True))
        sign = {"light": 1.0, "dark": -1.0, "both": 0.0}[markings]
        self._profiles = _Profiles(paint, len(self._blurs_px), streaks, sign)
        self.any_points_to_camera(np.empty((0, 2)))  # compiled now: no frame waits for it
        of_streaks(np.zeros(pieces), pieces, self.config.change)
        nothing = np.zeros((1, len(self._across)))
        self._profiles.log_odds(nothing, nothing == 0.0, np.zeros(1, np.intp), np.ones(1, np.intp))

    def turned(self, turn_rad: float | None) -> None:
        """The car has turned so far since the last frame, None: nobody knows; a frame is exposed no longer than that.

        By a turn phi an image moves by f phi; spread evenly over that, it is blurred by f phi / sqrt 12.
        """
        focal_px = float(self._camera.camera.matrix[0, 0])
        turn_px = math.inf if turn_rad is None else focal_px * turn_rad / math.sqrt(12.0)
        self._blur_px = math.hypot(self.config.blur_px, turn_px)

    def _pixels_across(self, middle_m: FloatArray, across: FloatArray) -> FloatArray:
        """How many pixels (n,) wide a marking is at places (n, 2) [m], across which is that direction."""
        half = 0.5 * self._marking_m * across
        left, right = self._camera.ground_to_px(middle_m + half), self._camera.ground_to_px(middle_m - half)
        return np.asarray(np.hypot(*(left - right).T), dtype=np.float64)

    def _blurs(self, piece: Ints, middle_m: FloatArray, across: FloatArray) -> Ints:
        """How many of the blurs paint may have (n,), in these pieces of the view, at places (n, 2) [m].

        What runs aslant is seen by fewer pixels across than what runs straight ahead: the same blur is more of it.
        """
        with np.errstate(divide="ignore"):
            blur_px = self._blur_px * self._wide_px[piece] / self._pixels_across(middle_m, across)
        first, second = self._blurs_px[:2]
        most = len(self._blurs_px)  # also of what lies beyond the image
        steps = np.nan_to_num(np.log(blur_px / first) / math.log(second / first), nan=most, posinf=most)
        return (np.rint(steps) + 1.0).clip(1, most).astype(np.intp)

    def any_points_to_camera(self, *lines_m: FloatArray) -> bool:
        """Whether any two neighbours among a line's points (n, 2) [m] lie in the direction of a streak."""
        x0, y0 = self._foot
        return any(_points_to(x0, y0, points.copy(), self._most_rad) for points in lines_m)  # of the one compiled kind

    def on_streaks(self, image: Image, points_m: FloatArray, paint: float = 0.0) -> Bools:
        """Which points (n, 2) [m] of a line, the nearest first, lie on a reflection in the camera's image.

        They do where neighbours among them lie in the direction of a streak, and the ground across them looks like one:
        its odds [nats] to be `paint` are less than these.
        """
        away, first = np.zeros(len(points_m), np.bool_), 0
        for last in range(1, len(points_m) + 1):
            if last < len(points_m) and self.any_points_to_camera(points_m[last - 1 : last + 1]):
                continue
            if last - first > 1:
                away[first:last] = self._streak(image, points_m[first:last], paint)
            first = last
        return away

    def _streak(self, image: Image, points_m: FloatArray, paint: float) -> bool:
        """Whether points (n, 2) [m] that point to the camera lie on a streak, and not on `paint`, by these odds."""
        way = np.diff(points_m, axis=0)
        along = way / np.hypot(*way.T)[:, None]
        left = np.stack((-along[:, 1], along[:, 0]), axis=1)
        ahead = points_m[:-1] + 0.5 * way - self._foot
        away_rad = np.arcsin(np.clip((left * ahead).sum(axis=1) / np.hypot(*ahead.T), -1.0, 1.0))
        places = points_m[:-1, None] + np.linspace(0.0, 1.0, SAMPLES)[:, None] * way[:, None]
        ground = places[:, :, None] - (self._across * self.view.m_per_px)[:, None] * left[:, None, None]
        pixels = self._camera.ground_to_px(ground.reshape(-1, 2))
        height, width = image.shape[:2]
        inside = ((pixels >= 0.0) & (pixels <= (width - 1.0, height - 1.0))).all(axis=1)
        inside = inside.reshape(len(way), SAMPLES, len(self._across)).all(axis=1)
        u, v = np.rint(np.nan_to_num(pixels)).astype(np.intp).T
        u, v = u.clip(0, width - 1), v.clip(0, height - 1)
        samples = np.asarray(image[v, u], dtype=np.float64).reshape(len(way), SAMPLES, len(self._across), -1)
        values = samples.mean(axis=(1, 3))
        usable = np.asarray(inside & (samples < WHITE).all(axis=(1, 3)), dtype=np.bool_)
        row = (self.view.x_far_m - ahead[:, 0] - self._foot[0]) / self.view.m_per_row
        piece = (row / self._rows_a_piece).astype(np.intp).clip(0, self._pieces - 1)
        blurs = self._blurs(piece, points_m[:-1] + 0.5 * way, left)
        known = self._profiles.log_odds(values, usable, piece, blurs)
        told = ~np.isnan(known)
        odds = known + 0.5 * (away_rad / self.config.pointing_rad) ** 2
        return bool(told.any() and odds[told].sum() < paint)

    def step(self, view: Image, lines: Image, paint: Image | None = None) -> Image:
        """`lines` (h, w), which are as wide as markings are, less the reflections, by the grey view (h, w).

        What `paint` (h, w) holds of them is none; it tells nothing of what it touches.
        """
        sure = np.zeros_like(lines) if paint is None else np.asarray(cv2.bitwise_and(lines, paint), dtype=np.uint8)
        lines = np.asarray(cv2.subtract(lines, sure), dtype=np.uint8)
        # Rows that miss a pixel in noise, up to two in a row, are of the same piece.
        count, labels = cv2.connectedComponents(cv2.dilate(lines, np.ones((3, 1), np.uint8)), connectivity=8)
        self._labels, self._paint_odds = np.asarray(labels, np.intp), np.full(count * self._pieces, np.nan)
        self.doubtful = np.zeros_like(lines)
        found = cv2.findNonZero(lines)
        if found is None:
            return sure
        column, row = found.reshape(-1, 2).T
        piece = labels[row, column] * self._pieces + (row / self._rows_a_piece).astype(np.intp)
        odds, pointing = self._odds(view, piece, row, column)
        away, doubtful = of_streaks(odds, self._pieces, self.config.change)[piece], pointing[piece]
        self.doubtful[row[doubtful], column[doubtful]] = 255
        if away.any():
            for image in (lines, self.doubtful):
                image[row[away], column[away]] = 0
        return lines | sure

    def told(self, lines: Sequence[SightedLine]) -> tuple[SightedLine, ...]:
        """The lines of the last view, with how likely each is a reflection by the profiles of its pieces alone.

        Where none of them was judged it is as likely as another thing.
        """
        return tuple(replace(line, reflection=self._reflection(line.points_m)) for line in lines)

    def _reflection(self, points_m: FloatArray) -> float:
        """How many times as likely a line with points (n, 2) [m] is one as paint, by the pieces that it lies on."""
        view, half = self.view, max(round(0.5 * self._marking_px), 1)
        row = ((view.x_far_m - points_m[:, 0]) / view.m_per_row).astype(np.intp).clip(0, view.height_px - 1)
        column = ((view.half_width_m - points_m[:, 1]) / view.m_per_px).astype(np.intp)
        columns = (column[:, None] + np.arange(-half, half + 1)).clip(0, view.width_px - 1)
        labels = self._labels[row[:, None], columns].max(axis=1)
        piece = np.unique((labels * self._pieces + (row / self._rows_a_piece).astype(np.intp))[labels > 0])
        odds = float(np.nansum(self._paint_odds[piece]))
        return math.exp(-min(max(odds, -MOST_NATS), MOST_NATS))

    def _odds(self, view: Image, piece: Ints, row: Ints, column: Ints) -> tuple[FloatArray, Bools]:
        """Log-odds (k,) [nats] that the pieces of the pixels (n,) are of paint; NaN where nothing is known.

        And which of them point to the camera (k,).
        """
        size = np.bincount(piece)
        odds = np.full(-(-len(size) // self._pieces) * self._pieces, np.nan)
        pointing = np.zeros(len(odds), np.bool_)
        large = np.flatnonzero(size > self._marking_px * self._marking_rows)
        if not len(large):
            return odds, pointing
        n = size[large]
        r, c, rr, rc = (np.bincount(piece, w)[large] / n for w in (row, column, row * row, row * column))
        spread = rr - r * r
        slope = (rc - r * c) / np.maximum(spread, 1e-9)  # columns a row
        ahead = self.view.x_far_m - (r + 0.5) * self.view.m_per_row - self._foot[0]
        left = self.view.half_width_m - (c + 0.5) * self.view.m_per_px - self._foot[1]
        away_rad = np.arctan2(left, ahead) - np.arctan(slope / self._aspect)
        half = np.sqrt(3.0 * spread)  # of the piece's rows
        long = 2.0 * half > max(self._marking_rows, self._marking_px)  # else the rows are too few for a direction
        odds[large[long]] = np.inf  # where they do not point to the camera
        maybe = np.flatnonzero((np.abs(away_rad) < self._most_rad) & long)
        if len(maybe):
            pointing[large[maybe]] = True
            paint = self._paint(view, r[maybe], c[maybe], slope[maybe], half[maybe])
            self._paint_odds[large[maybe]] = paint
            odds[large[maybe]] = (
                np.where(np.isnan(paint), np.inf, paint) + 0.5 * (away_rad[maybe] / self.config.pointing_rad) ** 2
            )
        return odds, pointing

    def _paint(
        self, view: Image, row: FloatArray, column: FloatArray, slope: FloatArray, half: FloatArray
    ) -> FloatArray:
        """Log-odds (n,) [nats] that pieces are markings, by their profiles; NaN at the rim of what is visible."""
        tilt = slope / self._aspect
        cos = 1.0 / np.hypot(1.0, tilt)
        count = SAMPLES
        along = ((2.0 * np.arange(count) + 1.0) / count - 1.0)[:, None] * half[:, None, None]  # rows
        across = self._across * cos[:, None, None]
        columns = (column[:, None, None] + slope[:, None, None] * along + across).astype(np.float32)
        rows = (row[:, None, None] + along - across * (tilt / self._aspect)[:, None, None]).astype(np.float32)
        shape = (len(row) * count, len(self._across))
        samples = cv2.remap(view, columns.reshape(shape), rows.reshape(shape), cv2.INTER_LINEAR)
        samples = samples.reshape(len(row), count, -1)
        values = samples.mean(axis=1, dtype=np.float64)
        seen = self._visible(rows[:, count // 2], columns[:, count // 2]) & (samples < WHITE).all(axis=1)
        piece = (row / self._rows_a_piece).astype(np.intp)
        x = self.view.x_far_m - (row + 0.5) * self.view.m_per_row
        y = self.view.half_width_m - (column + 0.5) * self.view.m_per_px
        blurs = self._blurs(piece, np.stack((x, y), axis=1), np.stack((-tilt * cos, cos), axis=1))
        return self._profiles.log_odds(values, seen, piece, blurs)

    def _visible(self, rows: Float32Array, columns: Float32Array) -> Bools:
        """Which samples of profiles (n, k) lie on ground that the camera sees."""
        height, width = self._mask.shape
        r, c = np.rint(np.stack((rows, columns))).astype(np.intp)
        inside = (r >= 0) & (c >= 0) & (r < height) & (c < width)
        return np.asarray(inside & (self._mask[r.clip(0, height - 1), c.clip(0, width - 1)] > 0))

    def _shapes(self, wide_px: float) -> tuple[FloatArray, FloatArray]:
        """Profiles (n, k) of markings so many pixels wide, the sharpest first, and of streaks."""
        config = self.config
        u = self._across / self._marking_px
        pixel = 0.5 / self._marking_px
        places = np.linspace(-0.5, 0.5, 5)  # of a piece's middle
        blurs = [math.hypot(min(px / max(wide_px, px), 1.0), pixel) for px in self._blurs_px]
        widths = np.geomspace(1.0 / MarkingWidth.CHANGE, MarkingWidth.CHANGE, 5)  # as wrong as one is used
        paint = [_blurred_box(u - at, width, blur) for blur in blurs for at in places for width in widths]
        bells = np.geomspace(pixel, 4.0 * config.reach, 24)  # the widest falls by 3 % over a profile: a curve
        streaks = [np.exp(-0.5 * ((u - at) / width) ** 2) for at in places for width in bells]
        return np.array(paint), np.array(streaks)


@compiled
def of_streaks(odds: FloatArray, pieces: int, change: float) -> Bools:
    """Which pieces (k,) are of a streak, by their log-odds [nats] to be of paint, NaN: not known.

    The pieces of connected pixels, as many as the view has, are seldom of another kind than the next one. A hidden
    Markov model along the view's length, by forward and backward passes (Rabiner 1989).
    """
    streaks = np.zeros(len(odds), np.bool_)
    known, before = np.empty(pieces), np.zeros(pieces)
    for first in range(0, len(odds), pieces):
        for k in range(pieces):
            is_known = not math.isnan(odds[first + k])
            known[k] = min(max(odds[first + k], -MOST_NATS), MOST_NATS) if is_known else 0.0
        for k in range(1, pieces):
            before[k] = _handed_on(before[k - 1] + known[k - 1], change)
        after = 0.0
        for k in range(pieces - 1, -1, -1):
            streaks[first + k] = before[k] + known[k] + after < 0.0 and odds[first + k] != math.inf
            after = _handed_on(after + known[k], change)
    return streaks


@compiled
def _handed_on(odds: float, change: float) -> float:
    """What log-odds [nats] of a piece say of its neighbour."""
    ratio = math.exp(odds)
    return math.log(((1.0 - change) * ratio + change) / (change * ratio + 1.0 - change))


@compiled
def _points_to(x0: float, y0: float, line_m: FloatArray, most_rad: float) -> bool:
    """Whether any two neighbours among a line's points (n, 2) [m] lie in one direction from (x0, y0)."""
    for i in range(1, len(line_m)):
        x, y = line_m[i]
        ahead, left = x - line_m[i - 1, 0], y - line_m[i - 1, 1]
        if abs(ahead * (y - y0) - left * (x - x0)) < most_rad * math.hypot(ahead, left) * (x - x0):
            return True
    return False


@compiled
def to_the_valleys(values: FloatArray) -> Bools:
    """Which samples of profiles (n, k) lie between the valleys next to their middles, beyond which they rise again.

    They rise by more than three sigmas of the difference of two samples; second differences tell the profile's noise.
    """
    middle, inside = values.shape[1] // 2, np.zeros(values.shape, np.bool_)
    for i in range(len(values)):
        bends = np.abs(values[i, 2:] - 2.0 * values[i, 1:-1] + values[i, :-2])
        noise = max(np.median(bends) / (QUARTILE * math.sqrt(6.0)), math.sqrt(1.0 / 12.0))
        top = max(values[i, middle - 1], values[i, middle], values[i, middle + 1])
        for side in (-1, 1):
            lowest = end = middle
            for k in range(1, middle + 1):
                at = middle + side * k
                if values[i, at] <= values[i, lowest]:
                    lowest = at
                elif values[i, at] - values[i, lowest] > max(
                    RISE * (top - values[i, lowest]), 3.0 * math.sqrt(2.0) * noise
                ):
                    break
                end = at
            else:
                lowest = end
            for at in range(min(lowest, middle), max(lowest, middle) + 1):
                inside[i, at] = True
    return inside


class _Profiles:
    """Likelihoods of profiles (n, k) as those of a marking and of a streak, of unknown height and noise.

    `paint`, `streaks` (m, j, k): the j shapes that each may have in each of m places, all as likely; those of paint are
    as many for each of so many `blurs`, the sharpest first. The ground below has a slope; below paint it may be curved
    too. The noise is unknown, so that the likelihood of a shape is that of Student's distribution. Half of the samples
    count, because neighbours share the image's pixels; rounding to grey levels is a noise that is known. `sign` of a
    marking's height, 0: either.
    """

    def __init__(self, paint: FloatArray, blurs: int, streaks: FloatArray, sign: float) -> None:
        self._paint, self._a_blur, self._streaks, self._sign = paint, paint.shape[1] // blurs, streaks, sign

    def log_odds(self, values: FloatArray, known: Bools, place: Ints, blurs: Ints) -> FloatArray:
        """Log-odds (n,) [nats] of a marking against a streak, of profiles (n, k) in places (n,), by `known` samples.

        `blurs` (n,): how many of them paint may have. What lies beyond a valley is another thing. NaN where less than
        half of a profile is left.
        """
        upright = self._sign * values
        if self._sign == 0.0:
            ends = 0.5 * (values[:, :1] + values[:, -1:])
            upright = np.where(values[:, values.shape[1] // 2, None] < ends, -values, values)
        known = known & to_the_valleys(upright)
        return _log_odds(values, known, place, self._paint, self._a_blur * blurs, self._streaks, self._sign)


@compiled
def _log_odds(
    values: FloatArray, known: Bools, place: Ints, paint: FloatArray, first: Ints, streaks: FloatArray, sign: float
) -> FloatArray:
    """See `_Profiles.log_odds`; `first` (n,): so many shapes of paint."""
    count, odds = values.shape[1], np.full(len(values), math.nan)
    away = np.linspace(-1.0, 1.0, count)
    for i in range(len(values)):
        at = np.flatnonzero(known[i])
        if 2 * len(at) <= count:
            continue
        ground = np.empty((3, len(at)))  # an orthonormal basis: level, slope, curve
        for power in range(3):
            ground[power] = away[at] ** power
            for lower in range(power):
                ground[power] -= (ground[power] * ground[lower]).sum() * ground[lower]
            ground[power] /= math.sqrt((ground[power] ** 2).sum())
        flat = _evidence(values[i][at], ground[:2], paint[place[i], : first[i]], at, sign)
        curved = _evidence(values[i][at], ground, paint[place[i], : first[i]], at, sign)
        curved -= 0.5 * math.log(len(at))  # what another parameter explains by chance (Schwarz 1978)
        marking = max(flat, curved) + math.log1p(math.exp(-abs(flat - curved))) - math.log(2.0)
        odds[i] = marking - _evidence(values[i][at], ground[:2], streaks[place[i]], at, sign)
    return odds


@compiled
def _evidence(values: FloatArray, ground: FloatArray, shapes: FloatArray, at: Ints, sign: float) -> float:
    """Log-likelihood of samples (c,) `at` (c,) of a profile, by shapes (j, k) on a ground that has a basis (b, c)."""
    rest = values.copy()
    for k in range(len(ground)):
        rest -= (rest * ground[k]).sum() * ground[k]
    squares, power = (rest**2).sum() + len(at) / 12.0, -0.25 * (len(at) - len(ground))
    powers = np.empty(len(shapes))
    for j in range(len(shapes)):
        height, length = 0.0, 0.0
        for k in range(len(at)):
            height += shapes[j, at[k]] * rest[k]
            length += shapes[j, at[k]] ** 2
        for b in range(len(ground)):
            along = 0.0
            for k in range(len(at)):
                along += shapes[j, at[k]] * ground[b, k]
            length -= along * along
        height = abs(height) if sign == 0.0 else max(sign * height, 0.0)
        powers[j] = power * math.log(squares - height * height / max(length, LEAST))
    most = powers.max()
    return float(most + math.log(np.exp(powers - most).mean()))


@compiled
def _blurred_box(u: FloatArray, width: float, blur: float) -> FloatArray:
    """A box of height 1 about 0, blurred with a standard deviation."""
    scale, box = 1.0 / (blur * math.sqrt(2.0)), np.empty(len(u))
    for i in range(len(u)):
        box[i] = 0.5 * (math.erf((u[i] + 0.5 * width) * scale) - math.erf((u[i] - 0.5 * width) * scale))
    return box
