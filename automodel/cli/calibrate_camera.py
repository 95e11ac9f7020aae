"""`automodel calibrate camera`: the lens, from pictures of a chessboard or a ChArUco board."""

from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path
from typing import Any

import click
import numpy as np

from automodel.assembly.calibration_source import is_live, live_camera, live_frames, named_paths, pictures_of
from automodel.assembly.parts import car_of
from automodel.cli.options import ABOVE_ZERO, FILE, finite
from automodel.config import CarConfig, ConfigError, load_car
from automodel.config.toml_reader import parse_toml, read_text
from automodel.console.messages import say
from automodel.console.progress import progress
from automodel.console.tables import show
from automodel.geometry import CameraModel
from automodel.sources.errors import SourceError
from automodel.sources.files import SUFFIXES
from automodel.types import Image
from calibration.boards import DICTIONARIES, Board, other_dictionary
from calibration.calibration_output import check_before, picture_folder, write_pictures, write_values
from calibration.camera import CameraCalibration, Check, ViewError, calibrate_camera, check_camera, field_of_view_deg
from calibration.pictures import coverage_picture, residual_picture, undistorted_picture
from calibration.views import CalibrationError, Refused, View, Views, coverage, missing_sights, settle

LIVE_COVERAGE = 0.8  # of the picture; then, and with views enough, the camera has seen the board
_MOST_VIEWS = 60  # more only take time


def board_size(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[int, int] | None:
    """A callback that reads "9x6"."""
    if value is None:
        return None
    size = re.fullmatch(r"(\d{1,3})[xX](\d{1,3})", value)
    if not size:
        raise click.BadParameter(f"{value!r} where columns x rows of inner corners are wanted, as 9x6", ctx, param)
    return int(size.group(1)), int(size.group(2))


def board_of(size: tuple[int, int], square_mm: float, marker_mm: float | None, dictionary: str) -> Board:
    """The board of the options; raises UsageError."""
    marker_m = None if marker_mm is None else 1e-3 * marker_mm
    try:
        return Board(columns=size[0], rows=size[1], square_m=1e-3 * square_mm, marker_m=marker_m, dictionary=dictionary)
    except ValueError as error:
        raise click.UsageError(str(error)) from None


@click.command("camera")
@click.argument("sources", metavar="SOURCE...", nargs=-1, required=True)
@click.option("--board", "size", required=True, callback=board_size, help="Inner corners: columns x rows, as 9x6.")
@click.option("--square-mm", type=ABOVE_ZERO, callback=finite, required=True, help="The side of a square.")
@click.option("--charuco", is_flag=True, help="The white squares have ArUco markers.")
@click.option("--marker-mm", type=ABOVE_ZERO, callback=finite, help="ChArUco: the side of a marker.  [3/4 square]")
@click.option("--dictionary", type=click.Choice(DICTIONARIES), default="4x4_50", show_default=True, help="ChArUco.")
@click.option(
    "--car", "car_file", type=FILE, default="car.toml", show_default=True, help="Where the camera is written."
)
@click.option("--out", type=FILE, help="Folder for the pictures.  [calibration_pictures beside car.toml]")
@click.option("--views", "wanted", type=click.IntRange(4, 200), default=20, show_default=True, help="Live: so many.")
@click.option("--json", "as_json", is_flag=True, help="Figures as JSON on stdout.")
@click.option("--dry-run", is_flag=True, help="Measure and draw, but leave car.toml as it is.")
def command(
    sources: tuple[str, ...], size: tuple[int, int], car_file: Path, out: Path | None, dry_run: bool, **more: Any
) -> int:
    """The camera's lens from SOURCE: pictures, a folder, a glob or a video of a board, or `live` for the camera itself.

    Show the board near and far, in the picture's corners, too, and tilted by 20 to 50 degrees to all sides; 15 views
    are good. The printed board must be flat: glue it on something stiff.
    """
    if more["marker_mm"] is not None and not more["charuco"]:
        raise click.UsageError("--marker-mm is for --charuco")
    marker_mm = (more["marker_mm"] or 0.75 * more["square_mm"]) if more["charuco"] else None
    board = board_of(size, more["square_mm"], marker_mm, more["dictionary"])
    folder = picture_folder(out, car_file)
    check_before(car_file, dry_run)
    car = car_of(car_file if car_file.exists() else None)
    views, pictures = Views(board), dict[str, Image]()
    if is_live(sources):
        _look_live(views, pictures, (car, car_file), more["wanted"], folder)
    else:
        _look(views, pictures, named_paths(sources), car)
    kept, refused = _settled(views, pictures)
    size_keys = {} if dry_run else check_size(car_file, kept[0].width_px, kept[0].height_px)
    found = calibrate_camera(kept[:: math.ceil(len(kept) / _MOST_VIEWS)], board)
    checks = check_camera(found)
    _show(found, [*refused, *found.dropped], checks, board, more["as_json"])
    for path in write_pictures(folder, _drawn(found, pictures)):
        say(str(path))
    failed = [f"{check.name}: {check.text}" for check in checks if check.status == "FAIL"]
    if failed:
        raise CalibrationError(f"{car_file} is left as it is, this camera cannot be: {'; '.join(failed)}")
    _write(found, board, size_keys, car_file, dry_run)
    return 0


def _look(views: Views, pictures: dict[str, Image], paths: list[Path], car: CarConfig) -> None:
    """Consider every picture of the files; those of the views kept go to `pictures`, and the very first."""
    total = len(paths) if all(path.suffix.lower() in SUFFIXES for path in paths) else None
    with progress("looking for the board", total) as bar:
        for name, image in pictures_of(paths, car):
            if isinstance(image, SourceError):
                views.refused.append(Refused(name=name, reason=str(image)))
            elif isinstance(views.consider(name, image), View) or not pictures:
                pictures[name] = image
            bar()


def _look_live(views: Views, pictures: dict[str, Image], of: tuple[CarConfig, Path], wanted: int, folder: Path) -> None:
    """Take views from the camera until there are enough of them all over the picture, and say what is missing."""
    last = ""
    with live_camera(*of) as camera:
        say(f"show the board near and far and tilted; the picture is in {folder}/camera_coverage.png; Ctrl-C gives up")
        for name, image in live_frames(camera):
            pictures.setdefault("first", image)
            seen = views.consider(name, image)
            if isinstance(seen, Refused):
                if seen.reason.split(":")[0] != last:
                    last = seen.reason.split(":")[0]
                    say(f"not taken: {seen.reason}")
                continue
            pictures[name], last = image, ""
            height, width = image.shape[:2]
            write_pictures(folder, {"camera_coverage": coverage_picture(views.kept, (width, height))})
            share = float((coverage(views.kept) > 0).mean())
            missing = missing_sights(views.kept)
            say(f"{len(views.kept)} views, {100.0 * share:.0f} % of the picture; {missing or 'all sides seen'}")
            if len(views.kept) >= wanted and share >= LIVE_COVERAGE and not missing:
                return


def _settled(views: Views, pictures: dict[str, Image]) -> tuple[list[View], list[Refused]]:
    """The views to use; a board with other markers than said is named."""
    try:
        return settle(views)
    except CalibrationError as error:
        nothing = not views.kept and all(seen.found is None for seen in views.refused)
        if views.board.marker_m is None or not nothing or not pictures:
            raise
        other = other_dictionary(next(iter(pictures.values())), views.board)
        if other is None:
            raise
        raise CalibrationError(f"{error} The markers are those of --dictionary {other}") from None


def _show(
    found: CameraCalibration, refused: list[Refused], checks: tuple[Check, ...], board: Board, as_json: bool
) -> None:
    """The views and the checks as tables, or everything as one row of JSON."""
    views = [_view_row(error, board) for error in found.views] + [
        {**dict.fromkeys(_view_row(found.views[0], board)), "picture": seen.name, "note": seen.reason}
        for seen in refused
    ]
    lens, view_deg = found.intrinsics, field_of_view_deg(found)
    figures = {
        **{name: getattr(lens, name) for name in ("fx_px", "fy_px", "cx_px", "cy_px")},
        "focal_std_px": found.focal_std_px,
        "rms_px": found.rms_px,
        "left_out_px": found.cross_validated_px,
        "view_deg": view_deg if math.isfinite(view_deg) else None,
        "views": len(found.views),
    }
    if as_json:
        size = {"width_px": found.width_px, "height_px": found.height_px, "distortion": list(lens.distortion)}
        told = [{"name": check.name, "status": check.status, "text": check.text} for check in checks]
        show("calibrate camera", [{**figures, **size, "pictures": views, "checks": told}], as_json)
        return
    show("calibrate camera", views, as_json)
    print()
    show("calibrate camera", [figures], as_json)
    print(f"k1 k2 p1 p2 k3 = {' '.join(f'{k:g}' for k in lens.distortion)}\n")
    for check in checks:
        print(f"{check.status:4}  {check.name}: {check.text}")


def _view_row(error: ViewError, board: Board) -> dict[str, object]:
    view = error.view
    return {
        "picture": view.name,
        "corners": view.found.size,
        "tilt_deg": round(math.degrees(view.slant_rad)),
        "edge_px": round(view.edge_px, 2),
        "rms_px": round(error.rms_px, 3),
        "left_out_px": round(error.held_out_px, 3),
        "note": "" if view.found.size == board.size else f"used: {len(view.found.grid)} corners of a part of the board",
    }


def _drawn(found: CameraCalibration, pictures: dict[str, Image]) -> dict[str, Image]:
    """The three pictures; the undistorted one is that in which the board is largest."""
    largest = max(
        (error.view for error in found.views), key=lambda view: float(np.prod(np.ptp(view.found.corners_px, 0)))
    )
    camera = CameraModel(found.intrinsics, found.width_px, found.height_px)
    return {
        "camera_coverage": coverage_picture([e.view for e in found.views], (found.width_px, found.height_px)),
        "camera_residuals": residual_picture(found),
        "camera_undistorted": undistorted_picture(pictures[largest.name], camera),
    }


def check_size(car_file: Path, width_px: int, height_px: int) -> dict[str, object]:
    """The picture's size as keys of [camera] that car.toml lacks; raises ConfigError where it says another size."""
    said = parse_toml(read_text(car_file), str(car_file)).get("camera", {}) if car_file.exists() else {}
    size: dict[str, object] = {"width_px": width_px, "height_px": height_px}
    if any(said.get(key, value) != value for key, value in size.items()):
        camera = load_car(car_file).camera
        raise ConfigError(
            f"{car_file}: [camera] says {camera.width_px}x{camera.height_px} and the pictures have "
            f"{width_px}x{height_px}; a calibration holds for one size: take them at the size in which the car drives"
        )
    return {key: value for key, value in size.items() if key not in said}


def _write(found: CameraCalibration, board: Board, size_keys: dict[str, object], car_file: Path, dry_run: bool) -> None:
    lens = found.intrinsics
    values: dict[str, dict[str, object]] = {"camera": size_keys} if size_keys else {}
    values["camera.intrinsics"] = dataclasses.asdict(lens)
    kind = "chessboard" if board.marker_m is None else "ChArUco board"
    write_values(
        car_file,
        values,
        residual=f"{found.rms_px:.3f} px rms, {found.cross_validated_px:.3f} px in views left out",
        method=f"{kind} {board.size}, {len(found.views)} views of {found.width_px}x{found.height_px}",
        dry_run=dry_run,
    )
