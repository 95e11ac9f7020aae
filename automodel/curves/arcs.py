"""Arcs of circles: points on them, and feet of perpendiculars."""

from __future__ import annotations

import cmath
import math

_STRAIGHT = 1e-9


def foot_on_circle(ahead_m: float, left_m: float, curvature_per_m: float) -> tuple[float, float]:
    """Way along an arc to the foot of a point's perpendicular, and the point's distance to the left of it [m].

    The point lies `ahead_m` and `left_m` of the arc's start, in its direction there. Finite for any curvature; the foot
    is unique short of the circle's centre.
    """
    a, b = curvature_per_m * ahead_m, 1.0 - curvature_per_m * left_m
    way = math.atan2(a, b) / curvature_per_m if abs(curvature_per_m) > _STRAIGHT else ahead_m
    square = left_m * left_m + ahead_m * ahead_m
    return way, (2.0 * left_m - curvature_per_m * square) / (1.0 + math.hypot(a, b))


def arc_from(left_m: float, heading_rad: float, curvature_per_m: float, s_m: float) -> tuple[complex, complex]:
    """Place (x + i y) [m] and unit tangent of an arc at arc length `s_m`; the origin is `left_m` left of its start."""
    start, half = cmath.exp(1j * heading_rad), 0.5 * curvature_per_m * s_m
    chord = s_m * (math.sin(half) / half if abs(half) > _STRAIGHT else 1.0)
    turned = cmath.exp(1j * half)
    return start * (chord * turned - 1j * left_m), start * turned * turned
