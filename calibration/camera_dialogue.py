"""`calibrate camera`: the lens, from images of a chessboard or a ChArUco board."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np

from automodel.config import CarConfig, ConfigError, load_car
from automodel.config.toml_reader import parse_toml, read_text
from automodel.console.messages import say
from automodel.console.progress import progress
from automodel.console.tables import show, terminal_width, wrapped
from automodel.geometry import CameraModel
from automodel.sources.errors import SourceError
from automodel.types import Image
from calibration.boards import Board, other_dictionary
from calibration.camera import CameraCalibration, Check, ViewError, calibrate_camera, check_camera, field_of_view_deg
from calibration.car_file import check_car_file, write_values
from calibration.pictures import coverage_picture, picture_folder, undistorted_picture, write_pictures
from calibration.plots import residual_picture
from calibration.views import CalibrationError, ImageFeed, Refused, View, Views, coverage, missing_views, settle

LIVE_COVERAGE = 0.8  # share of the image that must be covered before a live calibration ends
MOST_VIEWS = 60  # of a fit; more only take time


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraOptions:
    """What the command line says; `views` is how many a live calibration takes at least."""

    board: Board
    car_file: Path
    out: Path | None
    views: int
    as_json: bool
    dry_run: bool


def calibrate_from_images(
    options: CameraOptions, open_images: Callable[[CarConfig], AbstractContextManager[ImageFeed]]
) -> int:
    """Find the views, fit, draw and write; returns the exit code. On ValueError and OSError car.toml is unchanged."""
    board, car_file = options.board, options.car_file
    folder = picture_folder(options.out, car_file)
    if not options.dry_run:
        check_car_file(car_file)
    car = load_car(car_file) if car_file.exists() else CarConfig()
    views, images = Views(board), dict[str, Image]()
    with open_images(car) as feed:
        if feed.live:
            _look_live(views, images, feed, options.views, folder)
        else:
            _look(views, images, feed)
    kept, refused = settled(views, images)
    size_keys = {} if options.dry_run else check_size(car_file, kept[0].width_px, kept[0].height_px)
    found = calibrate_camera(kept[:: math.ceil(len(kept) / MOST_VIEWS)], board)
    checks = check_camera(found)
    _show(found, [*refused, *found.dropped], checks, board, options.as_json)
    write_pictures(folder, _drawn(found, images))
    failed = [f"{check.name}: {check.text}" for check in checks if check.status == "FAIL"]
    if failed:
        raise CalibrationError(f"{car_file} is unchanged, the camera found is implausible: {'; '.join(failed)}")
    _write(found, size_keys, options)
    return 0


def _look(views: Views, images: dict[str, Image], feed: ImageFeed) -> None:
    """Consider every image; those of the views kept go to `images`, and the first one."""
    with progress("looking for the board", feed.total) as bar:
        for name, image in feed.images:
            if isinstance(image, SourceError):
                views.refused.append(Refused(name=name, reason=str(image)))
            elif isinstance(views.consider(name, image), View) or not images:
                images[name] = image
            bar()


def _look_live(views: Views, images: dict[str, Image], feed: ImageFeed, wanted: int, folder: Path) -> None:
    """Take views from the camera until they are enough and cover the image; report what is missing."""
    last = ""
    say(f"show the board near and far and tilted; the coverage is in {folder}/camera_coverage.png; Ctrl-C gives up")
    for name, image in feed.images:
        if isinstance(image, SourceError):
            raise image
        images.setdefault("first", image)
        seen = views.consider(name, image)
        if isinstance(seen, Refused):
            if seen.reason.split(":")[0] != last:
                last = seen.reason.split(":")[0]
                say(f"not taken: {seen.reason}")
            continue
        images[name], last = image, ""
        height, width = image.shape[:2]
        write_pictures(folder, {"camera_coverage": coverage_picture(views.kept, (width, height))}, quiet=True)
        share = float((coverage(views.kept) > 0).mean())
        missing = missing_views(views.kept)
        say(f"{len(views.kept)} views, {100.0 * share:.0f} % of the image; {missing or 'all sides seen'}")
        if len(views.kept) >= wanted and share >= LIVE_COVERAGE and not missing:
            return


def settled(views: Views, images: dict[str, Image]) -> tuple[list[View], list[Refused]]:
    """The views to use and the images refused; names the right dictionary for a board with other markers."""
    try:
        return settle(views)
    except CalibrationError as error:
        nothing = not views.kept and all(seen.found is None for seen in views.refused)
        if views.board.marker_m is None or not nothing or not images:
            raise
        other = other_dictionary(next(iter(images.values())), views.board)
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
    results = {
        **{name: getattr(lens, name) for name in ("fx_px", "fy_px", "cx_px", "cy_px")},
        "focal_std_px": found.focal_std_px,
        "rms_px": found.rms_px,
        "left_out_px": found.cross_validated_px,
        "view_deg": view_deg if math.isfinite(view_deg) else None,
        "views": len(found.views),
    }
    if as_json:
        size = {"width_px": found.width_px, "height_px": found.height_px, "distortion": list(lens.distortion)}
        judged = [dataclasses.asdict(check) for check in checks]
        show("calibrate camera", [{**results, **size, "pictures": views, "checks": judged}], as_json)
        return
    show("calibrate camera", views, as_json, ("picture", "rms_px", "left_out_px", "note", "corners"))
    click.echo()
    show("calibrate camera", [results], as_json)
    click.echo(f"k1 k2 p1 p2 k3 = {' '.join(f'{k:g}' for k in lens.distortion)}\n")
    for check in checks:
        click.echo(wrapped(f"{check.status:4}  {check.name}: {check.text}", terminal_width(), 6))


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


def _drawn(found: CameraCalibration, images: dict[str, Image]) -> dict[str, Image]:
    """The three pictures; the undistorted one is that with the largest board."""
    largest = max(
        (error.view for error in found.views), key=lambda view: float(np.prod(np.ptp(view.found.corners_px, 0)))
    )
    camera = CameraModel(found.intrinsics, found.width_px, found.height_px)
    return {
        "camera_coverage": coverage_picture([e.view for e in found.views], (found.width_px, found.height_px)),
        "camera_residuals": residual_picture(found),
        "camera_undistorted": undistorted_picture(images[largest.name], camera),
    }


def check_size(car_file: Path, width_px: int, height_px: int) -> dict[str, object]:
    """The image size as those keys of [camera] that car.toml lacks; raises ConfigError where it has another size."""
    present = parse_toml(read_text(car_file), str(car_file)).get("camera", {}) if car_file.exists() else {}
    size: dict[str, object] = {"width_px": width_px, "height_px": height_px}
    if any(present.get(key, value) != value for key, value in size.items()):
        camera = load_car(car_file).camera
        raise ConfigError(
            f"{car_file}: [camera] is {camera.width_px}x{camera.height_px} and the images are {width_px}x{height_px}; "
            "a calibration holds for one size: take the images at the size in which the car drives"
        )
    return {key: value for key, value in size.items() if key not in present}


def _write(found: CameraCalibration, size_keys: dict[str, object], options: CameraOptions) -> None:
    values: dict[str, dict[str, object]] = {"camera": size_keys} if size_keys else {}
    values["camera.intrinsics"] = dataclasses.asdict(found.intrinsics)
    kind = "chessboard" if options.board.marker_m is None else "ChArUco board"
    write_values(
        options.car_file,
        values,
        residual=f"{found.rms_px:.3f} px rms, {found.cross_validated_px:.3f} px in views left out",
        method=f"{kind} {options.board.size}, {len(found.views)} views of {found.width_px}x{found.height_px}",
        dry_run=options.dry_run,
    )
