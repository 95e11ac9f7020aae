"""`calibrate ground`: where the camera looks, from taped points, a sheet on the floor or a drive along a lane."""

from __future__ import annotations

import csv
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import click
import numpy as np

from automodel.config import CarConfig, ConfigError, Extrinsics, load_car
from automodel.console.messages import say
from automodel.console.progress import progress
from automodel.console.tables import show
from automodel.geometry import CameraModel, GroundCamera
from automodel.sources.errors import SourceError
from automodel.types import FloatArray, Image
from calibration.boards import Board
from calibration.car_file import check_car_file, write_values
from calibration.from_lanes import LanesCalibration, camera_from_lanes, check_consistent
from calibration.ground import NAMES, GroundCalibration, GroundPoints, camera_from_points
from calibration.pictures import ground_picture, picture_folder, write_pictures
from calibration.printed_targets import ArucoSheet, SheetPlace, camera_from_sheet, find_sheet
from calibration.views import CalibrationError, ImageFeed

NamedImages = Iterator[tuple[str, Image]]

HEADER = ("x_m", "y_m", "u_px", "v_px")
LANE_FRAMES = 60  # of a drive that are used, evenly over its length
_WARM_UP, _LIVE_FRAMES = 15, 60  # the camera's first frames may be dark
_OTHER_HEIGHT, _NO_HEIGHT = 1.3, 1.6  # ratio to z_m of car.toml: from the first a remark, from the second a refusal
_TRIES = 30  # images that are searched for the sheet


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Found:
    """The result of a method, the same for all.

    `std`: one sigma of each of the extrinsics where it is known; `marks`: measured points (n, 2) [m] and their pixels;
    `refusal`: why the result must not be written.
    """

    method: str
    extrinsics: Extrinsics
    std: Mapping[str, float]
    residual_px: float
    error_m: Mapping[float, float]
    bound_m: Mapping[float, float]
    image: Image
    marks: tuple[FloatArray, FloatArray] | None = None
    lane: Mapping[str, object] | None = None  # keys of [lane] that were measured or given
    remarks: tuple[str, ...] = ()
    refusal: str = ""


class Method(Protocol):
    """A way to calibrate the ground."""

    def measure(self, images: NamedImages, car: CarConfig) -> Found:
        """The camera from the images; raises CalibrationError, ConfigError, SourceError."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundOptions:
    """What the command line says."""

    method: Method
    car_file: Path
    out: Path | None
    as_json: bool
    dry_run: bool


def calibrate_ground(
    options: GroundOptions, open_images: Callable[[CarConfig], AbstractContextManager[ImageFeed]]
) -> int:
    """Measure, draw and write; returns the exit code. On ValueError and OSError car.toml is unchanged."""
    car_file = options.car_file
    folder = picture_folder(options.out, car_file)
    if not options.dry_run:
        check_car_file(car_file)
    car = load_car(car_file) if car_file.exists() else CarConfig()
    if car.calibration.camera is None:
        say(f"{car_file}: [camera.intrinsics] were never calibrated; the result is only as good as they are")
    with open_images(car) as feed:
        images = _checked(feed, car)
        if feed.live:
            images = itertools.islice(images, _WARM_UP, _WARM_UP + _LIVE_FRAMES)
        found = options.method.measure(images, car)
    _show(found, options.as_json)
    for remark in found.remarks:
        say(remark)
    camera = GroundCamera(CameraModel.from_config(car.camera), found.extrinsics)
    marks = found.marks or (None, None)
    write_pictures(folder, {"ground_grid": ground_picture(found.image, camera, *marks)})
    if found.refusal and not options.dry_run:
        raise CalibrationError(found.refusal)
    errors = [f"{1e3 * error:.0f} mm at {at:g} m" for at, error in found.error_m.items() if math.isfinite(error)]
    values = {name: round(getattr(found.extrinsics, name), 5) for name in NAMES}
    residual = f"{found.residual_px:.2f} px; on the ground {', '.join(errors)}"
    written: dict[str, Mapping[str, object]] = {"camera.extrinsics": values}
    if found.lane is not None:
        written["lane"] = found.lane
    write_values(car_file, written, residual=residual, method=found.method, dry_run=options.dry_run)
    return 0


def _checked(feed: ImageFeed, car: CarConfig) -> NamedImages:
    """The images; raises SourceError for an unreadable one, CalibrationError for one of the wrong size."""
    wanted = car.camera.width_px, car.camera.height_px
    for name, image in feed.images:
        if isinstance(image, SourceError):
            raise image
        height, width = image.shape[:2]
        if (width, height) != wanted:
            raise CalibrationError(
                f"{name}: expected {wanted[0]}x{wanted[1]} pixels, for which [camera] was calibrated, got "
                f"{width}x{height}; take the image at that size, or calibrate the camera at this one"
            )
        yield name, image


def _show(found: Found, as_json: bool) -> None:
    """The camera's place and the errors on the ground, as tables or as one row of JSON."""
    values = {name: getattr(found.extrinsics, name) for name in NAMES}
    errors = [
        {"distance_m": at, "error_mm": _mm(error), "within_mm": _mm(found.bound_m.get(at))}
        for at, error in found.error_m.items()
    ]
    if as_json:
        std = {f"std_{name}": found.std.get(name) for name in NAMES}
        row = {"method": found.method, **values, **std, "residual_px": found.residual_px, "errors": errors}
        show("calibrate ground", [row], as_json)
        return
    rows = [
        {
            "": name,
            "value": value,
            "+-": found.std.get(name),
            "deg": math.degrees(value) if name.endswith("_rad") else None,
        }
        for name, value in values.items()
    ]
    show("calibrate ground", rows, as_json)
    click.echo(f"\nresidual {found.residual_px:.2f} px, by {found.method}\n")
    show("calibrate ground", errors, as_json)
    click.echo("error: root mean square, ahead of the camera; within: 95 of 100 such calibrations")


def _mm(length_m: float | None) -> float | None:
    return round(1e3 * length_m, 1) if length_m is not None and math.isfinite(length_m) else None


@dataclass(frozen=True, slots=True, kw_only=True)
class StraightDrive:
    """Many images of a straight drive along a lane of a known width (default: that of car.toml)."""

    width_m: float | None

    def measure(self, images: NamedImages, car: CarConfig) -> Found:
        """Implements `Method`."""
        width_m = self.width_m or car.lane.width_m
        with progress("reading the drive", None) as bar:
            seen = []
            for _, image in images:
                seen.append(image)
                bar()
        seen = seen[:: max(1, math.ceil(len(seen) / LANE_FRAMES))]
        camera = CameraModel.from_config(car.camera)
        found = camera_from_lanes(seen, camera, width_m, car.camera.extrinsics)
        check_consistent(seen, camera, found)
        return Found(
            method=f"a lane of {width_m:g} m, {found.frames_used} of {found.frames_seen} images of a drive",
            extrinsics=found.extrinsics,
            std=found.std,
            residual_px=found.residual_px,
            error_m=found.ground_error_m,
            bound_m={},
            image=seen[len(seen) // 2],
            lane=_lane_of(found, car),
            remarks=_lane_remarks(found, car),
            refusal=_lane_refusal(found, car),
        )


def _lane_of(found: LanesCalibration, car: CarConfig) -> Mapping[str, object]:
    """Keys of [lane]: the height is only right together with the width that it was found with."""
    same = car.lane.markings in (found.markings, "both")
    return {"width_m": found.lane_width_m} | ({} if same else {"markings": found.markings})


def _lane_refusal(found: LanesCalibration, car: CarConfig) -> str:
    """Two lanes taken for one give a camera twice as high, and all distances twice as long."""
    before_m, height_m = car.camera.extrinsics.z_m, found.extrinsics.z_m
    if 1.0 / _NO_HEIGHT < height_m / before_m < _NO_HEIGHT:
        return ""
    return (
        f"the camera cannot be {height_m:.3g} m high where [camera.extrinsics] z_m = {before_m:.3g}: the lines are not "
        f"{found.lane_width_m:g} m apart (those of two lanes?), or z_m is wrong; give --lane-width-m, or correct z_m"
    )


def _lane_remarks(found: LanesCalibration, car: CarConfig) -> tuple[str, ...]:
    remarks = []
    if not found.roll_known:
        remarks.append("roll_rad is unchanged: the lines do not show it")
    before_m, height_m = car.camera.extrinsics.z_m, found.extrinsics.z_m
    if not 1.0 / _OTHER_HEIGHT < height_m / before_m < _OTHER_HEIGHT:
        remarks.append(
            f"z_m is {height_m:.3g} and was {before_m:.3g}: check it with a ruler; if the lines seen are not "
            f"{found.lane_width_m:g} m apart (those of two lanes, perhaps), give their distance with --lane-width-m"
        )
    return tuple(remarks)


@dataclass(frozen=True, slots=True, kw_only=True)
class TapedPoints:
    """Ground points x, y [m] with their pixels u, v in one image, from the command line and a file."""

    rows: tuple[tuple[float, ...], ...]
    file: Path | None
    tape_m: float
    keep_position: bool

    def measure(self, images: NamedImages, car: CarConfig) -> Found:
        """Implements `Method`; the image is only drawn on."""
        rows = [*self.rows, *(read_points(self.file) if self.file is not None else ())]
        table = np.array(rows, dtype=np.float64)
        _, image = next(images, ("", None))
        if image is None:
            raise CalibrationError("there is no image to draw the points on")
        measured = GroundPoints(points_m=table[:, :2], pixels=table[:, 2:], point_m=self.tape_m)
        camera = CameraModel.from_config(car.camera)
        found = camera_from_points(measured, camera, car.camera.extrinsics, self.keep_position)
        return _found(f"{len(rows)} taped points", found, image, measured)


@dataclass(frozen=True, slots=True, kw_only=True)
class SheetOnFloor:
    """A board or a sheet of markers that lies on the floor, its middle at `place_m` (x, y) of the body frame."""

    sheet: Board | ArucoSheet
    place_m: tuple[float, float]
    turn_rad: float
    tape_m: float
    keep_position: bool

    def measure(self, images: NamedImages, car: CarConfig) -> Found:
        """Implements `Method`, with the first image that shows the sheet."""
        sheet, (x_m, y_m) = self.sheet, self.place_m
        tries, seen, image = 0, None, None
        for _, image in itertools.islice(images, _TRIES):
            tries += 1
            seen = find_sheet(image, sheet)
            if seen is not None:
                break
        what = "the sheet of markers"
        if isinstance(sheet, Board):
            what = f"the whole board of {sheet.size} inner corners"
        if seen is None or image is None:
            raise CalibrationError(
                f"{what} is in none of {tries} images; is its size right, and is all of it visible and lit?"
            )
        extent = float(np.ptp(seen.points_m, axis=0).max())
        place = SheetPlace(
            x_m=x_m,
            y_m=y_m,
            turn_rad=self.turn_rad,
            accuracy_m=self.tape_m,
            accuracy_rad=self.tape_m * math.sqrt(2.0) / extent,  # both ends of an edge laid along a line
        )
        camera = CameraModel.from_config(car.camera)
        found, measured = camera_from_sheet(seen, place, camera, car.camera.extrinsics, self.keep_position)
        return _found(f"{what} on the floor at ({x_m:g}, {y_m:g}) m", found, image, measured)


def _found(method: str, found: GroundCalibration, image: Image, measured: GroundPoints) -> Found:
    return Found(
        method=method,
        extrinsics=found.extrinsics,
        std=found.std,
        residual_px=found.residual_px,
        error_m=found.error_m,
        bound_m=found.bound_m,
        image=image,
        marks=(measured.points_m, measured.pixels),
    )


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
            raise ConfigError(f"{path}:{line}: expected four finite numbers, got {','.join(row)!r}")
        points.append(point)
    return points
