"""`automodel calibrate camera`: the lens, from images of a chessboard or a ChArUco board."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from automodel.cli.calibrate import board_size, output_options
from automodel.cli.options import ABOVE_ZERO, FILE, finite
from calibration.boards import DICTIONARIES, Board

BOARD = (
    click.option("--board", "size", callback=board_size, help="Inner corners: columns x rows, as 9x6."),
    click.option("--square-mm", type=ABOVE_ZERO, callback=finite, help="The side of a square."),
    click.option("--charuco", is_flag=True, help="The white squares have ArUco markers."),
    click.option("--marker-mm", type=ABOVE_ZERO, callback=finite, help="ChArUco: the side of a marker.  [3/4 square]"),
    click.option("--dictionary", type=click.Choice(DICTIONARIES), default="4x4_50", show_default=True, help="ChArUco."),
)


def board_options(command: Callable[..., int], *, without: str = "") -> Callable[..., int]:
    """The options that say what board it is, given to the command as `board`.

    `without`: the name of a flag of the command with which there is none, and `board` is None.
    """

    @functools.wraps(command)
    def with_board(
        size: tuple[int, int] | None,
        square_mm: float | None,
        charuco: bool,
        marker_mm: float | None,
        dictionary: str,
        **rest: Any,
    ) -> int:
        if without and rest[without]:
            if size is not None or square_mm is not None or charuco or marker_mm is not None:
                raise click.UsageError(f"--{without.replace('_', '-')} needs no board; leave --board and the like away")
            return command(board=None, **rest)
        for name, value in (("--board", size), ("--square-mm", square_mm)):
            if value is None:
                raise click.UsageError(f"Missing option '{name}'.")
        if marker_mm is not None and not charuco:
            raise click.UsageError("--marker-mm is for --charuco")
        assert size is not None
        assert square_mm is not None
        try:
            board = Board.of_mm(size, square_mm, charuco, marker_mm, dictionary)
        except ValueError as error:
            raise click.UsageError(str(error)) from None
        return command(board=board, **rest)

    for option in reversed(BOARD):
        with_board = option(with_board)
    return with_board


@click.command("camera")
@click.argument("sources", metavar="SOURCE...", nargs=-1, required=True)
@board_options
@click.option(
    "--car", "car_file", type=FILE, default="car.toml", show_default=True, help="Where the camera is written."
)
@click.option("--views", type=click.IntRange(4, 200), default=20, show_default=True, help="Live: views to take.")
@output_options
def command(sources: tuple[str, ...], car_file: Path, **given: Any) -> int:
    """The camera's lens from SOURCE: images, a folder, a glob or a video of a board, or `live` for the camera itself.

    Show the board near and far, also in the corners of the image, and tilted by 20 to 50 degrees to all sides; 15 views
    are good. The printed board must be flat: glue it on something stiff.

    Example:

    automodel calibrate camera live --board 9x6 --square-mm 25 --car car.toml
    """
    from automodel.assembly.calibration_source import open_images
    from calibration.camera_dialogue import CameraOptions, calibrate_from_images

    options = CameraOptions(car_file=car_file, **given)
    return calibrate_from_images(options, functools.partial(open_images, sources, car_file, any_mode=True))
