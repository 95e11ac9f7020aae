"""`automodel calibrate odometry`: ticks a metre and the speed of each motor pulse, from a measured straight."""

from __future__ import annotations

import math
from typing import Any

import click

from automodel.cli.options import FILE, finite


def numbers(ctx: click.Context, param: click.Parameter, value: str) -> tuple[float, ...]:
    """A callback that reads "0.4,0.7,1.0": positive numbers."""
    try:
        found = tuple(float(part) for part in value.split(","))
    except ValueError:
        found = ()
    if not found or not all(v > 0 and math.isfinite(v) for v in found):
        raise click.BadParameter(f"{value!r} where positive numbers with commas between are wanted", ctx, param)
    return found


@click.command("odometry")
@click.option("--car", "car_file", type=FILE, help="The car.toml that ticks and speeds are written into.")
@click.option(
    "--distance-m",
    type=click.FloatRange(0.5, 100.0),
    callback=finite,
    required=True,
    help="Length of the measured straight; driving, the way that is about driven.",
)
@click.option("--push", is_flag=True, help="Push the car along the straight by hand: ticks only, the motor stays off.")
@click.option("--runs", type=click.IntRange(1, 20), default=3, show_default=True, help="--push: how often.")
@click.option(
    "--speeds", default="0.5,0.8,1.1", show_default=True, callback=numbers, help="Driving: one run each [m/s]."
)
@click.option(
    "--ticks",
    "counted",
    multiple=True,
    type=click.IntRange(1),
    help="Ticks already counted over the distance; give it once a run. Nothing moves.",
)
@click.option("--sim", "simulated", is_flag=True, help="A simulated car whose motor and wheels nobody knows.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Simulated: which car.")
@click.option("--out", type=FILE, help="Folder for the picture.  [calibration_pictures beside car.toml]")
@click.option("--json", "as_json", is_flag=True, help="Figures as JSON on stdout.")
@click.option("--dry-run", is_flag=True, help="Measure, but leave car.toml as it is.")
def command(push: bool, **given: Any) -> int:
    """Wheel ticks a metre, and which motor pulse makes which speed.

    The car drives the straight once for each of --speeds and stops; you measure the way with a tape and type it in.
    Enter arms and Enter stops. With --push you push it along exactly --distance-m instead.
    """
    from automodel.console.messages import say
    from calibration.calibration_drive import DriveEnded
    from calibration.odometry_drive import OdometryOptions, calibrate_odometry

    options = OdometryOptions(push=push, **given)
    try:
        return calibrate_odometry(options)
    except DriveEnded as error:
        say(f"automodel calibrate odometry: {error}; nothing was written")
        return 1
