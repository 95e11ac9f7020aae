"""Pieces joined end to end, and the curve at a distance beside another."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from automodel.curves.base import Curve
from automodel.types import FloatArray


class JoinedCurve(Curve):
    """Curves one after the other; each must start where the one before ends (the maker checks)."""

    def __init__(self, pieces: Sequence[Curve], closed: bool = False) -> None:
        if not pieces:
            raise ValueError("pieces: one curve or more is wanted")
        self.pieces = tuple(pieces)
        self.closed = closed
        self._ends = np.cumsum([piece.length_m for piece in pieces])
        self._begins = np.concatenate(([0.0], self._ends[:-1]))
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
        inside = [begin + p.breaks_m() for begin, p in zip(self._begins, self.pieces, strict=True)]
        return np.unique(np.concatenate((self._begins[1:], *inside)))

    def _sample_step(self) -> float:
        return max(min(min(p._sample_step() * 20 for p in self.pieces), self.length_m / 200.0), self.length_m / 5000.0)

    def _wrap(self, s: FloatArray) -> FloatArray:
        return s % self.length_m if self.closed else s

    def _which(self, s: FloatArray) -> np.ndarray[tuple[int, ...], np.dtype[np.intp]]:
        return np.clip(np.searchsorted(self._begins, s, side="right") - 1, 0, len(self.pieces) - 1)

    def _each(self, s_m: ArrayLike, value: Callable[[Curve, FloatArray], FloatArray], width: int) -> FloatArray:
        s = np.asarray(s_m, dtype=np.float64)
        flat = self._wrap(s.reshape(-1))
        which = self._which(flat)
        out = np.empty((len(flat), width))
        for index in np.unique(which):
            mine = which == index
            out[mine] = value(self.pieces[index], flat[mine] - self._begins[index]).reshape(-1, width)
        return out.reshape((*s.shape, 2)) if width == 2 else out.reshape(s.shape)


class ReversedCurve(Curve):
    """The same curve driven the other way."""

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
