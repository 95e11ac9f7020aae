"""The ways to find out where the camera looks: taped points, a sheet on the floor, a drive along a lane."""

from __future__ import annotations

import csv
import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np

from automodel.cli.calibrate_camera import board_of
from automodel.config import CarConfig, ConfigError, Extrinsics
from automodel.console.progress import progress
from automodel.geometry import CameraModel
from automodel.sources.errors import SourceError
from automodel.types import FloatArray, Image
from calibration.boards import Board
from calibration.from_lanes import LanesCalibration, camera_from_lanes
from calibration.ground import GroundCalibration, GroundPoints, camera_from_points
from calibration.printed_targets import ArucoSheet, SheetPlace, camera_from_sheet, find_sheet
from calibration.views import CalibrationError

Pictures = Iterator[tuple[str, Image]]

HEADER = ("x_m", "y_m", "u_px", "v_px")
LANE_FRAMES = 60  # of a drive that are looked at, spread over its length
_OTHER_HEIGHT, _NO_HEIGHT = 1.3, 1.6  # times what car.toml says: worth a word; more than a ruler can be wrong
_TRIES = 30  # pictures that are searched for the sheet


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Found:
    """What one of the methods gave, in the same terms for all.

    `std`: one sigma of each of the extrinsics where it is known; `marks`: measured points (n, 2) [m] and their pixels;
    `doubt`: why it must not be written.
    """

    method: str
    extrinsics: Extrinsics
    std: Mapping[str, float]
    residual_px: float
    error_m: Mapping[float, float]
    bound_m: Mapping[float, float]
    picture: Image
    marks: tuple[FloatArray, FloatArray] | None = None
    remarks: tuple[str, ...] = ()
    doubt: str = ""


def check_method(options: Mapping[str, Any]) -> str:
    """The one method that the options ask for: "board", "aruco", "points" or "lanes"; raises UsageError."""
    asked = {
        "board": options["size"] is not None,
        "aruco": options["aruco"] is not None,
        "points": bool(options["points"]) or options["points_file"] is not None,
        "lanes": options["from_lanes"],
    }
    methods = [name for name, wanted in asked.items() if wanted]
    if len(methods) != 1:
        raise click.UsageError("give one of --board, --aruco, --point or --points, --from-lanes")
    if methods[0] in ("board", "aruco") and options["place_m"] is None:
        raise click.UsageError("--at X Y is wanted: where the middle of the sheet lies [m], ahead and left")
    if methods[0] == "board" and options["square_mm"] is None:
        raise click.UsageError("--square-mm is wanted: the side of a square of the board")
    if methods[0] == "aruco" and options["marker_mm"] is None:
        raise click.UsageError("--marker-mm is wanted: the side of a marker")
    return methods[0]


def by_lanes(pictures: Pictures, car: CarConfig, options: Mapping[str, Any]) -> Found:
    """From many pictures of a straight drive."""
    width_m = options["lane_width_m"] or car.lane.width_m
    camera = CameraModel.from_config(car.camera)
    with progress("reading the drive", None) as bar:
        seen = []
        for name, image in pictures:
            check_size(name, image, car)
            seen.append(image)
            bar()
    seen = seen[:: max(1, math.ceil(len(seen) / LANE_FRAMES))]
    found = camera_from_lanes(seen, camera, width_m, car.camera.extrinsics)
    return Found(
        method=f"a lane of {width_m:g} m, {found.frames_used} of {found.frames_seen} pictures of a drive",
        extrinsics=found.extrinsics,
        std={},
        residual_px=found.residual_px,
        error_m=found.ground_error_m,
        bound_m={},
        picture=seen[len(seen) // 2],
        remarks=_lane_remarks(found, car),
        doubt=_lane_doubt(found, car),
    )


def _lane_doubt(found: LanesCalibration, car: CarConfig) -> str:
    """Two lanes taken for one give a camera twice as high, and all metres twice as long."""
    before_m, height_m = car.camera.extrinsics.z_m, found.extrinsics.z_m
    if 1.0 / _NO_HEIGHT < height_m / before_m < _NO_HEIGHT:
        return ""
    return (
        f"the camera cannot be {height_m:.3g} m high where [camera.extrinsics] z_m = {before_m:.3g}: lines that are "
        f"not {found.lane_width_m:g} m apart were seen (of two lanes?), or z_m is wrong; give --lane-width-m, or z_m"
    )


def _lane_remarks(found: LanesCalibration, car: CarConfig) -> tuple[str, ...]:
    remarks = []
    if not found.roll_known:
        remarks.append("roll_rad is as it was: the lines do not show it")
    before_m, height_m = car.camera.extrinsics.z_m, found.extrinsics.z_m
    if not 1.0 / _OTHER_HEIGHT < height_m / before_m < _OTHER_HEIGHT:
        remarks.append(
            f"z_m is {height_m:.3g} and was {before_m:.3g}: check it with a rule; if the lines that were seen are not "
            f"{found.lane_width_m:g} m apart (those of two lanes, perhaps), give their distance with --lane-width-m"
        )
    return tuple(remarks)


def by_points(pictures: Pictures, car: CarConfig, options: Mapping[str, Any]) -> Found:
    """From taped points in one picture, which only serves to draw on."""
    rows = [tuple(point) for point in options["points"]]
    if options["points_file"] is not None:
        rows += read_points(options["points_file"])
    table = np.array(rows, dtype=np.float64)
    name, image = next(pictures, ("", None))
    if image is None:
        raise CalibrationError("there is no picture to draw the points on")
    check_size(name, image, car)
    measured = GroundPoints(points_m=table[:, :2], pixels=table[:, 2:], point_m=1e-3 * options["tape_mm"])
    camera = CameraModel.from_config(car.camera)
    found = camera_from_points(measured, camera, car.camera.extrinsics, options["keep_position"])
    return _found(f"{len(rows)} taped points", found, image, (measured.points_m, measured.pixels))


def by_sheet(pictures: Pictures, car: CarConfig, options: Mapping[str, Any]) -> Found:
    """From the first picture that shows the sheet on the floor."""
    sheet = _sheet(options)
    tape_m = 1e-3 * options["tape_mm"]
    x_m, y_m = options["place_m"]
    tries, seen, image = 0, None, None
    for name, image in itertools.islice(pictures, _TRIES):
        check_size(name, image, car)
        tries += 1
        seen = find_sheet(image, sheet)
        if seen is not None:
            break
    what = "the sheet of markers" if isinstance(sheet, ArucoSheet) else f"the whole board of {sheet.size} inner corners"
    if seen is None or image is None:
        raise CalibrationError(f"{what} is in none of {tries} pictures; is its size right, and all of it in the light?")
    extent = float(np.ptp(seen.points_m, axis=0).max())
    place = SheetPlace(
        x_m=x_m,
        y_m=y_m,
        turn_rad=math.radians(options["turn_deg"]),
        accuracy_m=tape_m,
        accuracy_rad=tape_m * math.sqrt(2.0) / extent,  # both ends of an edge laid along a line
    )
    camera = CameraModel.from_config(car.camera)
    found, measured = camera_from_sheet(seen, place, camera, car.camera.extrinsics, options["keep_position"])
    return _found(f"{what} on the floor at ({x_m:g}, {y_m:g}) m", found, image, (measured.points_m, measured.pixels))


def _sheet(options: Mapping[str, Any]) -> Board | ArucoSheet:
    marker_mm, dictionary = options["marker_mm"], options["dictionary"]
    if options["aruco"] is None:
        if options["charuco"] and marker_mm is None:
            marker_mm = 0.75 * options["square_mm"]
        return board_of(options["size"], options["square_mm"], marker_mm if options["charuco"] else None, dictionary)
    columns, rows = options["aruco"]
    try:
        return ArucoSheet(
            columns=columns, rows=rows, marker_m=1e-3 * marker_mm, gap_m=1e-3 * options["gap_mm"], dictionary=dictionary
        )
    except ValueError as error:
        raise click.UsageError(str(error)) from None


def _found(method: str, found: GroundCalibration, image: Image, marks: tuple[FloatArray, FloatArray]) -> Found:
    return Found(
        method=method,
        extrinsics=found.extrinsics,
        std=found.std,
        residual_px=found.residual_px,
        error_m=found.error_m,
        bound_m=found.bound_m,
        picture=image,
        marks=marks,
    )


def check_size(name: str, image: Image, car: CarConfig) -> None:
    """Raise CalibrationError for a picture of another size than the camera was calibrated for."""
    height, width = image.shape[:2]
    if (width, height) != (car.camera.width_px, car.camera.height_px):
        raise CalibrationError(
            f"{name}: {width}x{height} pixels where [camera] was calibrated for {car.camera.width_px}x"
            f"{car.camera.height_px}; take the picture at that size, or calibrate the camera at this one"
        )


def readable(pictures: Iterable[tuple[str, Image | SourceError]]) -> Pictures:
    """The pictures; raises the error of the first that cannot be read."""
    for name, image in pictures:
        if isinstance(image, SourceError):
            raise image
        yield name, image


def read_points(path: Path) -> Sequence[tuple[float, ...]]:
    """Rows x_m, y_m, u_px, v_px of a CSV file with that header; raises ConfigError with file and line."""
    try:
        with open(path, encoding="utf-8-sig", newline="") as file:
            rows = list(csv.reader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text file in UTF-8"
        raise ConfigError(f"{path}: cannot be read: {reason}") from None
    if not rows or tuple(cell.strip() for cell in rows[0]) != HEADER:
        raise ConfigError(f"{path}:1: the first line must be {','.join(HEADER)}")
    points = []
    for line, row in enumerate(rows[1:], 2):
        if not row:
            continue
        try:
            point = tuple(float(cell) for cell in row)
        except ValueError:
            point = ()
        if len(point) != len(HEADER) or not all(math.isfinite(number) for number in point):
            raise ConfigError(f"{path}:{line}: {','.join(row)!r} where four finite numbers are wanted")
        points.append(point)
    return points
