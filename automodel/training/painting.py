"""Draws stripes and outlines of the ground into coverage layers, and wears paint off."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from automodel.geometry import GroundCamera
from automodel.training.shapes import Ink, Patch, Stripe, dense
from automodel.types import FloatArray, FloatImage, Image

_FINER = 2  # the layers' pixels a picture's pixel
_BITS = 4  # of a pixel's fraction in drawn coordinates
_LABEL_PX = 3.0  # least width of a drawn label, in the layers' pixels
_WIDE = 0.15  # half width from which a stripe may reach out of view on both sides
_STEP_PX = 16.0  # length of the pieces that a stripe is drawn in, in the layers' pixels


class Canvas:
    """Layers (h, w) of a camera's picture: how much of each pixel an ink covers, and how much of it is marking.

    Paint is drawn at its true coverage however thin it looks; the label of a marking never thinner than 1.5 px, so that
    far lines count, and not at all once a dash is less than half a pixel long.
    """

    def __init__(self, camera: GroundCamera) -> None:
        self._camera = camera
        self._size = (camera.camera.height_px * _FINER, camera.camera.width_px * _FINER)
        self._layers: dict[Ink, Image] = {}
        self._label: Image = np.zeros(self._size, dtype=np.uint8)

    def stripe(self, stripe: Stripe) -> None:
        """Draws a stripe, and its label when it is a marking."""
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
        """Fills outlines."""
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
        """How much of each pixel (h, w) the ink covers, 0..1; None where nothing was drawn with it."""
        layer = self._layers.get(ink)
        return None if layer is None else self._reduced(layer).astype(np.float32) * np.float32(1.0 / 255.0)

    def label(self) -> Image:
        """How much of each pixel (h, w) is marking, 0..255."""
        return self._reduced(self._label)

    def project(self, points: FloatArray) -> FloatArray:
        """Ground points (n, 2) -> the layers' pixels (n, 2); NaN where not seen."""
        return (self._camera.ground_to_px(points) + 0.5) * _FINER - 0.5

    def in_view(self, left: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Both ends (n, 2) of sections across a wide stripe, drawn in to where the camera's lens still sees them."""
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
        """Which ground points (..., 2) lie ahead of the camera, at most 85 deg off its line of sight."""
        body = np.concatenate((points, np.zeros((*points.shape[:-1], 1))), axis=-1)
        cam = (body - self._camera.centre_m) @ self._camera.cam_from_body.T
        return np.asarray(cam[..., 2] > 0.09 * np.hypot(cam[..., 0], cam[..., 1]))

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the layers [px]."""
        return self._size

    def _layer(self, ink: Ink) -> Image:
        if ink not in self._layers:
            self._layers[ink] = np.zeros(self._size, dtype=np.uint8)
        return self._layers[ink]

    def _reduced(self, layer: Image) -> Image:
        size = (self._size[1] // _FINER, self._size[0] // _FINER)
        return np.asarray(cv2.resize(layer, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


class _Drawn:
    """A stripe in the layers' pixels: its middle and half-width vectors (n, 2), and its pieces' coverage (n - 1,)."""

    def __init__(self, middle: FloatArray, half: FloatArray, alpha: FloatArray, shown: FloatArray) -> None:
        ahead = np.diff(middle, axis=0)
        ahead = np.concatenate((ahead, ahead[-1:]))
        ahead /= np.maximum(np.hypot(ahead[:, 0], ahead[:, 1]), 1e-9)[:, None]
        self._middle, self._half = middle, half
        self._normal = np.column_stack((-ahead[:, 1], ahead[:, 0]))
        self._normal *= np.where((half * self._normal).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
        self._width = 2.0 * (half * self._normal).sum(axis=1)  # across the stripe as it is seen
        self.alpha = alpha * np.minimum(1.0, 0.5 * (self._width[1:] + self._width[:-1]))
        self.shown = shown

    @classmethod
    def of(cls, stripe: Stripe, canvas: Canvas) -> _Drawn | None:
        """The stripe as seen; None when none of it is in the picture."""
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
        """Quads (n - 1, 4, 2), drawn as wide as the stripe looks but at least `least_px`; a drawn outline adds 1 px."""
        width = np.maximum(self._width, least_px)
        reach = np.where(self._width > _LABEL_PX, (width - 1.0) / np.maximum(self._width, 1e-6), 0.0)
        thin = 0.5 * np.maximum(width - 1.0, 0.0)[:, None] * self._normal
        half = np.where((self._width > _LABEL_PX)[:, None], self._half * reach[:, None], thin)
        left, right = self._middle + half, self._middle - half
        return np.stack((left[:-1], left[1:], right[1:], right[:-1]), axis=1)


def _pieces(stripe: Stripe, s: FloatArray, px: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Where a stripe is cut, and of each piece how much is paint and whether its label is shown, (n,) each.

    Dashes that look shorter than a pixel are not drawn one by one: there the paint is spread over dashes and gaps.
    """
    if not stripe.pattern:
        return s, np.ones(len(s)), np.ones(len(s))
    period = sum(stripe.pattern)
    share = sum(stripe.pattern[0::2]) / period
    steps = np.hypot(*np.diff(px, axis=0).T) / np.maximum(np.diff(s), 1e-9)  # px a lane width
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
    """Which samples to draw: those where the paint begins or ends, and one every few pixels between."""
    way = np.concatenate(([0.0], np.cumsum(np.nan_to_num(np.hypot(*np.diff(middle, axis=0).T), nan=_STEP_PX))))
    marks = np.floor(way / _STEP_PX)
    change = np.zeros(len(on), dtype=bool)
    change[0] = change[-1] = True
    change[1:] |= (marks[1:] != marks[:-1]) | (on[1:] != on[:-1]) | (seen[1:] != seen[:-1])
    change[:-1] |= seen[1:] != seen[:-1]
    return np.flatnonzero(change)


def _fixed(px: FloatArray) -> NDArray[np.int32]:
    return np.round(px * (1 << _BITS)).astype(np.int32)


def _fill(layer: Image, quads: FloatArray, alpha: FloatArray) -> None:
    """Fills quads (n, 4, 2) with their coverage (n,), leaving out those that cover nothing."""
    values = np.round(255.0 * alpha).astype(int)
    for quad, value in zip(_fixed(quads), values.tolist(), strict=True):
        if value > 0:
            cv2.fillConvexPoly(layer, quad, (value,), lineType=cv2.LINE_8, shift=_BITS)


def worn(noise: Image, lost: float, softness: float) -> Image:
    """A tile (512, 512) of how much paint is left, 0..255, when the share `lost` of it has gone.

    `noise` is a tile whose lowest places lose their paint first.
    """
    histogram = np.cumsum(np.bincount(noise.ravel(), minlength=256)) / noise.size
    threshold = float(np.searchsorted(histogram, lost))
    ramp = np.clip((np.arange(256) - threshold) / max(softness, 1.0) + 0.5, 0.0, 1.0)
    return np.asarray(cv2.LUT(noise, np.round(255.0 * ramp).astype(np.uint8)), dtype=np.uint8)
