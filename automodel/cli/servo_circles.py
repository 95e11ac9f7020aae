"""`calibrate servo --manual`: the table from circles that were measured on the floor."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path

from automodel.cli.calibration_output import check_before, write_values
from automodel.cli.figures import show
from automodel.config import ConfigError, load_car
from automodel.reading import read_text
from calibration.circles import Circle, CircleError, rear_middle_diameter_m, table_of_circles

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
