"""A tabulated curve that is computed when it is first asked for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from automodel.curves.tabulated import TabulatedCurve
from automodel.types import FloatArray

Table = tuple[FloatArray, FloatArray, FloatArray, FloatArray]

_FIELDS = ("s_m", "points_m", "headings_rad", "curvatures_per_m", "length_m")


class DeferredCurve(TabulatedCurve):
    """The curve of the samples that `make` gives: arc lengths, points, headings, curvatures as in `TabulatedCurve`.

    Most curves of a run are only handed on; a fast pipeline makes three a frame. `make` runs once, at the first use,
    and must not depend on anything that changes until then.
    """

    def __init__(self, make: Callable[[], Table]) -> None:
        self._make = make

    def __getattr__(self, name: str) -> Any:
        if name not in _FIELDS:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        super().__init__(*self._make())
        return self.__dict__[name]
