"""`automodel calibrate stereo`: the right camera of a pair, from a board that both cameras see, or from a drive."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING

import click

from automodel.cli.calibrate import output_options
from automodel.cli.calibrate_camera import board_options
from automodel.cli.options import ABOVE_ZERO, FILE, finite

if TYPE_CHECKING:
    from calibration.boards import Board


@click.command("stereo")
@click.argument("left", type=FILE)
@click.argument("right", type=FILE, required=False)
@functools.partial(board_options, without="from_lanes")
@click.option("--fit-lens", is_flag=True, help="Measure the right lens also where car.toml has it.")
@click.option("--from-lanes", is_flag=True, help="The images are of a drive along a marked road, without a board.")
@click.option("--motion", "motion_file", type=FILE, help="--from-lanes: t_s,speed_mps,yaw_rate_radps of the drive.")
@click.option("--rate", "rate_hz", type=ABOVE_ZERO, callback=finite, help="--from-lanes: of videos and folders [Hz].")
@click.option(
    "--car", "car_file", type=FILE, default="car.toml", show_default=True, help="Where the right camera is written."
)
@output_options
def command(
    left: Path,
    right: Path | None,
    board: Board | None,
    fit_lens: bool,
    from_lanes: bool,
    motion_file: Path | None,
    rate_hz: float | None,
    car_file: Path,
    out: Path | None,
    as_json: bool,
    dry_run: bool,
) -> int:
    """Lens and place of the right camera, from LEFT and RIGHT: two folders of images or two videos of a board.

    Calibrate the left camera first (camera, ground): the right one is measured from it. Show the board near and far
    where both cameras see all of it, tilted by 20 to 50 degrees to all sides, and for the lens also in the corners of
    the right image; 15 pairs are good. Hold it still: both images of a pair must show it at the same place.

    With --from-lanes its place alone, for cameras too far apart for a board: LEFT is a recording of a drive with both
    cameras, or LEFT and RIGHT are videos or folders and --motion says how the car moved. Drive some hundred metres
    (a scale car: some laps) along lines and dashes, weave in the lane. Both lenses must be known.

    Example:

    automodel calibrate stereo left right --board 9x6 --square-mm 25
    """
    if right is not None and left.resolve() == right.resolve():
        raise click.UsageError(f"LEFT and RIGHT are both {left}; give the right camera's images as well")
    if board is None:
        return _from_lanes(left, right, fit_lens, motion_file, rate_hz, (car_file, out, as_json, dry_run))
    from automodel.assembly.calibration_source import open_pairs
    from calibration.stereo_dialogue import StereoOptions, calibrate_from_pairs

    if right is None:
        raise click.UsageError("Missing argument 'RIGHT'.")
    if motion_file is not None or rate_hz is not None:
        raise click.UsageError("--motion and --rate are for --from-lanes")
    options = StereoOptions(
        board=board, car_file=car_file, out=out, fit_lens=fit_lens, as_json=as_json, dry_run=dry_run
    )
    return calibrate_from_pairs(options, functools.partial(open_pairs, left, right))


def _from_lanes(
    left: Path,
    right: Path | None,
    fit_lens: bool,
    motion_file: Path | None,
    rate_hz: float | None,
    written: tuple[Path, Path | None, bool, bool],
) -> int:
    from automodel.assembly.calibration_source import open_drive
    from calibration.stereo_lanes_dialogue import DriveOptions, calibrate_from_drive

    if fit_lens:
        raise click.UsageError("--fit-lens needs a board: lanes do not show a lens")
    car_file, out, as_json, dry_run = written
    options = DriveOptions(car_file=car_file, out=out, as_json=as_json, dry_run=dry_run)
    return calibrate_from_drive(options, functools.partial(open_drive, left, right, motion_file, rate_hz))
