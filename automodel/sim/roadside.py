"""The ground beside the lane of a circuit: asphalt and kerbs."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from automodel.curves import Curve
from automodel.sim.paint import Paint
from automodel.sim.track_sections import RoadsideSection
from automodel.types import FloatArray

Width = Callable[[ArrayLike], FloatArray]

_PIECE_M = 20.0  # length of a piece of asphalt
_STEP_M = 2.0  # between the corners of a polygon
_FOLD = 0.95  # the inside of a bend is paved up to this share of its radius


def build_roadside(road: Curve, width_m: Width, section: RoadsideSection, marking_m: float) -> tuple[Paint, ...]:
    """The asphalt and the kerbs of a lane around `road` with edge lines of width `marking_m`."""
    return (*_asphalt(road, width_m, section), *_kerbs(road, width_m, section, 0.5 * marking_m))


def _asphalt(road: Curve, width_m: Width, section: RoadsideSection) -> Iterator[Paint]:
    cuts = np.linspace(0.0, road.length_m, max(round(road.length_m / _PIECE_M), 1) + 1)
    for start, end in itertools.pairwise(cuts.tolist()):
        s = np.linspace(start, end, round((end - start) / _STEP_M) + 1)
        left, right = (_beside(road, width_m, s, side, section.asphalt_m) for side in (1.0, -1.0))
        yield Paint(polygon_m=np.concatenate((right, left[::-1])), colour="asphalt", kind="ground")


def _kerbs(road: Curve, width_m: Width, section: RoadsideSection, from_m: float) -> Iterator[Paint]:
    """Alternating red and white blocks."""
    count = 2 * max(round(0.5 * road.length_m / section.block_m), 1)
    edges = np.linspace(0.0, road.length_m, count + 1)
    bend = road.curvature(0.5 * (edges[1:] + edges[:-1])) * max(section.kerb_radius_m, 1e-9)
    for side in (1.0, -1.0):
        inside, opposite = side * bend > 1.0, side * bend < -1.0
        after = _shortly_after(opposite, round(section.kerb_exit_m / section.block_m), road.closed)
        for start, end in _runs(inside | after):
            s = edges[start : end + 1]
            near, far = (_beside(road, width_m, s, side, d) for d in (from_m, from_m + section.kerb_width_m))
            for k in np.flatnonzero(np.hypot(*(far - near).T)[:-1] > from_m).tolist():
                polygon = np.stack((near[k], near[k + 1], far[k + 1], far[k]))
                yield Paint(polygon_m=polygon, colour=("red", "white")[(start + k) % 2], kind="kerb")


def _shortly_after(mask: NDArray[np.bool_], count: int, closed: bool) -> NDArray[np.bool_]:
    """The up to `count` places after each run of True, across the seam of a closed road."""
    before = mask[len(mask) - count :] if closed else np.zeros(count, np.bool_)
    seen = np.cumsum(np.concatenate((before, mask)))
    return np.asarray((seen[count:] > np.concatenate(([0], seen))[: len(mask)]) & ~mask)


def _beside(road: Curve, width_m: Width, s: FloatArray, side: float, beyond_m: float) -> FloatArray:
    """Points (n, 2) at `beyond_m` outside the edge of one side, limited to where the road's normals meet."""
    d = 0.5 * width_m(s) + beyond_m
    towards = np.maximum(side * road.curvature(s), 1e-9)
    return road.offset_position(s, side * np.minimum(d, _FOLD / towards))


def _runs(mask: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """Start and end of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False])).astype(np.int8)))
    yield from zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
