"""`automodel calibrate servo`: steering pulse -> road-wheel angle, by hand, by tape measure or by driving."""

from __future__ import annotations

from typing import Any

import click

from automodel.cli.calibrate import output_options
from automodel.cli.options import ABOVE_ZERO, FILE, finite


@click.command("servo")
@click.option("--car", "car_file", type=FILE, help="The car.toml that the servo is written into.")
@click.option("--auto", is_flag=True, help="The car drives slow bends and measures itself.")
@click.option("--manual", is_flag=True, help="From circles that were measured with a tape.")
@click.option("--sim", "simulated", is_flag=True, help="A simulated car with a servo drawn at random.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Simulated: draws the servo.")
@click.option(
    "--speed", "speed_mps", type=ABOVE_ZERO, callback=finite, default=0.5, show_default=True, help="--auto: [m/s]."
)
@click.option(
    "--yaw",
    type=click.Choice(["gyro", "camera"]),
    default="gyro",
    show_default=True,
    help="--auto: source of the yaw rate; the camera must be calibrated and see a patterned, matt floor.",
)
@click.option("--arm", is_flag=True, help="--auto: arm once without asking, as soon as everything works.")
@click.option(
    "--circle", "circles", multiple=True, metavar="PULSE,DIAMETER,SIDE", help="--manual: us, m, left|right|straight."
)
@click.option("--circles", "circles_file", type=FILE, help="--manual: a CSV with pulse_us,diameter_m,side.")
@click.option(
    "--measured-at",
    type=click.Choice(["rear-middle", "outer-front"]),
    default="rear-middle",
    show_default=True,
    help="--manual: the point of the car that the diameters are measured at.",
)
@click.option(
    "--span-us",
    type=click.FloatRange(100, 900),
    default=500,
    show_default=True,
    help="By hand: largest distance from 1500 us.",
)
@click.option("--left-deg", type=ABOVE_ZERO, callback=finite, help="By hand: the angle at the left end, if known.")
@click.option("--right-deg", type=ABOVE_ZERO, callback=finite, help="By hand: the angle at the right end, if known.")
@output_options
def command(auto: bool, manual: bool, **given: Any) -> int:
    """The steering servo: which pulse makes which angle of the front wheels, left positive.

    Without --auto and --manual, keys move the servo to find its centre and ends. --auto drives for a minute on a free,
    level floor of 6 x 6 m, up to 10 m long where the centre is far off; at --speed 0.3 it needs 60 % of that. Enter
    arms and Enter stops, as does Ctrl-C; then nothing is written.

    Example:

    automodel calibrate servo --auto --sim --seed 3
    """
    if auto and manual:
        raise click.UsageError("--auto and --manual: choose one of them")
    if not manual and (given["circles"] or given["circles_file"]):
        raise click.UsageError("--circle and --circles are for --manual")
    from automodel.console.messages import say
    from calibration.drive import DriveEnded

    try:
        return _circles(given) if manual else _auto(given) if auto else _by_hand(given)
    except DriveEnded as error:
        say(f"automodel calibrate servo: {error}; nothing was written")
        return 1


def _circles(given: dict[str, Any]) -> int:
    from calibration.servo_dialogue import calibrate_by_circles

    return calibrate_by_circles(
        given["car_file"],
        given["circles"],
        given["circles_file"],
        outer_front=given["measured_at"] == "outer-front",
        dry_run=given["dry_run"],
        as_json=given["as_json"],
    )


def _auto(given: dict[str, Any]) -> int:
    from automodel.assembly.calibration_rigs import calibration_rig, car_to_calibrate
    from calibration.servo_drive import AutoOptions, calibrate_by_driving

    car = car_to_calibrate(given["car_file"], given["simulated"], given["dry_run"])
    same = {name: given[name] for name in ("car_file", "seed", "speed_mps", "arm", "out", "dry_run", "as_json")}
    return calibrate_by_driving(car, AutoOptions(camera=given["yaw"] == "camera", **same), calibration_rig)


def _by_hand(given: dict[str, Any]) -> int:
    from automodel.assembly.calibration_rigs import calibration_rig, car_to_calibrate
    from calibration.servo_dialogue import calibrate_by_hand

    return calibrate_by_hand(
        car_to_calibrate(given["car_file"], given["simulated"], given["dry_run"]),
        given["car_file"],
        calibration_rig,
        span_us=given["span_us"],
        ends_deg=(given["left_deg"], given["right_deg"]),
        dry_run=given["dry_run"],
    )
