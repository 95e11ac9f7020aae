"""Flat shapes on the ground (stripes along curves, filled outlines) and their drawing into coverage layers.

Lengths are in lane widths.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from automodel.geometry import GroundCamera
from automodel.types import FloatArray, FloatImage, Image

UNKNOWN = 1  # in a mask: a marking that is not visible; both answers are right
_FINER = 2  # layer pixels per image pixel
_BITS = 4  # fractional bits of drawn coordinates
_LABEL_PX = 3.0  # minimum width of a drawn label [layer px]
_WIDE = 0.15  # half width from which a stripe may extend beyond the view on both sides
_STEP_PX = 16.0  # length of the pieces in which a stripe is drawn [layer px]


class Ink(IntEnum):
    """The material of a shape; later ones cover earlier ones."""

    ROADBED = 0  # no paint: the extent of the road's own surface, beside which is the roadside
    BAND = 1  # a faint change of tone: wheel tracks, oil, a shoulder
    DARK = 2  # tar, joints, tyre marks
    BRIGHT = 3  # kerbs, cables, paper, light joints
    SECOND_PAINT = 4
    PAINT = 5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stripe:
    """A stripe along a polyline (n, 2) of the body frame.

    `half_width` is a number or an array (n,); `pattern` alternates lengths of paint and gap, empty for a solid stripe;
    `phase` is the position of the first point in the pattern. A `marking` is labelled, with `label_pattern` if that
    differs from the pattern of the paint.
    """

    points: FloatArray
    half_width: float | FloatArray
    ink: Ink
    pattern: tuple[float, ...] = ()
    phase: float = 0.0
    marking: bool = False
    strength: float = 1.0
    label_pattern: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Patch:
    """Closed outlines, each (n, 2) in the body frame, filled by the even-odd rule; never a marking."""

    outlines: tuple[FloatArray, ...]
    ink: Ink
    strength: float = 1.0


class Ribbon:
    """A curve on the ground with its left normals: converts curve coordinates (s, d) to the body frame."""

    def __init__(self, s: FloatArray, points: FloatArray, heading_rad: FloatArray) -> None:
        self.s = s
        self.points = points
        self.heading_rad = heading_rad
        self._rows = np.column_stack((points, -np.sin(heading_rad), np.cos(heading_rad)))

    def place(self, s: ArrayLike, d: ArrayLike) -> FloatArray:
        """Ground points (n, 2) at `s` along the curve and `d` to its left."""
        along, across = np.broadcast_arrays(np.asarray(s, dtype=np.float64), np.asarray(d, dtype=np.float64))
        x, y, nx, ny = (np.interp(along, self.s, self._rows[:, k]) for k in range(4))
        return np.stack((x + across * nx, y + across * ny), axis=-1)

    def local(self, s: float, points: ArrayLike) -> FloatArray:
        """Ground points (n, 2) of points (along, left) in the tangent frame of the curve at `s`."""
        p = np.asarray(points, dtype=np.float64)
        origin = self.place(s, 0.0)
        heading = float(np.interp(s, self.s, self.heading_rad))
        cos, sin = np.cos(heading), np.sin(heading)
        return np.asarray(origin + p @ np.array([[cos, sin], [-sin, cos]]))

    def between(self, start: float, end: float) -> FloatArray:
        """The curve's samples from `start` to `end`, including both."""
        inner = self.s[(self.s > start) & (self.s < end)]
        return np.concatenate(([start], inner, [end]))


def dense(outline: ArrayLike, pieces: int = 4) -> FloatArray:
    """A closed outline (n, 2) with every edge divided into `pieces`, for lens distortion."""
    corners = np.asarray(outline, dtype=np.float64)
    following = np.roll(corners, -1, axis=0)
    t = np.arange(pieces)[:, None] / pieces
    return np.concatenate([a + (b - a) * t for a, b in zip(corners, following, strict=True)])


def box(s0: float, s1: float, d0: float, d1: float) -> FloatArray:
    """The outline of a rectangle in (along, left)."""
    return np.array([[s0, d0], [s1, d0], [s1, d1], [s0, d1]])


class Canvas:
    """Layers (h, w) of a camera's image: the coverage of each pixel by an ink and by marking; `size` is in layer px.

    Paint is drawn with its exact coverage. The label of a marking is at least 1.5 px wide, so that far lines count, and
    is omitted for dashes shorter than half a pixel.
    """

    def __init__(self, camera: GroundCamera) -> None:
        self._camera = camera
        self.size = (camera.camera.height_px * _FINER, camera.camera.width_px * _FINER)
        self._layers: dict[Ink, Image] = {}
        self._label: Image = np.zeros(self.size, dtype=np.uint8)

    def stripe(self, stripe: Stripe) -> None:
        """Draw a stripe, and its label if it is a marking."""
        drawn = _Drawn.of(stripe, self)
        if drawn is None:
            return
        alpha = drawn.alpha * stripe.strength
        _fill(self._layer(stripe.ink), drawn.edges(0.0), alpha)
        if not stripe.marking:
            return
        if stripe.label_pattern is not None:
            drawn = _Drawn.of(replace(stripe, pattern=stripe.label_pattern), self)
            if drawn is None:
                return
        known = drawn.shown * np.clip(4.0 * drawn.alpha * stripe.strength, 0.0, 1.0)
        _fill(self._label, drawn.edges(_LABEL_PX), known)

    def patch(self, patch: Patch) -> None:
        """Fill the outlines of a patch."""
        rings = []
        for outline in patch.outlines:
            points = dense(outline)
            px = self.project(points[self._visible(points)])
            if len(px) > 2 and float(np.abs(px).max()) < 30000.0:
                rings.append(_fixed(px))
        if rings:
            value = round(255.0 * patch.strength)
            cv2.fillPoly(self._layer(patch.ink), rings, (value,), lineType=cv2.LINE_8, shift=_BITS)

    def coverage(self, ink: Ink) -> FloatImage | None:
        """The coverage of each pixel (h, w) by the ink, 0..1; None if nothing was drawn with it."""
        layer = self._layers.get(ink)
        return None if layer is None else self._reduced(layer).astype(np.float32) * np.float32(1.0 / 255.0)

    def label(self) -> Image:
        """The share of marking in each pixel (h, w), 0..255."""
        return self._reduced(self._label)

    def project(self, points: FloatArray) -> FloatArray:
        """Ground points (n, 2) to layer pixels (n, 2); NaN where not visible."""
        return (self._camera.ground_to_px(points) + 0.5) * _FINER - 0.5

    def in_view(self, left: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The end points (n, 2) of cross sections of a wide stripe, moved into the camera's field of view."""
        shares = np.linspace(0.0, 1.0, 17)[:, None, None]
        along = left + shares * (right - left)
        visible = self._visible(along)
        first, last = visible.argmax(axis=0), 16 - visible[::-1].argmax(axis=0)
        ends = []
        for inner, outer in ((first, first - 1), (last, last + 1)):
            low = inner / 16.0
            high = np.clip(outer, 0, 16) / 16.0
            for _ in range(6):
                middle = 0.5 * (low + high)
                found = self._visible(left + middle[:, None] * (right - left))
                low, high = np.where(found, middle, low), np.where(found, high, middle)
            ends.append(left + low[:, None] * (right - left))
        return ends[0], ends[1]

    def _visible(self, points: FloatArray) -> NDArray[np.bool_]:
        """Which ground points (..., 2) are within 85 deg of the camera's optical axis."""
        body = np.concatenate((points, np.zeros((*points.shape[:-1], 1))), axis=-1)
        cam = (body - self._camera.centre_m) @ self._camera.cam_from_body.T
        return np.asarray(cam[..., 2] > 0.09 * np.hypot(cam[..., 0], cam[..., 1]))

    def _layer(self, ink: Ink) -> Image:
        if ink not in self._layers:
            self._layers[ink] = np.zeros(self.size, dtype=np.uint8)
        return self._layers[ink]

    def _reduced(self, layer: Image) -> Image:
        size = (self.size[1] // _FINER, self.size[0] // _FINER)
        return np.asarray(cv2.resize(layer, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


class _Drawn:
    """A stripe in layer pixels: centre line and half-width vectors (n, 2), and the coverage of its pieces (n - 1,)."""

    def __init__(self, middle: FloatArray, half: FloatArray, alpha: FloatArray, shown: FloatArray) -> None:
        ahead = np.diff(middle, axis=0)
        ahead = np.concatenate((ahead, ahead[-1:]))
        ahead /= np.maximum(np.hypot(ahead[:, 0], ahead[:, 1]), 1e-9)[:, None]
        self._middle, self._half = middle, half
        self._normal = np.column_stack((-ahead[:, 1], ahead[:, 0]))
        self._normal *= np.where((half * self._normal).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
        self._width = 2.0 * (half * self._normal).sum(axis=1)  # the apparent width
        self.alpha = alpha * np.minimum(1.0, 0.5 * (self._width[1:] + self._width[:-1]))
        self.shown = shown

    @classmethod
    def of(cls, stripe: Stripe, canvas: Canvas) -> _Drawn | None:
        """The stripe in layer pixels; None if it is outside the image."""
        points = stripe.points
        if len(points) < 2:
            return None
        s = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))
        half = np.broadcast_to(np.asarray(stripe.half_width, dtype=np.float64), s.shape)
        at, on, shown = _pieces(stripe, s, canvas.project(points))
        tangent = np.gradient(points, s + 1e-9 * np.arange(len(s)), axis=0)
        rows = np.column_stack((points, -tangent[:, 1] * half, tangent[:, 0] * half))
        x, y, nx, ny = (np.interp(at, s, rows[:, k]) for k in range(4))
        ends = np.stack((x + nx, y + ny), -1), np.stack((x - nx, y - ny), -1)
        if half.max() > _WIDE:
            ends = canvas.in_view(*ends)
        sides = canvas.project(np.concatenate(ends))
        left, right = sides[: len(at)], sides[len(at) :]
        middle, side = 0.5 * (left + right), 0.5 * (left - right)
        height, width = canvas.size
        seen = np.isfinite(middle).all(axis=1)
        low, high = np.minimum(left, right), np.maximum(left, right)
        seen &= (high[:, 0] > -400) & (low[:, 0] < width + 400) & (high[:, 1] > -400) & (low[:, 1] < height + 400)
        seen &= np.abs(np.nan_to_num(np.hstack((left, right)), nan=1e9)).max(axis=1) < 15000.0
        keep = _thinned(middle, on, seen)
        if len(keep) < 2:
            return None
        use = seen[keep[:-1]] & seen[keep[1:]]
        on, shown = on[keep[:-1]] * use, shown[keep[:-1]]
        middle, side = np.nan_to_num(middle[keep]), np.nan_to_num(side[keep])
        return cls(middle, side, on, shown)

    def edges(self, least_px: float) -> FloatArray:
        """Quads (n - 1, 4, 2) with the apparent width, but at least `least_px`; drawing a polygon adds 1 px."""
        width = np.maximum(self._width, least_px)
        reach = np.where(self._width > _LABEL_PX, (width - 1.0) / np.maximum(self._width, 1e-6), 0.0)
        thin = 0.5 * np.maximum(width - 1.0, 0.0)[:, None] * self._normal
        half = np.where((self._width > _LABEL_PX)[:, None], self._half * reach[:, None], thin)
        left, right = self._middle + half, self._middle - half
        return np.stack((left[:-1], left[1:], right[1:], right[:-1]), axis=1)


def _pieces(stripe: Stripe, s: FloatArray, px: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The cuts of a stripe, and for each piece the share of paint and whether its label is shown, (n,) each.

    Dashes that appear shorter than a pixel are not drawn separately: their paint is spread over dashes and gaps.
    """
    if not stripe.pattern:
        return s, np.ones(len(s)), np.ones(len(s))
    period = sum(stripe.pattern)
    share = sum(stripe.pattern[0::2]) / period
    steps = np.hypot(*np.diff(px, axis=0).T) / np.maximum(np.diff(s), 1e-9)  # px per lane width
    steps = np.nan_to_num(np.append(steps, steps[-1]), nan=1e6)
    coarse = steps * period > 3.0 * len(stripe.pattern) / 2
    cuts = (np.cumsum((0.0, *stripe.pattern))[None, :-1] + period * np.arange(-1, s[-1] / period + 2)[:, None]).ravel()
    cuts = cuts - math.fmod(stripe.phase, period)
    cuts = cuts[(cuts > 0.0) & (cuts < s[-1])]
    cuts = cuts[np.interp(cuts, s, coarse.astype(np.float64)) > 0.5]
    at = np.unique(np.concatenate((s, cuts)))
    middle = 0.5 * (at + np.append(at[1:], at[-1] + 1e-6))
    bounds = np.cumsum(stripe.pattern)
    on = (np.searchsorted(bounds, np.mod(middle + stripe.phase, period), side="right") % 2 == 0).astype(np.float64)
    merged = np.interp(middle, s, coarse.astype(np.float64)) <= 0.5
    on = np.where(merged, share, on)
    dash_px = np.interp(middle, s, steps) * stripe.pattern[0]
    return at, on, np.where(merged, np.clip(2.0 * (dash_px - 0.5), 0.0, 1.0), 1.0)


def _thinned(middle: FloatArray, on: FloatArray, seen: NDArray[np.bool_]) -> NDArray[np.intp]:
    """The samples to draw: those where the paint starts or ends, and one every few pixels between."""
    length = np.concatenate(([0.0], np.cumsum(np.nan_to_num(np.hypot(*np.diff(middle, axis=0).T), nan=_STEP_PX))))
    marks = np.floor(length / _STEP_PX)
    change = np.zeros(len(on), dtype=bool)
    change[0] = change[-1] = True
    change[1:] |= (marks[1:] != marks[:-1]) | (on[1:] != on[:-1]) | (seen[1:] != seen[:-1])
    change[:-1] |= seen[1:] != seen[:-1]
    return np.flatnonzero(change)


def _fixed(px: FloatArray) -> NDArray[np.int32]:
    return np.round(px * (1 << _BITS)).astype(np.int32)


def _fill(layer: Image, quads: FloatArray, alpha: FloatArray) -> None:
    """Fill quads (n, 4, 2) with their coverage (n,), without those of coverage 0."""
    values = np.round(255.0 * alpha).astype(int)
    for quad, value in zip(_fixed(quads), values.tolist(), strict=True):
        if value > 0:
            cv2.fillConvexPoly(layer, quad, (value,), lineType=cv2.LINE_8, shift=_BITS)


def worn(noise: Image, lost: float, softness: float) -> Image:
    """A tile (512, 512) of the share of paint that is left, 0..255, after the share `lost` has worn off.

    The paint is lost first where the tile `noise` is lowest.
    """
    histogram = np.cumsum(np.bincount(noise.ravel(), minlength=256)) / noise.size
    threshold = float(np.searchsorted(histogram, lost))
    ramp = np.clip((np.arange(256) - threshold) / max(softness, 1.0) + 0.5, 0.0, 1.0)
    return np.asarray(cv2.LUT(noise, np.round(255.0 * ramp).astype(np.uint8)), dtype=np.uint8)
