"""`automodel calibrate`: each calibration is one command, with a residual, a picture and a section of car.toml."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import click

from automodel.cli.main import LazyGroup
from automodel.cli.options import FILE

COMMANDS = {  # each in automodel/cli/calibrate_<name>.py
    "camera": "The lens: focal lengths, centre and distortion, from images of a board.",
    "ground": "Where the camera looks: its height, pitch, roll and yaw over the ground.",
    "stereo": "The right one of two cameras: lens and place, from pairs of images of a board or of a drive.",
    "servo": "The steering: which pulse makes which angle of the front wheels.",
    "odometry": "The wheels: ticks a metre, and which motor pulse makes which speed.",
}


class Calibrations(LazyGroup):
    """The calibrations, each imported only when it is called."""

    commands_help = COMMANDS
    modules = "automodel.cli.calibrate_"


@click.group("calibrate", cls=Calibrations)
def command() -> None:
    """Calibrate the car, and write the results, with date and error, into car.toml."""


def output_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """The options of every calibration: --out, --json and --dry-run."""
    for option in (
        click.option("--dry-run", is_flag=True, help="Measure and draw, but leave car.toml unchanged."),
        click.option("--json", "as_json", is_flag=True, help="Results as JSON on stdout."),
        click.option("--out", type=FILE, help="Folder for pictures.  [calibration_pictures beside car.toml]"),
    ):
        command = option(command)
    return command


def board_size(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[int, int] | None:
    """A callback that reads "9x6"."""
    if value is None:
        return None
    size = re.fullmatch(r"(\d{1,3})[xX](\d{1,3})", value)
    if not size:
        raise click.BadParameter(f"expected columns x rows of inner corners, as 9x6, got {value!r}", ctx, param)
    return int(size.group(1)), int(size.group(2))
