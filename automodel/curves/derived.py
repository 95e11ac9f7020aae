"""Curves made of other curves: joined end to end, reversed, and at a distance beside another."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from automodel.curves.base import Curve
from automodel.types import FloatArray


class JoinedCurve(Curve):
    """Curves one after the other; each must start where the previous one ends, which is not checked."""

    def __init__(self, pieces: Sequence[Curve], closed: bool = False) -> None:
        if not pieces:
            raise ValueError("pieces: expected one curve or more, got none")
        self.pieces = tuple(pieces)
        self.closed = closed
        self._ends = np.cumsum([piece.length_m for piece in pieces])
        self._starts = np.concatenate(([0.0], self._ends[:-1]))
        self.length_m = float(self._ends[-1])
        turns = [float(p.heading(p.length_m)) - float(p.heading(0.0)) for p in pieces]
        starts = float(pieces[0].heading(0.0)) + np.concatenate(([0.0], np.cumsum(turns)))
        self._turn = starts[-1] - starts[0]  # [rad] of one lap
        self._heading_shift = starts[:-1] - [float(p.heading(0.0)) for p in pieces]

    def position(self, s_m: ArrayLike) -> FloatArray:
        """Points (..., 2) [m]."""
        return self._each(s_m, lambda piece, s: piece.position(s), 2)

    def heading(self, s_m: ArrayLike) -> FloatArray:
        """Direction (...,) [rad], continuous over joints and laps."""
        s = np.asarray(s_m, dtype=np.float64)
        shift = self._heading_shift[self._which(self._wrap(s.reshape(-1)))].reshape(s.shape)
        laps = np.floor(s / self.length_m) if self.closed else 0.0
        return self._each(s, lambda piece, local: piece.heading(local), 1) + shift + laps * self._turn

    def curvature(self, s_m: ArrayLike) -> FloatArray:
        """Curvature (...,) [1/m]."""
        return self._each(s_m, lambda piece, s: piece.curvature(s), 1)

    def breaks_m(self) -> FloatArray:
        """Arc lengths (n,) of the joints, and of what jumps inside the pieces."""
        inside = [start + p.breaks_m() for start, p in zip(self._starts, self.pieces, strict=True)]
        return np.unique(np.concatenate((self._starts[1:], *inside)))

    def _sample_step(self) -> float:
        return max(min(min(p._sample_step() * 20 for p in self.pieces), self.length_m / 200.0), self.length_m / 5000.0)

    def _wrap(self, s: FloatArray) -> FloatArray:
        return s % self.length_m if self.closed else s

    def _which(self, s: FloatArray) -> np.ndarray[tuple[int, ...], np.dtype[np.intp]]:
        return np.clip(np.searchsorted(self._starts, s, side="right") - 1, 0, len(self.pieces) - 1)

    def _each(self, s_m: ArrayLike, value: Callable[[Curve, FloatArray], FloatArray], width: int) -> FloatArray:
        s = np.asarray(s_m, dtype=np.float64)
        flat = self._wrap(s.reshape(-1))
        which = self._which(flat)
        out = np.empty((len(flat), width))
        for index in np.unique(which):
            mine = which == index
            out[mine] = value(self.pieces[index], flat[mine] - self._starts[index]).reshape(-1, width)
        return out.reshape((*s.shape, 2)) if width == 2 else out.reshape(s.shape)


class ReversedCurve(Curve):
    """The same curve in the opposite direction."""

    def __init__(self, base: Curve) -> None:
        self.base, self.length_m, self.closed = base, base.length_m, base.closed

    def position(self, s_m: ArrayLike) -> FloatArray:
        """Points (..., 2) [m]."""
        return self.base.position(self.length_m - np.asarray(s_m, dtype=np.float64))

    def heading(self, s_m: ArrayLike) -> FloatArray:
        """Direction (...,) [rad]."""
        return self.base.heading(self.length_m - np.asarray(s_m, dtype=np.float64)) + np.pi

    def curvature(self, s_m: ArrayLike) -> FloatArray:
        """Curvature (...,) [1/m]."""
        return -self.base.curvature(self.length_m - np.asarray(s_m, dtype=np.float64))

    def breaks_m(self) -> FloatArray:
        """Arc lengths (n,) at which the curvature or its rate jumps."""
        return self.length_m - self.base.breaks_m()[::-1]

    def _sample_step(self) -> float:
        return self.base._sample_step()


class OffsetCurve(Curve):
    """The curve at distance d(s) to the left of another, by its own arc length.

    `offset_m` is a number, or a function of the base curve's s (vectorised; smooth, and periodic where the base is
    closed). Raises ValueError where the distance reaches the centre of curvature, so that the curve would fold back.
    """

    def __init__(self, base: Curve, offset_m: float | Callable[[FloatArray], FloatArray], step_m: float = 0.0) -> None:
        self.base, self.closed = base, base.closed
        self._offset: Callable[[FloatArray], FloatArray]
        if callable(offset_m):
            self._offset = offset_m
        else:
            constant = float(offset_m)
            self._offset = lambda s: np.full_like(s, constant)
        count = max(int(np.ceil(base.length_m / (step_m or base._sample_step() / 4))), 16) + 1
        self._base_s = np.union1d(np.linspace(0.0, base.length_m, count), base.breaks_m())
        nodes, weights = np.polynomial.legendre.leggauss(3)
        half = 0.5 * np.diff(self._base_s)
        s = half[:, None] * nodes + (0.5 * (self._base_s[1:] + self._base_s[:-1]))[:, None]
        stretch, slope = self._rates(s)
        if (stretch <= 0).any():
            raise ValueError(f"offset_m: folds back at s = {float(s[stretch <= 0][0]):.2f} m of the base curve")
        speed = np.hypot(stretch, slope)
        self._s = np.concatenate(([0.0], np.cumsum(half * (speed @ weights))))
        self.length_m = float(self._s[-1])
        # extrapolated to the intervals' ends, because the curvature of the base may jump there
        self._speed = speed @ np.array([_lagrange(nodes, -1.0), _lagrange(nodes, 1.0)]).T

    def base_s(self, s_m: ArrayLike) -> FloatArray:
        """Arc length on the base curve of this curve's arc length."""
        s = np.asarray(s_m, dtype=np.float64)
        laps = np.floor(s / self.length_m) if self.closed else np.zeros_like(s)
        return _hermite(s - laps * self.length_m, self._s, self._base_s, 1.0 / self._speed) + laps * self.base.length_m

    def s_of(self, base_s_m: ArrayLike) -> FloatArray:
        """Arc length on this curve of the base curve's arc length; the inverse of `base_s`."""
        s = np.asarray(base_s_m, dtype=np.float64)
        laps = np.floor(s / self.base.length_m) if self.closed else np.zeros_like(s)
        return _hermite(s - laps * self.base.length_m, self._base_s, self._s, self._speed) + laps * self.length_m

    def breaks_m(self) -> FloatArray:
        """Arc lengths (n,) at which the curvature or its rate jumps."""
        return self.s_of(self.base.breaks_m())

    def position(self, s_m: ArrayLike) -> FloatArray:
        """Points (..., 2) [m]."""
        s = self.base_s(s_m)
        return self.base.offset_position(s, self._offset(s))

    def heading(self, s_m: ArrayLike) -> FloatArray:
        """Direction (...,) [rad]."""
        s = self.base_s(s_m)
        stretch, slope = self._rates(s)
        return np.asarray(self.base.heading(s) + np.arctan2(slope, stretch))

    def curvature(self, s_m: ArrayLike) -> FloatArray:
        """Curvature (...,) [1/m]."""
        s = np.asarray(s_m, dtype=np.float64)
        base_s = self.base_s(s)
        stretch, slope = self._rates(base_s)
        if not np.any(slope):
            return np.asarray(self.base.curvature(base_s) / stretch)
        h = 1e-3 * max(self._base_s[1], 1e-3)
        before, after = self._rates(base_s - h), self._rates(base_s + h)
        turn = np.arctan2(after[1], after[0]) - np.arctan2(before[1], before[0])
        return np.asarray((self.base.curvature(base_s) + turn / (2 * h)) / np.hypot(stretch, slope))

    def _rates(self, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        h = 1e-4 * max(self.base.length_m / 100.0, 1e-2)
        slope = (self._offset(s + h) - self._offset(s - h)) / (2 * h)
        return 1.0 - self.base.curvature(s) * self._offset(s), slope

    def _sample_step(self) -> float:
        return self.base._sample_step()


def _lagrange(nodes: FloatArray, at: float) -> FloatArray:
    """Lagrange weights: values at `nodes` times these give the polynomial's value at `at`."""
    return np.array(
        [np.prod((at - np.delete(nodes, i)) / (node - np.delete(nodes, i))) for i, node in enumerate(nodes)]
    )


def _hermite(x: FloatArray, knots: FloatArray, values: FloatArray, slopes: FloatArray) -> FloatArray:
    """Cubic Hermite interpolation with slopes (n - 1, 2) at both ends of each interval; linear beyond the ends."""
    inside = np.clip(x, knots[0], knots[-1])
    i = np.clip(np.searchsorted(knots, inside, side="right") - 1, 0, len(knots) - 2)
    width = knots[i + 1] - knots[i]
    t = (inside - knots[i]) / width
    rise, first, last = values[i + 1] - values[i], width * slopes[i, 0], width * slopes[i, 1]
    cubic = values[i] + t * (first + t * (3.0 * rise - 2.0 * first - last + t * (first + last - 2.0 * rise)))
    return np.asarray(cubic + (x - inside) * np.where(x < inside, slopes[0, 0], slopes[-1, 1]))
