"""`automodel calibrate stereo`: the right camera of a pair, from images of a board that both cameras see."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import click

from automodel.cli.calibrate import output_options
from automodel.cli.calibrate_camera import board_options
from automodel.cli.options import FILE


@click.command("stereo")
@click.argument("left", type=FILE)
@click.argument("right", type=FILE)
@board_options
@click.option("--fit-lens", is_flag=True, help="Measure the right lens also where car.toml has it.")
@click.option(
    "--car", "car_file", type=FILE, default="car.toml", show_default=True, help="Where the right camera is written."
)
@output_options
def command(left: Path, right: Path, car_file: Path, **given: Any) -> int:
    """Lens and place of the right camera, from LEFT and RIGHT: two folders of images or two videos of a board.

    Calibrate the left camera first (camera, ground): the right one is measured from it. Show the board near and far
    where both cameras see all of it, tilted by 20 to 50 degrees to all sides, and for the lens also in the corners of
    the right image; 15 pairs are good. Hold it still: both images of a pair must show it at the same place.

    Example:

    automodel calibrate stereo left right --board 9x6 --square-mm 25
    """
    from automodel.assembly.calibration_source import open_pairs
    from calibration.stereo_dialogue import StereoOptions, calibrate_from_pairs

    if left.resolve() == right.resolve():
        raise click.UsageError(f"LEFT and RIGHT are both {left}; give the right camera's images as well")
    options = StereoOptions(car_file=car_file, **given)
    return calibrate_from_pairs(options, functools.partial(open_pairs, left, right))
