"""`calibrate stereo`: lens and place of the right camera, from pairs of images of a board that both cameras see."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np

from automodel.config import CarConfig, Extrinsics, Intrinsics, load_car
from automodel.console.progress import progress
from automodel.console.tables import show, terminal_width, wrapped
from automodel.geometry import CameraModel, GroundCamera
from automodel.types import FloatArray, Image
from calibration.boards import Board
from calibration.camera import Check, calibrate_camera, check_camera
from calibration.camera_dialogue import MOST_VIEWS, settled
from calibration.car_file import check_car_file, write_values
from calibration.ground import NAMES
from calibration.pictures import epipolar_picture, picture_folder, write_pictures
from calibration.stereo import (
    PairError,
    PairView,
    StereoCalibration,
    calibrate_stereo,
    check_count,
    check_direction,
    check_left,
    check_stereo,
    corners_of_both,
    pair_views,
)
from calibration.views import CalibrationError, Refused, View, Views

SIDES = ("left", "right")


@dataclass(frozen=True, slots=True, kw_only=True)
class StereoOptions:
    """What the command line says; `fit_lens` measures the right lens also where car.toml has it."""

    board: Board
    car_file: Path
    out: Path | None
    fit_lens: bool
    as_json: bool
    dry_run: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairFeed:
    """Pairs of images, left first, by name; `total` is their number where it is known."""

    pairs: Iterator[tuple[str, Image, Image]]
    total: int | None


def calibrate_from_pairs(
    options: StereoOptions, open_pairs: Callable[[CarConfig], AbstractContextManager[PairFeed]]
) -> int:
    """Find the boards, fit, draw and write; returns the exit code. On ValueError and OSError car.toml is unchanged."""
    board, car_file = options.board, options.car_file
    folder = picture_folder(options.out, car_file)
    if not options.dry_run:
        check_car_file(car_file)
    car = load_car(car_file)
    check_left(car, car_file)
    images: dict[str, tuple[Image, Image]] = {}
    with open_pairs(car) as feed:
        kept, refused = _looked(feed, board, car, images)
    pairs = pair_views(*kept, board)
    check_count(pairs)
    right, left = car.camera.right, GroundCamera.from_config(car.camera)
    known = right is not None and right.intrinsics != Intrinsics()
    fit_lens = options.fit_lens or not known
    lens, lens_checks = _lens(kept[1], board) if right is None or fit_lens else (right.intrinsics, ())
    found = calibrate_stereo(pairs[:: math.ceil(len(pairs) / MOST_VIEWS)], board, left, lens, fit_lens)
    placed = right is not None and right.extrinsics != Extrinsics()
    check_direction(found, car.camera.extrinsics, right.extrinsics if right is not None and placed else None)
    checks = (*check_stereo(found, car.camera.width_px), *lens_checks)
    _show(found, [*refused, *found.dropped], checks, options.as_json)
    write_pictures(folder, {"stereo_epipolar": _drawn(found, left, images)})
    failed = [f"{check.name}: {check.text}" for check in checks if check.status == "FAIL"]
    if failed:
        raise CalibrationError(f"{car_file} is unchanged, the right camera found is implausible: {'; '.join(failed)}")
    _write(found, fit_lens, options)
    return 0


def _looked(
    feed: PairFeed, board: Board, car: CarConfig, images: dict[str, tuple[Image, Image]]
) -> tuple[tuple[list[View], list[View]], list[Refused]]:
    """The views of both cameras, and the images refused; the pairs of images with views go to `images`.

    Raises CalibrationError for an image of another size than car.toml's, and where a camera never saw the board.
    """
    sides, first = (Views(board), Views(board)), dict[str, tuple[Image, Image]]()
    wanted = car.camera.width_px, car.camera.height_px
    with progress("looking for the board", feed.total) as bar:
        for name, *pair in feed.pairs:
            for side, views, image in zip(SIDES, sides, pair, strict=True):
                height, width = image.shape[:2]
                if (width, height) != wanted:
                    raise CalibrationError(
                        f"{name}: expected {wanted[0]}x{wanted[1]} pixels, for which [camera] was calibrated, got "
                        f"{width}x{height} of the {side} camera; take the images at the size in which the car drives"
                    )
                views.consider(name, image)
            if not first:
                first[name] = pair[0], pair[1]
            if any(views.kept and views.kept[-1].name == name for views in sides):
                images[name] = pair[0], pair[1]
            bar()
    kept: list[list[View]] = []
    refused: list[Refused] = []
    for number, (side, views) in enumerate(zip(SIDES, sides, strict=True)):
        try:
            used, unused = settled(views, {name: pair[number] for name, pair in first.items()})
        except CalibrationError as error:
            raise CalibrationError(f"{side} camera: {error}") from None
        kept.append(used)
        refused += [dataclasses.replace(one, reason=f"{side}: {one.reason}") for one in unused]
    return (kept[0], kept[1]), refused


def _lens(views: list[View], board: Board) -> tuple[Intrinsics, tuple[Check, ...]]:
    """The right lens from all views of the right camera, where the fit of both cameras starts, and its checks."""
    try:
        found = calibrate_camera(views[:: math.ceil(len(views) / MOST_VIEWS)], board)
    except CalibrationError as error:
        raise CalibrationError(f"right camera: {error}") from None
    checks = [dataclasses.replace(check, name=f"right lens, {check.name}") for check in check_camera(found)]
    return found.intrinsics, tuple(checks)


def _show(found: StereoCalibration, refused: list[Refused], checks: tuple[Check, ...], as_json: bool) -> None:
    """The pairs, the right camera and the checks as tables, or everything as one row of JSON."""
    pairs = [_pair_row(error) for error in found.pairs] + [
        {**dict.fromkeys(_pair_row(found.pairs[0])), "pair": seen.name, "note": seen.reason} for seen in refused
    ]
    place = {name: getattr(found.extrinsics, name) for name in NAMES}
    lens = {name: getattr(found.intrinsics, name) for name in ("fx_px", "fy_px", "cx_px", "cy_px")}
    errors = {
        "baseline_m": found.baseline_m,
        "rms_px": found.rms_px,
        "left_out_px": found.cross_validated_px,
        "epipolar_px": found.epipolar_px,
    }
    if as_json:
        std = {f"std_{name}": found.std[name] for name in NAMES}
        judged = [dataclasses.asdict(check) for check in checks]
        row = {**place, **std, **errors, **lens, "distortion": list(found.intrinsics.distortion), "pairs": pairs}
        show("calibrate stereo", [{**row, "checks": judged}], as_json)
        return
    show("calibrate stereo", pairs, as_json, ("pair", "rms_px", "left_out_px", "epipolar_px", "note"))
    click.echo()
    rows = [
        {
            "": name,
            "value": value,
            "+-": found.std[name],
            "deg": math.degrees(value) if name.endswith("_rad") else None,
            "+- deg": math.degrees(found.std[name]) if name.endswith("_rad") else None,
        }
        for name, value in place.items()
    ]
    show("calibrate stereo", rows, as_json)
    click.echo("+-: one sigma beside the left camera, whose own errors are not in it\n")
    show("calibrate stereo", [{**errors, **lens}], as_json)
    click.echo(f"k1 k2 p1 p2 k3 = {' '.join(f'{k:g}' for k in found.intrinsics.distortion)}\n")
    for check in checks:
        click.echo(wrapped(f"{check.status:4}  {check.name}: {check.text}", terminal_width(), 6))


def _pair_row(error: PairError) -> dict[str, object]:
    return {
        "pair": error.pair.name,
        "corners": len(error.epipolar_px),
        "rms_px": round(error.rms_px, 3),
        "left_out_px": round(error.held_out_px, 3),
        "epipolar_px": round(float(np.sqrt(np.mean(error.epipolar_px**2))), 3),
        "note": "",
    }


def _drawn(found: StereoCalibration, left: GroundCamera, images: dict[str, tuple[Image, Image]]) -> Image:
    """The pair with the largest board in the left image."""

    def size_px(pair: PairView) -> float:
        assert pair.left is not None
        return float(np.prod(np.ptp(pair.left.found.corners_px, 0)))

    largest = max((error.pair for error in found.pairs), key=size_px)
    model = CameraModel(found.intrinsics, left.camera.width_px, left.camera.height_px)
    corners: tuple[FloatArray, FloatArray] = corners_of_both(largest)
    return epipolar_picture(
        images[largest.name], (left, GroundCamera(model, found.extrinsics)), corners, found.epipolar_px
    )


def _write(found: StereoCalibration, fit_lens: bool, options: StereoOptions) -> None:
    values: dict[str, dict[str, object]] = {}
    if fit_lens:
        values["camera.right.intrinsics"] = dataclasses.asdict(found.intrinsics)
    values["camera.right.extrinsics"] = dataclasses.asdict(found.extrinsics)
    kind = "chessboard" if options.board.marker_m is None else "ChArUco board"
    off_rad = max(found.std[name] for name in NAMES if name.endswith("_rad"))
    off_m = max(found.std[name] for name in NAMES if name.endswith("_m"))
    write_values(
        options.car_file,
        values,
        residual=f"{found.rms_px:.3f} px rms, {found.cross_validated_px:.3f} px in pairs left out, "
        f"{found.epipolar_px:.3f} px off epipolar lines; beside the left camera +- {math.degrees(off_rad):.3f} deg, "
        f"{1e3 * off_m:.1f} mm",
        method=f"{kind} {options.board.size}, {len(found.pairs)} pairs"
        + ("" if fit_lens else "; the right lens was known"),
        dry_run=options.dry_run,
    )
