"""`automodel calibrate ground`: height, pitch, roll and yaw of the camera over the ground."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import click

from automodel.assembly.calibration_source import is_live, live_camera, live_frames, named_paths, pictures_of
from automodel.assembly.parts import car_of
from automodel.cli.calibrate_camera import board_size
from automodel.cli.options import ABOVE_ZERO, FILE, finite
from automodel.config import CarConfig
from automodel.console.messages import say
from automodel.console.tables import show
from automodel.geometry import CameraModel, GroundCamera
from calibration.boards import DICTIONARIES
from calibration.calibration_output import check_before, picture_folder, write_pictures, write_values
from calibration.ground_methods import Found, Pictures, by_lanes, by_points, by_sheet, check_method, readable
from calibration.pictures import ground_picture
from calibration.views import CalibrationError

KEYS = ("x_m", "y_m", "z_m", "pitch_rad", "yaw_rad", "roll_rad")
METHODS = {"board": by_sheet, "aruco": by_sheet, "points": by_points, "lanes": by_lanes}
_WARM_UP, _LIVE_FRAMES = 15, 60  # the camera's first frames may be dark


@click.command("ground")
@click.argument("sources", metavar="SOURCE...", nargs=-1, required=True)
@click.option("--board", "size", callback=board_size, help="Inner corners of a board on the floor, as 9x6.")
@click.option("--square-mm", type=ABOVE_ZERO, callback=finite, help="--board: the side of a square.")
@click.option("--charuco", is_flag=True, help="--board: with ArUco markers in its white squares.")
@click.option("--aruco", callback=board_size, help="A sheet of so many markers on the floor, as 1x1.")
@click.option("--marker-mm", type=ABOVE_ZERO, callback=finite, help="--aruco, --charuco: the side of a marker.")
@click.option("--gap-mm", type=click.FloatRange(0), callback=finite, default=0.0, help="--aruco: between two markers.")
@click.option("--dictionary", type=click.Choice(DICTIONARIES), default="4x4_50", show_default=True, help="Of markers.")
@click.option("--at", "place_m", type=(float, float), metavar="X Y", help="Middle of the sheet [m], ahead and left.")
@click.option("--turn-deg", type=float, callback=finite, default=0.0, help="The sheet's turn to the left.")
@click.option("--point", "points", multiple=True, type=(float,) * 4, metavar="X Y U V", help="A taped point [m], [px].")
@click.option("--points", "points_file", type=FILE, help="Taped points: CSV with x_m,y_m,u_px,v_px.")
@click.option("--from-lanes", is_flag=True, help="SOURCE is a straight drive between two parallel lines.")
@click.option("--lane-width-m", type=ABOVE_ZERO, callback=finite, help="--from-lanes.  [lane] width_m otherwise.")
@click.option("--tape-mm", type=ABOVE_ZERO, callback=finite, default=3.0, show_default=True, help="Tape's accuracy.")
@click.option("--keep-position", is_flag=True, help="Hold x_m and y_m as car.toml has them.")
@click.option(
    "--car", "car_file", type=FILE, default="car.toml", show_default=True, help="Where the camera is written."
)
@click.option("--out", type=FILE, help="Folder for the picture.  [calibration_pictures beside car.toml]")
@click.option("--json", "as_json", is_flag=True, help="Figures as JSON on stdout.")
@click.option("--dry-run", is_flag=True, help="Measure and draw, but leave car.toml as it is.")
def command(sources: tuple[str, ...], car_file: Path, out: Path | None, dry_run: bool, **more: Any) -> int:
    """Where the camera sits and looks, from SOURCE: a picture, folder, glob or video, or `live` for the camera itself.

    Measure on the floor from the ground under the middle of the rear axle: x ahead, y to the left. Lay a sheet there
    (--board or --aruco, --at), or tape four or more points (--point, --points), or drive straight along a lane
    (--from-lanes).
    """
    method = METHODS[check_method(more)]
    folder = picture_folder(out, car_file)
    check_before(car_file, dry_run)
    car = car_of(car_file if car_file.exists() else None)
    if car.calibration.camera is None:
        say(f"{car_file}: [camera.intrinsics] were never calibrated; what follows is as right as they are")
    with _pictures(sources, car, car_file) as pictures:
        found = method(pictures, car, more)
    _show(found, more["as_json"])
    for remark in found.remarks:
        say(remark)
    camera = GroundCamera(CameraModel.from_config(car.camera), found.extrinsics)
    marks = found.marks or (None, None)
    for path in write_pictures(folder, {"ground_grid": ground_picture(found.picture, camera, *marks)}):
        say(str(path))
    if found.doubt and not dry_run:
        raise CalibrationError(found.doubt)
    known = {at: error for at, error in found.error_m.items() if math.isfinite(error)}
    errors = ", ".join(f"{1e3 * error:.0f} mm at {at:g} m" for at, error in known.items())
    values = {key: round(getattr(found.extrinsics, key), 5) for key in KEYS}
    residual = f"{found.residual_px:.2f} px; on the ground {errors}"
    write_values(car_file, {"camera.extrinsics": values}, residual=residual, method=found.method, dry_run=dry_run)
    return 0


@contextlib.contextmanager
def _pictures(sources: Sequence[str], car: CarConfig, car_file: Path) -> Iterator[Pictures]:
    """The pictures of the files, or some of the camera."""
    if is_live(sources):
        with live_camera(car, car_file) as camera:
            yield itertools.islice(live_frames(camera), _WARM_UP, _WARM_UP + _LIVE_FRAMES)
    else:
        yield readable(pictures_of(named_paths(sources), car))


def _show(found: Found, as_json: bool) -> None:
    """Where the camera is, and the errors on the ground, as tables or as one row of JSON."""
    values = {key: getattr(found.extrinsics, key) for key in KEYS}
    errors = [
        {"distance_m": at, "error_mm": _mm(error), "within_mm": _mm(found.bound_m.get(at))}
        for at, error in found.error_m.items()
    ]
    if as_json:
        std = {f"std_{key}": found.std.get(key) for key in KEYS}
        row = {"method": found.method, **values, **std, "residual_px": found.residual_px, "errors": errors}
        show("calibrate ground", [row], as_json)
        return
    rows = [
        {"": key, "value": value, "+-": found.std.get(key), "deg": _deg(key, value)} for key, value in values.items()
    ]
    show("calibrate ground", rows, as_json)
    print(f"\nresidual {found.residual_px:.2f} px, by {found.method}\n")
    show("calibrate ground", errors, as_json)
    print("error_mm: root mean square, ahead of the camera; within_mm: in 95 of 100 such calibrations")


def _mm(length_m: float | None) -> float | None:
    return round(1e3 * length_m, 1) if length_m is not None and math.isfinite(length_m) else None


def _deg(key: str, value: float) -> float | None:
    return math.degrees(value) if key.endswith("_rad") else None
