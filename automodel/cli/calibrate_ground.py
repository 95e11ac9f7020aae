"""`automodel calibrate ground`: height, pitch, roll and yaw of the camera over the ground."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from automodel.cli.calibrate import board_size, output_options
from automodel.cli.options import ABOVE_ZERO, FILE, finite
from calibration.boards import DICTIONARIES, Board

if TYPE_CHECKING:
    from calibration.ground_dialogue import Method
    from calibration.printed_targets import ArucoSheet


@click.command("ground")
@click.argument("sources", metavar="SOURCE...", nargs=-1, required=True)
@click.option("--board", "size", callback=board_size, help="Inner corners of a board on the floor, as 9x6.")
@click.option("--square-mm", type=ABOVE_ZERO, callback=finite, help="--board: the side of a square.")
@click.option("--charuco", is_flag=True, help="--board: with ArUco markers in its white squares.")
@click.option("--aruco", callback=board_size, help="A sheet of this many markers on the floor, as 1x1.")
@click.option("--marker-mm", type=ABOVE_ZERO, callback=finite, help="--aruco, --charuco: the side of a marker.")
@click.option("--gap-mm", type=click.FloatRange(0), callback=finite, default=0.0, help="--aruco: between two markers.")
@click.option("--dictionary", type=click.Choice(DICTIONARIES), default="4x4_50", show_default=True, help="Of markers.")
@click.option("--at", "place_m", type=(float, float), metavar="X Y", help="Middle of the sheet [m], ahead and left.")
@click.option("--turn-deg", type=float, callback=finite, default=0.0, help="The sheet's rotation to the left.")
@click.option("--point", "points", multiple=True, type=(float,) * 4, metavar="X Y U V", help="A taped point [m], [px].")
@click.option("--points", "points_file", type=FILE, help="Taped points: CSV with x_m,y_m,u_px,v_px.")
@click.option("--from-lanes", is_flag=True, help="SOURCE is a straight drive between two parallel lines.")
@click.option("--lane-width-m", type=ABOVE_ZERO, callback=finite, help="--from-lanes.  [lane] width_m otherwise.")
@click.option("--tape-mm", type=ABOVE_ZERO, callback=finite, default=3.0, show_default=True, help="Tape's accuracy.")
@click.option("--keep-position", is_flag=True, help="Keep x_m and y_m of car.toml.")
@click.option(
    "--car", "car_file", type=FILE, default="car.toml", show_default=True, help="Where the camera is written."
)
@output_options
def command(
    sources: tuple[str, ...], car_file: Path, out: Path | None, as_json: bool, dry_run: bool, **given: Any
) -> int:
    """Where the camera sits and looks, from SOURCE: an image, folder, glob or video, or `live` for the camera itself.

    Measure on the floor from the ground under the middle of the rear axle: x ahead, y to the left. Lay a sheet there
    (--board or --aruco, --at), or tape four or more points (--point, --points), or drive straight along a lane
    (--from-lanes).

    Example:

    automodel calibrate ground drive.mp4 --from-lanes --car car.toml
    """
    from automodel.assembly.calibration_source import open_images
    from calibration.ground_dialogue import GroundOptions, calibrate_ground

    options = GroundOptions(method=_method(given), car_file=car_file, out=out, as_json=as_json, dry_run=dry_run)
    return calibrate_ground(options, functools.partial(open_images, sources, car_file))


def _method(given: Mapping[str, Any]) -> Method:
    """The one method that the options ask for; raises UsageError."""
    from calibration.ground_dialogue import SheetOnFloor, StraightDrive, TapedPoints

    board, aruco = given["size"] is not None, given["aruco"] is not None
    points = bool(given["points"]) or given["points_file"] is not None
    if (board, aruco, points, given["from_lanes"]).count(True) != 1:
        raise click.UsageError("give one of --board, --aruco, --point or --points, --from-lanes")
    if given["from_lanes"]:
        return StraightDrive(width_m=given["lane_width_m"])
    tape_m, keep = 1e-3 * given["tape_mm"], given["keep_position"]
    if points:
        return TapedPoints(rows=given["points"], file=given["points_file"], tape_m=tape_m, keep_position=keep)
    if given["place_m"] is None:
        raise click.UsageError("--at X Y is missing: where the middle of the sheet lies [m], ahead and left")
    side, what = ("square_mm", "square of the board") if board else ("marker_mm", "marker")
    if given[side] is None:
        raise click.UsageError(f"--{side.replace('_', '-')} is missing: the side of a {what}")
    return SheetOnFloor(
        sheet=_sheet(given),
        place_m=given["place_m"],
        turn_rad=math.radians(given["turn_deg"]),
        tape_m=tape_m,
        keep_position=keep,
    )


def _sheet(given: Mapping[str, Any]) -> Board | ArucoSheet:
    from calibration.printed_targets import ArucoSheet

    try:
        if given["aruco"] is None:
            return Board.of_mm(
                given["size"], given["square_mm"], given["charuco"], given["marker_mm"], given["dictionary"]
            )
        return ArucoSheet(
            columns=given["aruco"][0],
            rows=given["aruco"][1],
            marker_m=1e-3 * given["marker_mm"],
            gap_m=1e-3 * given["gap_mm"],
            dictionary=given["dictionary"],
        )
    except ValueError as error:
        raise click.UsageError(str(error)) from None
