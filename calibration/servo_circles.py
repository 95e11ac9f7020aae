"""Steering pulse -> road-wheel angle, from circles that were driven and measured on the floor."""

from __future__ import annotations

import csv
import io
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from automodel.config import ConfigError
from automodel.config.toml_reader import read_text

COLUMNS = ("pulse_us", "diameter_m", "side")  # of a CSV of circles
SIDES = ("left", "right", "straight")
_REPEAT = 0.1  # largest relative difference between the circles of one pulse


class CircleError(ValueError):
    """The circles contradict each other, or are too few; the text says which, and what to do."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Circle:
    """A circle driven slowly at one pulse: its diameter [m] at the centre of the rear axle, and the side it lies on.

    `side` "straight" is a pulse at which the car runs straight ahead; its diameter is ignored.
    """

    pulse_us: float
    diameter_m: float
    side: str

    def __post_init__(self) -> None:
        if self.side not in SIDES:
            raise CircleError(f"side: expected one of {', '.join(SIDES)}, got {self.side!r}")
        if not 500.0 <= self.pulse_us <= 2500.0:
            raise CircleError(f"pulse_us: expected 500 .. 2500, got {self.pulse_us}")
        if self.side != "straight" and not (self.diameter_m > 0 and math.isfinite(self.diameter_m)):
            raise CircleError(f"diameter_m: expected a positive number, got {self.diameter_m}")


@dataclass(frozen=True, slots=True, kw_only=True)
class CircleTable:
    """Pulse -> angle, as in `ServoConfig`; `rms_rad` is the scatter of repeated circles, None without repeats."""

    pulse_us: tuple[float, ...]
    steering_rad: tuple[float, ...]
    centre_us: float
    rms_rad: float | None


def rear_middle_diameter_m(outer_front_m: float, wheelbase_m: float, track_m: float) -> float:
    """The diameter [m] at the centre of the rear axle, from that of the outer front wheel.

    The wheel is ahead of the axle by the wheelbase L and outside its centre by half the track t, so its radius is the
    hypotenuse of a right triangle: R_f^2 = L^2 + (R + t / 2)^2. Raises CircleError for a circle smaller than the car.
    """
    radius = 0.5 * outer_front_m
    if not radius > math.hypot(wheelbase_m, 0.5 * track_m):
        raise CircleError(f"diameter_m: {outer_front_m} is less than a car of {wheelbase_m} m wheelbase can drive")
    return 2.0 * (math.sqrt(radius * radius - wheelbase_m * wheelbase_m) - 0.5 * track_m)


def table_of_circles(circles: Sequence[Circle], wheelbase_m: float) -> CircleTable:
    """The table through all circles with delta = atan(2 L / D); raises CircleError.

    Equal pulses are averaged. Without a straight pulse the centre is where the table crosses 0 by interpolation.
    """
    if not any(c.side == "left" for c in circles) or not any(c.side == "right" for c in circles):
        raise CircleError("expected circles on both sides: at least one to the left and one to the right")
    points: list[tuple[float, float, Circle]] = []
    off: list[float] = []
    for pulse, group in itertools.groupby(sorted(circles, key=lambda c: c.pulse_us), key=lambda c: c.pulse_us):
        same = list(group)
        angles = np.array([_angle(circle, wheelbase_m) for circle in same])
        if np.ptp(angles) > _REPEAT * max(float(np.abs(angles).max()), 1e-9):
            texts = " and ".join(_text(circle) for circle in same)
            raise CircleError(f"{pulse:.0f} us: {texts} contradict each other; measure again")
        points.append((pulse, float(angles.mean()), same[0]))
        off += (angles - angles.mean()).tolist() if len(same) > 1 else []
    _check_monotone(points)
    pulses, values = [p for p, _, _ in points], [a for _, a, _ in points]
    rising = values[-1] > values[0]
    centre = float(np.interp(0.0, values if rising else values[::-1], pulses if rising else pulses[::-1]))
    if 0.0 not in values:
        at = int(np.searchsorted(pulses, centre))
        pulses.insert(at, round(centre, 1))
        values.insert(at, 0.0)
    return CircleTable(
        pulse_us=tuple(pulses),
        steering_rad=tuple(round(a, 5) for a in values),
        centre_us=centre,
        rms_rad=float(np.sqrt(np.mean(np.square(off)))) if off else None,
    )


def _angle(circle: Circle, wheelbase_m: float) -> float:
    if circle.side == "straight":
        return 0.0
    angle = math.atan(2.0 * wheelbase_m / circle.diameter_m)
    return angle if circle.side == "left" else -angle


def _check_monotone(points: Sequence[tuple[float, float, Circle]]) -> None:
    rising = points[-1][1] > points[0][1]
    for (p, a, first), (q, b, second) in itertools.pairwise(points):
        if (b > a) is not rising or a == b:
            side = "left" if rising else "right"
            raise CircleError(
                f"{p:.0f} us ({_text(first)}) and {q:.0f} us ({_text(second)}) contradict the other circles: "
                f"from pulse to pulse the wheels must turn further to the {side}; measure these two again"
            )


def _text(circle: Circle) -> str:
    return "straight" if circle.side == "straight" else f"{circle.diameter_m:g} m {circle.side}"


def read_circles(path: Path) -> list[Circle]:
    """The circles of a CSV with the header `COLUMNS`; raises ConfigError with file and line."""
    lines = list(csv.reader(io.StringIO(read_text(path))))
    if not lines or tuple(name.strip() for name in lines[0]) != COLUMNS:
        raise ConfigError(f"{path}:1: the first line must be {','.join(COLUMNS)}")
    numbered = [(number, fields) for number, fields in enumerate(lines[1:], 2) if any(f.strip() for f in fields)]
    return [parse_circle(f"{path}:{number}", fields) for number, fields in numbered]


def parse_circle(place: str, fields: Sequence[str]) -> Circle:
    """The circle of three fields as in `COLUMNS`; raises ConfigError that names the `place` they were read from."""
    if len(fields) != len(COLUMNS):
        raise ConfigError(
            f"{place}: expected {','.join(COLUMNS)}, for example 1200,1.35,left; got {len(fields)} values"
        )
    pulse, diameter, side = (field.strip() for field in fields)
    try:
        pulse_us = float(pulse)
        diameter_m = math.inf if side == "straight" and not diameter else float(diameter)
    except ValueError:
        raise ConfigError(f"{place}: pulse and diameter must be numbers, for example 1200,1.35,left") from None
    try:
        return Circle(pulse_us=pulse_us, diameter_m=diameter_m, side=side)
    except CircleError as error:
        raise ConfigError(f"{place}: {error}") from None
