"""`calibrate stereo --from-lanes`: the place of the right camera, from a drive along a marked road with odometry."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np

from automodel.config import CarConfig, ConfigError, Extrinsics, Intrinsics, load_car
from automodel.config.camera import SecondCamera
from automodel.console.messages import say
from automodel.console.progress import progress
from automodel.console.tables import show, terminal_width, wrapped
from automodel.geometry import CameraModel, GroundCamera
from automodel.signals import Motion, StereoFrame
from automodel.types import Image
from calibration.camera import Check
from calibration.car_file import check_car_file, write_values
from calibration.ground import NAMES
from calibration.lane_sights import Drive, DrivenPair, SightReader
from calibration.pictures import lanes_picture, picture_folder, write_pictures
from calibration.stereo import check_left, check_sides
from calibration.stereo_lanes import StereoFromLanes, calibrate_stereo_from_lanes, check_from_lanes
from calibration.views import CalibrationError

LINKED = 0.9  # correlation of two errors from which on they are named together


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveOptions:
    """What the command line says."""

    car_file: Path
    out: Path | None
    as_json: bool
    dry_run: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DriveFeed:
    """Pairs of a drive, each with its name and the motion since the one before; `total` where it is known."""

    pairs: Iterator[tuple[str, StereoFrame, Motion]]
    total: int | None


def calibrate_from_drive(
    options: DriveOptions, open_drive: Callable[[CarConfig], AbstractContextManager[DriveFeed]]
) -> int:
    """Read the drive, fit, draw and write; returns the exit code. On ValueError and OSError car.toml is unchanged."""
    car_file = options.car_file
    folder = picture_folder(options.out, car_file)
    if not options.dry_run:
        check_car_file(car_file)
    car = load_car(car_file)
    check_left(car, car_file)
    right = _right_of(car, car_file)
    lens = CameraModel(right.intrinsics, car.camera.width_px, car.camera.height_px)
    with open_drive(car) as feed:
        windows = driven_windows(feed, car)
    found = calibrate_stereo_from_lanes(windows, car, lens, right.extrinsics)
    check_sides(found.extrinsics, car.camera.extrinsics, right.extrinsics)
    checks = check_from_lanes(found)
    _show(found, checks, options.as_json)
    for remark in remarks(found):
        say(remark)
    write_pictures(folder, {"stereo_lanes": _drawn(found, windows, car, lens)})
    failed = [f"{check.name}: {check.text}" for check in checks if check.status == "FAIL"]
    if failed:
        raise CalibrationError(f"{car_file} is unchanged, the drive does not give the camera: {'; '.join(failed)}")
    _write(found, options)
    return 0


def _right_of(car: CarConfig, car_file: Path) -> SecondCamera:
    """The right camera of car.toml, its lens calibrated and its place about known; raises ConfigError."""
    right = car.camera.right
    if right is None or right.intrinsics == Intrinsics():
        raise ConfigError(
            f"{car_file}: [camera.right.intrinsics] are missing, and lanes do not show a lens; calibrate the right "
            "camera's lens with a board, as that of a car of one camera (automodel calibrate camera), and copy it there"
        )
    if right.extrinsics == Extrinsics():
        raise ConfigError(
            f"{car_file}: [camera.right.extrinsics] are missing, and the search starts from them; measure them with a "
            "ruler, to about 2 deg and 2 % of the cameras' distance"
        )
    return right


def driven_windows(feed: DriveFeed, car: CarConfig) -> list[list[DrivenPair]]:
    """The stretches of the drive that are used; raises CalibrationError for images of another size, or too few."""
    drive, wanted = Drive(car.lane.width_m), (car.camera.width_px, car.camera.height_px)
    with progress("reading the drive", feed.total) as bar:
        for name, pair, motion in feed.pairs:
            for side, image in (("left", pair.left), ("right", pair.right)):
                if image.shape[1::-1] != wanted:
                    raise CalibrationError(
                        f"{name}: expected {wanted[0]}x{wanted[1]} pixels, for which [camera] was calibrated, got "
                        f"{image.shape[1]}x{image.shape[0]} of the {side} camera"
                    )
            drive.add(name, pair.left, pair.right, motion)
            bar()
    if not drive.windows:
        raise CalibrationError(
            f"the drive is {drive.travelled_m:.1f} m long by its odometry; expected at least "
            f"{20 * car.lane.width_m:.3g} m"
        )
    return drive.windows


def remarks(found: StereoFromLanes) -> Iterator[str]:
    """What the drive does not show: numbers that stay a ruler's, and pairs whose errors are one."""
    if found.unknown:
        yield (
            f"{', '.join(found.unknown)}: the drive shows next to nothing of it, it is as exact as a ruler; weave in "
            "the lane, take bends to both sides, and for x_m a road with dashes that both cameras see"
        )
    for i, one in enumerate(NAMES):
        for j, other in enumerate(NAMES[:i]):
            if abs(found.correlation[i, j]) > LINKED and not {one, other} & set(found.unknown):
                yield f"{other} and {one} are only known together (correlation {found.correlation[i, j]:.2f})"


def _show(found: StereoFromLanes, checks: tuple[Check, ...], as_json: bool) -> None:
    """The right camera and the checks as tables, or everything as one row of JSON."""
    place = {name: getattr(found.extrinsics, name) for name in NAMES}
    seen = {
        "baseline_m": found.baseline_m,
        "line_px": found.ridge_px,
        "dash_end_px": found.end_px,
        "line_points": found.ridges,
        "dash_ends": found.ends,
        "pairs": found.pairs,
        "stretches": found.windows,
        "stretches_seen": found.windows_seen,
    }
    if as_json:
        std = {f"std_{name}": found.std[name] for name in NAMES}
        judged = [dataclasses.asdict(check) for check in checks]
        row = {**place, **std, **seen, "unknown": list(found.unknown), "correlation": found.correlation.tolist()}
        show("calibrate stereo", [{**row, "checks": judged}], as_json)
        return
    rows = [
        {
            "": name,
            "value": value,
            "+-": found.std[name],
            "deg": math.degrees(value) if name.endswith("_rad") else None,
            "+- deg": math.degrees(found.std[name]) if name.endswith("_rad") else None,
            "note": "a ruler's" if name in found.unknown else "",
        }
        for name, value in place.items()
    ]
    show("calibrate stereo", rows, as_json)
    click.echo("+-: one sigma beside the left camera, whose own errors are not in it\n")
    show("calibrate stereo", [seen], as_json)
    click.echo()
    for check in checks:
        click.echo(wrapped(f"{check.status:4}  {check.name}: {check.text}", terminal_width(), 6))


def _drawn(found: StereoFromLanes, windows: list[list[DrivenPair]], car: CarConfig, lens: CameraModel) -> Image:
    """The pair of the middle of the drive in which the left camera sees most."""
    left, right = GroundCamera.from_config(car.camera), GroundCamera(lens, found.extrinsics)
    reader, pairs = SightReader(car), windows[len(windows) // 2]
    sights = [reader.look(pair.images[0], left) for pair in pairs]
    best = int(np.argmax([len(sight.px) for sight in sights]))
    return lanes_picture(pairs[best].images, (left, right), sights[best].px, sights[best].end_px)


def _write(found: StereoFromLanes, options: DriveOptions) -> None:
    off_rad, off_m = (max(found.std[name] for name in NAMES if name.endswith(unit)) for unit in ("_rad", "_m"))
    write_values(
        options.car_file,
        {"camera.right.extrinsics": dataclasses.asdict(found.extrinsics)},
        residual=f"{found.ridge_px:.2f} px of lines"
        + ("" if found.end_px is None else f", {found.end_px:.2f} px of dashes' ends")
        + f"; beside the left camera +- {math.degrees(off_rad):.3f} deg, {1e3 * off_m:.1f} mm"
        + (f"; by a ruler: {', '.join(found.unknown)}" if found.unknown else ""),
        method=f"lanes and odometry, {found.pairs} pairs of a drive; both lenses were known",
        dry_run=options.dry_run,
    )
