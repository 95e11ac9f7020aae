"""Steering pulse -> road-wheel angle from circles that were measured on the floor.

`calibrate servo --manual`: the table from circles that were measured on the floor.
"""

from __future__ import annotations

import csv
import io
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from automodel.config import ConfigError, load_car
from automodel.config.toml_reader import read_text
from automodel.console.tables import show
from calibration.calibration_output import check_before, write_values

SIDES = ("left", "right", "straight")
_REPEAT = 0.1  # diameters of the same pulse that differ by more contradict each other


class CircleError(ValueError):
    """The circles contradict each other, or are too few; the text says which and what to do."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Circle:
    """A circle driven slowly at one pulse: its diameter [m] under the rear axle's middle, and the side it lay on.

    `side` "straight" is a pulse at which the car runs straight ahead; the diameter then counts for nothing.
    """

    pulse_us: float
    diameter_m: float
    side: str

    def __post_init__(self) -> None:
        if self.side not in SIDES:
            raise CircleError(f"side: {self.side!r} is none of {', '.join(SIDES)}")
        if not 500.0 <= self.pulse_us <= 2500.0:
            raise CircleError(f"pulse_us: {self.pulse_us} where 500 .. 2500 is wanted")
        if self.side != "straight" and not (self.diameter_m > 0 and math.isfinite(self.diameter_m)):
            raise CircleError(f"diameter_m: {self.diameter_m} where a positive number is wanted")


@dataclass(frozen=True, slots=True, kw_only=True)
class CircleTable:
    """Pulse -> angle as `ServoConfig` has it; `rms_rad` is the scatter of repeated circles, None without repeats."""

    pulse_us: tuple[float, ...]
    steering_rad: tuple[float, ...]
    centre_us: float
    rms_rad: float | None


def rear_middle_diameter_m(outer_front_m: float, wheelbase_m: float, track_m: float) -> float:
    """The diameter under the rear axle's middle where the outer front wheel's was measured.

    The wheel runs ahead of the axle by the wheelbase L and outside its middle by half the track t, so that its radius
    is the long side of a triangle: R_f^2 = L^2 + (R + t / 2)^2. Raises CircleError for a circle smaller than the car.
    """
    radius = 0.5 * outer_front_m
    if not radius > math.hypot(wheelbase_m, 0.5 * track_m):
        raise CircleError(f"diameter_m: {outer_front_m} is less than a car of {wheelbase_m} m wheelbase can drive")
    return 2.0 * (math.sqrt(radius * radius - wheelbase_m * wheelbase_m) - 0.5 * track_m)


def table_of_circles(circles: Sequence[Circle], wheelbase_m: float) -> CircleTable:
    """The table through all circles with delta = atan(2 L / D); raises CircleError.

    Equal pulses are averaged. Without a straight pulse the centre is where the line between the widest left and the
    widest right circle passes 0.
    """
    if not any(c.side == "left" for c in circles) or not any(c.side == "right" for c in circles):
        raise CircleError("circles on both sides are wanted: one to the left and one to the right at least")
    points: list[tuple[float, float, Circle]] = []
    off: list[float] = []
    for pulse, group in itertools.groupby(sorted(circles, key=lambda c: c.pulse_us), key=lambda c: c.pulse_us):
        same = list(group)
        angles = np.array([_angle(circle, wheelbase_m) for circle in same])
        if np.ptp(angles) > _REPEAT * max(float(np.abs(angles).max()), 1e-9):
            told = " and ".join(_text(circle) for circle in same)
            raise CircleError(f"{pulse:.0f} us: {told} contradict each other; measure again")
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


COLUMNS = ("pulse_us", "diameter_m", "side")


def calibrate_by_circles(
    car_file: Path | None,
    circles: Sequence[str],
    circles_file: Path | None,
    *,
    outer_front: bool,
    dry_run: bool,
    as_json: bool,
) -> int:
    """Read the circles, make the table and write it; raises ConfigError and CircleError with car.toml as it was."""
    if car_file is None:
        raise ConfigError("--car: which car? Name its car.toml")
    check_before(car_file, dry_run)
    vehicle = load_car(car_file).vehicle
    rows = [(f"--circle {text}", text.split(",")) for text in circles]
    if circles_file is not None:
        rows += _rows_of(circles_file)
    measured = [_circle(place, fields) for place, fields in rows]
    if outer_front:
        measured = [
            circle
            if circle.side == "straight"
            else Circle(
                pulse_us=circle.pulse_us,
                diameter_m=rear_middle_diameter_m(circle.diameter_m, vehicle.wheelbase_m, vehicle.width_m),
                side=circle.side,
            )
            for circle in measured
        ]
    table = table_of_circles(measured, vehicle.wheelbase_m)
    told = (
        "no circle was repeated" if table.rms_rad is None else f"repeats scatter {math.degrees(table.rms_rad):.2f} deg"
    )
    write_values(
        car_file,
        {"link.servo": {"pulse_us": table.pulse_us, "steering_rad": table.steering_rad}},
        residual=told,
        method=f"{len(measured)} circles measured by hand",
        dry_run=dry_run,
    )
    row = {
        "centre_us": table.centre_us,
        "left_deg": math.degrees(max(table.steering_rad)),
        "right_deg": -math.degrees(min(table.steering_rad)),
        "rms_deg": None if table.rms_rad is None else math.degrees(table.rms_rad),
        "circles": len(measured),
    }
    show("calibrate servo", [row], as_json)
    return 0


def _rows_of(path: Path) -> list[tuple[str, list[str]]]:
    lines = list(csv.reader(io.StringIO(read_text(path))))
    if not lines or tuple(name.strip() for name in lines[0]) != COLUMNS:
        raise ConfigError(f"{path}:1: the first line must be {','.join(COLUMNS)}")
    return [
        (f"{path}:{number}", fields) for number, fields in enumerate(lines[1:], 2) if any(f.strip() for f in fields)
    ]


def _circle(place: str, fields: Sequence[str]) -> Circle:
    if len(fields) != len(COLUMNS):
        raise ConfigError(f"{place}: {len(fields)} values where {','.join(COLUMNS)} are wanted, as 1200,1.35,left")
    pulse, diameter, side = (field.strip() for field in fields)
    try:
        pulse_us = float(pulse)
        diameter_m = math.inf if side == "straight" and not diameter else float(diameter)
    except ValueError:
        raise ConfigError(f"{place}: pulse and diameter must be numbers, as 1200,1.35,left") from None
    try:
        return Circle(pulse_us=pulse_us, diameter_m=diameter_m, side=side)
    except CircleError as error:
        raise ConfigError(f"{place}: {error}") from None
