"""`automodel calibrate odometry`: ticks a metre and the speed of each motor pulse, from a measured straight."""

from __future__ import annotations

import math
from typing import Any

import click

from automodel.cli.calibrate import output_options
from automodel.cli.options import FILE, finite


def numbers(ctx: click.Context, param: click.Parameter, value: str) -> tuple[float, ...]:
    """A callback that reads "0.4,0.7,1.0": positive numbers."""
    try:
        found = tuple(float(part) for part in value.split(","))
    except ValueError:
        found = ()
    if not found or not all(v > 0 and math.isfinite(v) for v in found):
        raise click.BadParameter(f"expected positive numbers with commas between, got {value!r}", ctx, param)
    return found


@click.command("odometry")
@click.option("--car", "car_file", type=FILE, help="The car.toml that ticks and speeds are written into.")
@click.option(
    "--distance-m",
    type=click.FloatRange(0.5, 100.0),
    callback=finite,
    required=True,
    help="Length of the measured straight; for a drive, about how far it goes.",
)
@click.option("--push", is_flag=True, help="Push the car along the straight by hand: ticks only, the motor stays off.")
@click.option("--runs", type=click.IntRange(1, 20), default=3, show_default=True, help="--push: number of runs.")
@click.option(
    "--speeds", default="0.5,0.8,1.1", show_default=True, callback=numbers, help="For a drive: one run for each [m/s]."
)
@click.option(
    "--ticks",
    "counted",
    multiple=True,
    type=click.IntRange(1),
    help="Ticks already counted over the distance, once for each run. Nothing moves.",
)
@click.option("--sim", "simulated", is_flag=True, help="A simulated car with motor and wheels drawn at random.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Simulated: draws the car.")
@output_options
def command(simulated: bool, **given: Any) -> int:
    """Wheel ticks a metre, and which motor pulse makes which speed.

    The car drives the straight once for each of --speeds and stops; you measure the distance with a tape and type it
    in. Enter arms and Enter stops. With --push you push it along exactly --distance-m instead.

    Example:

    automodel calibrate odometry --distance-m 3 --car car.toml
    """
    from automodel.assembly.calibration_rigs import calibration_rig, car_to_calibrate
    from automodel.console.messages import say
    from calibration.drive import DriveEnded
    from calibration.odometry_dialogue import OdometryOptions, calibrate_odometry

    options = OdometryOptions(**given)
    needs_board = not options.counted
    car = car_to_calibrate(options.car_file, simulated, options.dry_run, needs_board_log=needs_board)
    try:
        return calibrate_odometry(car, options, calibration_rig)
    except DriveEnded as error:
        say(f"automodel calibrate odometry: {error}; nothing was written")
        return 1
