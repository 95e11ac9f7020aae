"""Plane curves by arc length."""

from automodel.curves.base import Curve
from automodel.curves.derived import JoinedCurve, OffsetCurve, ReversedCurve
from automodel.curves.polynomials import DeferredGraphCurve, GraphCurve, ThetaCurve, arc, clothoid, line
from automodel.curves.sampled import DeferredCurve, SplineCurve, TabulatedCurve

__all__ = [
    "Curve",
    "DeferredCurve",
    "DeferredGraphCurve",
    "GraphCurve",
    "JoinedCurve",
    "OffsetCurve",
    "ReversedCurve",
    "SplineCurve",
    "TabulatedCurve",
    "ThetaCurve",
    "arc",
    "clothoid",
    "line",
]
