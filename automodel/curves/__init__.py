"""Plane curves by arc length."""

from automodel.curves.base import Curve
from automodel.curves.graph import GraphCurve
from automodel.curves.joined import JoinedCurve, ReversedCurve
from automodel.curves.sampled import OffsetCurve, SplineCurve
from automodel.curves.tabulated import DeferredCurve, TabulatedCurve
from automodel.curves.theta import ThetaCurve, arc, clothoid, line

__all__ = [
    "Curve",
    "DeferredCurve",
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
