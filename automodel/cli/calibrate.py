"""`automodel calibrate`: each calibration is one command that ends in a number, a picture and a section of car.toml."""

from __future__ import annotations

import click

from automodel.cli.main import LazyGroup

COMMANDS = {  # each in automodel/cli/calibrate_<name>.py
    "camera": "The lens: focal lengths, centre and distortion, from pictures of a board.",
    "ground": "Where the camera looks: its height, pitch, roll and yaw over the ground.",
    "servo": "The steering: which pulse makes which angle of the front wheels.",
    "odometry": "The wheels: ticks a metre, and which motor pulse makes which speed.",
}


class Calibrations(LazyGroup):
    """The calibrations, each imported only when it is called."""

    commands_help = COMMANDS
    modules = "automodel.cli.calibrate_"


@click.group("calibrate", cls=Calibrations)
def command() -> None:
    """Calibrate the car, and write what was found, with date and error, into car.toml."""
