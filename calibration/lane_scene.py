"""The stretches of a drive that show a road, and which stripe of either camera is which line of it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from automodel.geometry import CameraModel, GroundCamera
from automodel.types import FloatArray, Ints
from calibration.lane_bundle import (
    BODY,
    COMMON,
    Bundle,
    Prior,
    Rows,
    Unknowns,
    ground_points,
    lens_rays,
    spine_coordinates,
)
from calibration.lane_sights import DrivenPair, EyeSight, places
from calibration.views import CalibrationError

BODY_RAD = (math.radians(0.6), math.radians(1.0), math.radians(0.1))  # one sigma of a pair: yaw, pitch, roll
BODY_UP, BODY_ASIDE = 0.003, 0.02  # height, in camera heights; left, in lane widths
SLIP, SLIP_LANES = 0.005, 0.003  # ahead, of a pair: of the distance from the window's middle, and at least
SEPARATE_LANES = 0.2  # lane widths between two lines
BEND = 0.5  # slope of a road within a window that is too much of a bend
SEARCH_RAD, SEARCH = math.radians(5.0), 21  # of pitch and yaw: how far to each side, and in how many steps
SEARCH_PX = 20.0  # beyond, one error is as bad as another
NEARER = 0.02  # mean error, in `SEARCH_PX`, that a sigma of the ruler is worth
MATCHED_PX = (25.0, 6.0, 4.0)  # a stripe's median distance from its line, in each round of the fit
END_LANES = (0.5, 0.2, 0.15)  # distance of an end from its place, likewise
END_SHARP_LANES = 0.1  # lane widths of road to a pixel from which on an end is not used
LEAST_WINDOWS, LEAST_RIDGES, LEAST_LINES = 4, 40, 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Road:
    """What the left camera says of a window: spine (3,), `line` (l,) [m] to its left; `label` (m,) of its stripes.

    `label` counts the stripes of all pairs one after the other; -1 for one that is none of the lines.
    """

    spine: FloatArray
    line: FloatArray
    label: list[Ints]


class Scene:
    """The windows that show a road, what is known of it, and which stripes are which line."""

    def __init__(
        self,
        windows: Sequence[Sequence[DrivenPair]],
        sights: list[list[EyeSight]],
        left: GroundCamera,
        unit: float,
    ) -> None:
        self._left, self._unit = left, unit
        roads = [_road(places(window), seen, left, unit) for window, seen in zip(windows, sights, strict=True)]
        good = [w for w, road in enumerate(roads) if road is not None]
        if len(good) < LEAST_WINDOWS:
            raise CalibrationError(
                f"the left camera sees {LEAST_LINES} lines of a road without a tight bend in {len(good)} of "
                f"{len(roads)} stretches of the drive, expected {LEAST_WINDOWS}; drive farther along a marked lane, "
                "and look whether [lane] marking_width_m and markings are right"
            )
        self.used = [windows[w] for w in good]
        self._roads = [road for road in roads if road is not None]
        self._sights = [[(n, seen) for n, w in enumerate(good) for seen in sights[w]], list[tuple[int, EyeSight]]()]
        self._models = [left.camera, left.camera]
        self._place = np.concatenate([places(window) for window in self.used])
        self._first = np.cumsum([0, *(len(road.line) for road in self._roads)])
        self._at = Unknowns(
            common=np.zeros(COMMON),
            body=np.zeros((len(self._place), BODY)),
            spine=np.array([road.spine for road in self._roads]),
            line=np.concatenate([road.line for road in self._roads]),
            end=np.empty(0),
        )

    @property
    def pairs(self) -> int:
        """The number of pairs."""
        return len(self._place)

    def see_right(self, right: CameraModel, sights: list[list[EyeSight]]) -> None:
        """What the right camera sees in the windows used."""
        self._sights[1], self._models[1] = [(n, seen) for n, window in enumerate(sights) for seen in window], right

    def learn(self, found: Unknowns) -> None:
        """How the bodies stood, and the road, as a fit has found them."""
        self._at = replace(found, end=np.empty(0))

    def searched(self, prior: Prior) -> FloatArray:
        """The common numbers (12,) of the prior, with that pitch and yaw which put the right stripes best onto the
        lines."""
        rows, _ = self._ridges(1)
        _check_seen(len(rows.eye))
        turns = np.linspace(-SEARCH_RAD, SEARCH_RAD, SEARCH)
        cost, unit, pose = np.empty((SEARCH, SEARCH)), np.eye(COMMON), prior.start
        for i, pitch in enumerate(turns):
            for j, yaw in enumerate(turns):
                away = self._off(pose + pitch * unit[3] + yaw * unit[4], rows)
                cost[i, j] = np.minimum(np.abs(away).min(axis=1) / SEARCH_PX, 1.0).mean()
        pitch_sigma, yaw_sigma = prior.common[3:5]
        cost += NEARER * ((turns[:, None] / pitch_sigma) ** 2 + (turns / yaw_sigma) ** 2)
        best = np.unravel_index(int(np.argmin(cost)), cost.shape)
        return np.asarray(pose + turns[best[0]] * unit[3] + turns[best[1]] * unit[4])

    def bundle(self, pose: FloatArray, prior: Prior, matched_px: float, end_lanes: float) -> tuple[Bundle, Unknowns]:
        """The equations, with the right camera's stripes as it would see them from a pose; `end_lanes` 0: no ends."""
        parts, at_m = [self._left_ridges(), self._right_ridges(pose, matched_px)], np.empty(0)
        if end_lanes:
            ends, at_m = self._ends(pose, end_lanes)
            parts.append(ends)
        rows = Rows.joined(parts)
        order = np.argsort(rows.window, kind="stable")
        rows = rows.part(order)
        _check_seen(int((rows.eye == 1).sum()))
        whole = replace(prior, body=self._bodies())
        return Bundle((self._left, self._models[1]), rows, self._place, whole), replace(self._at, common=pose, end=at_m)

    def _bodies(self) -> FloatArray:
        """One sigma of each pair's body (p, 6)."""
        away = np.hypot(*self._place[:, :2].T)
        ahead = np.hypot(SLIP * away, SLIP_LANES * self._unit)
        rest = np.array((BODY_ASIDE * self._unit, BODY_UP * self._left.centre_m[2], *BODY_RAD))
        return np.column_stack((ahead, np.tile(rest, (len(away), 1))))

    def _ridges(self, eye: int) -> tuple[Rows, Ints]:
        """All ridges of one camera, without lines, and the stripe of each, counted through all pairs."""
        seen = [sight for _, sight in self._sights[eye]]
        return self._measured(
            eye, [sight.px for sight in seen], [sight.across for sight in seen], [sight.stripe for sight in seen]
        )

    def _measured(
        self, eye: int, pixels: list[FloatArray], ways: list[FloatArray], stripes: list[Ints]
    ) -> tuple[Rows, Ints]:
        """Rows, without lines, of what one camera measures in each pair: pixels (n, 2), the direction of the error
        (n, 2), and the stripe (n,); and that stripe, counted through all pairs."""
        rays, shifted = lens_rays(self._models[eye], np.concatenate(pixels), np.concatenate(ways))
        counts = [len(part) for part in pixels]
        first = np.cumsum([0, *(_count(sight) for _, sight in self._sights[eye])])
        rows = Rows(
            ray=rays,
            shifted=shifted,
            eye=np.full(len(rays), eye),
            pair=np.repeat(np.arange(len(pixels)), counts),
            window=np.repeat([w for w, _ in self._sights[eye]], counts),
            line=np.zeros(len(rays), np.intp),
            end=np.full(len(rays), -1),
        )
        return rows, np.concatenate([stripe + first[p] for p, stripe in enumerate(stripes)])

    def _left_ridges(self) -> Rows:
        rows, stripe = self._ridges(0)
        line = self._left_lines()[stripe]
        return replace(rows, line=line).part(line >= 0)

    def _left_lines(self) -> Ints:
        """The line of each stripe of the left camera, of all pairs; -1: of none."""
        return np.concatenate(
            [
                np.where(label >= 0, label + self._first[w], -1)
                for w, road in enumerate(self._roads)
                for label in road.label
            ]
        )

    def _right_ridges(self, pose: FloatArray, matched_px: float) -> Rows:
        rows, stripe = self._ridges(1)
        line = self._right_lines(pose, rows, stripe, matched_px)[stripe]
        return replace(rows, line=line).part(line >= 0)

    def _right_lines(self, pose: FloatArray, rows: Rows, stripe: Ints, matched_px: float) -> Ints:
        """The line of each stripe of the right camera, seen from a pose."""
        away = np.abs(self._off(pose, rows))
        found = np.full(int(stripe.max(initial=-1)) + 1, -1)
        for k in range(len(found)):
            usual = np.median(away[stripe == k], axis=0) if (stripe == k).any() else np.full(1, np.inf)
            best = int(np.argmin(usual))
            if usual[best] < matched_px:
                found[k] = best + self._first[rows.window[stripe == k][0]]
        return found

    def _off(self, pose: FloatArray, rows: Rows) -> FloatArray:
        """How far ridges are from each line of their window (n, most lines) [px]; infinite where there is no such."""
        at = replace(self._at, common=pose)
        (_, aside), (_, moved) = (self._on_road(at, rows, rays) for rays in (rows.ray, rows.shifted))
        scale = moved - aside
        counts = np.diff(self._first)
        lines = np.full((len(counts), int(counts.max())), np.inf)
        for w, count in enumerate(counts):
            lines[w, :count] = at.line[self._first[w] : self._first[w] + count]
        return np.asarray((aside[:, None] - lines[rows.window]) / np.where(np.abs(scale) > 1e-9, scale, 1e-9)[:, None])

    def _on_road(self, at: Unknowns, rows: Rows, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Along the spine and aside of it [m], (n,) each, where rays meet the ground."""
        points = ground_points((self._left, self._models[1]), at, rows, rays, self._place)
        return spine_coordinates(at.spine[rows.window], *points)[:2]

    def _ends(self, pose: FloatArray, end_lanes: float) -> tuple[Rows, FloatArray]:
        """The ends of dashes that the left camera sees, and those of the right one near them; and their places."""
        rows, stripe = self._ridges(1)
        labels = (self._left_lines(), self._right_lines(pose, rows, stripe, MATCHED_PX[1]))
        eyes = [self._end_rows(eye, pose, labels[eye]) for eye in (0, 1)]
        (left, left_kind, left_m), (right, right_kind, right_m) = eyes
        place_m, key, left_end = _clustered(left, left_kind, left_m, END_SHARP_LANES * 2.5 * self._unit)
        right_end = np.full(len(right.line), -1)
        for i in range(len(right.line)):
            same = np.flatnonzero(key == 2 * right.line[i] + right_kind[i])
            if len(same):
                best = same[int(np.argmin(np.abs(place_m[same] - right_m[i])))]
                if abs(place_m[best] - right_m[i]) < end_lanes * self._unit:
                    right_end[i] = best
        parts = (
            replace(left, end=left_end).part(np.isin(left_end, right_end)),
            replace(right, end=right_end).part(right_end >= 0),
        )
        rows = Rows.joined(parts)
        kept, renumbered = np.unique(rows.end, return_inverse=True)
        return replace(rows, end=renumbered), place_m[kept]

    def _end_rows(self, eye: int, pose: FloatArray, label: Ints) -> tuple[Rows, Ints, FloatArray]:
        """All ends that one camera sees sharply on lines: rows, kinds (n,), and where along the spine (n,) [m]."""
        seen = [sight for _, sight in self._sights[eye]]
        rows, stripe = self._measured(
            eye,
            [sight.end_px for sight in seen],
            [sight.end_out for sight in seen],
            [sight.end_stripe for sight in seen],
        )
        kind, rows = np.concatenate([sight.end_kind for sight in seen]), replace(rows, line=label[stripe])
        at = replace(self._at, common=pose)
        (along, _), (moved, _) = (self._on_road(at, rows, rays) for rays in (rows.ray, rows.shifted))
        sharp = (np.abs(moved - along) < END_SHARP_LANES * self._unit) & (rows.line >= 0)
        return rows.part(sharp), kind[sharp], along[sharp]


def _check_seen(ridges: int) -> None:
    if ridges < LEAST_RIDGES:
        raise CalibrationError(
            "the right camera does not see the lines that the left one sees; is [camera.right.extrinsics] within "
            "some degrees, and are left and right not swapped?"
        )


def _count(sight: EyeSight) -> int:
    return int(sight.stripe.max(initial=-1)) + 1


def _clustered(rows: Rows, kind: Ints, along_m: FloatArray, apart_m: float) -> tuple[FloatArray, Ints, Ints]:
    """Places (e,) [m] of ends of one kind on one line that lie together, their keys (e,), and the end (n,) of each."""
    key = 2 * rows.line + kind
    order = np.lexsort((along_m, key))
    new = np.ones(len(order), np.bool_)
    new[1:] = (np.diff(key[order]) != 0) | (np.diff(along_m[order]) > apart_m)
    number = np.cumsum(new) - 1
    end = np.empty(len(order), np.intp)
    end[order] = number
    count = int(number[-1]) + 1 if len(number) else 0
    place = np.array([np.median(along_m[end == e]) for e in range(count)])
    return place, key[order][new], end


def _road(place: FloatArray, sights: list[EyeSight], left: GroundCamera, unit: float) -> _Road | None:
    """The lines of a window by the left camera alone; None without two, and in a tight bend."""
    points, stripe, counts = [], [], [0]
    for (x, y, yaw), sight in zip(place, sights, strict=True):
        ground = left.px_to_ground(sight.px)
        cos, sin = math.cos(yaw), math.sin(yaw)
        points.append(np.column_stack((x + ground @ (cos, -sin), y + ground @ (sin, cos))))
        stripe.append(sight.stripe + counts[-1])
        counts.append(counts[-1] + _count(sight))
    at, label = np.concatenate(points), np.concatenate(stripe)
    if len(at) < LEAST_RIDGES or not np.isfinite(at).all():
        return None
    spine, aside = _spine(at, label, counts[-1], unit)
    reach = np.quantile(at[:, 0], (0.0, 1.0))
    if np.abs(spine[0] + reach * (2.0 * spine[1] + 3.0 * spine[2] * reach)).max() > BEND:
        return None
    offset = np.array([np.median(aside[label == k]) if (label == k).any() else np.nan for k in range(counts[-1])])
    order = np.argsort(offset)
    order = order[np.isfinite(offset[order])]
    cluster = np.cumsum(np.append(0, np.diff(offset[order]) > SEPARATE_LANES * unit))
    line, found = list[float](), np.full(counts[-1], -1)
    for c in range(int(cluster[-1]) + 1):
        its = order[cluster == c]
        if np.isin(label, its).sum() >= LEAST_RIDGES // 2:
            found[its] = len(line)
            line.append(float(np.median(aside[np.isin(label, its)])))
    if len(line) < LEAST_LINES:
        return None
    return _Road(spine=spine, line=np.array(line), label=[found[a:b] for a, b in itertools.pairwise(counts)])


def _spine(at: FloatArray, label: Ints, count: int, unit: float) -> tuple[FloatArray, FloatArray]:
    """The spine (3,) to which all stripes (n,) of points (n, 2) are parallel, and how far each point is aside (n,)."""
    spine = np.zeros(3)
    for _ in range(4):  # each point's stripe is an offset curve: the foot tells where along it lies
        foot, aside, _ = spine_coordinates(np.tile(spine, (len(at), 1)), *at.T)
        centred = aside - _means(aside, label, count)[label]
        usual = max(1.4826 * float(np.median(np.abs(centred))), 1e-6)
        weight = 1.0 / ((1.0 + (centred / (3.0 * usual)) ** 2) * (foot - foot.min() + unit) ** 2)
        powers = np.column_stack((foot, foot**2, foot**3))
        root = np.sqrt(weight)
        powers = powers - _means(powers, label, count, weight)[label]
        aside = aside - _means(aside, label, count, weight)[label]
        spine = spine + np.linalg.lstsq(powers * root[:, None], aside * root, rcond=None)[0]
    return spine, spine_coordinates(np.tile(spine, (len(at), 1)), *at.T)[1]


def _means(values: FloatArray, label: Ints, count: int, weight: FloatArray | None = None) -> FloatArray:
    """The means (count, ...) of values (n, ...) of each label."""
    weight = np.ones(len(label)) if weight is None else weight
    table = values.reshape(len(values), -1)
    total = np.maximum(np.bincount(label, weight, count), 1e-30)
    means = np.column_stack([np.bincount(label, weight * column, count) / total for column in table.T])
    return means.reshape(count, *values.shape[1:])
