"""A car.toml guessed from a recording, written with its errors; and why a replay saw no lane at all."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from automodel.assembly.parts import open_source
from automodel.config import CarConfig, ConfigError, parse_car
from automodel.console.messages import say
from automodel.console.progress import progress
from automodel.geometry import CameraModel
from automodel.signals import StereoFrame
from automodel.sources.errors import EndOfSource, SourceError
from automodel.types import Image
from calibration.car_file import replace_file
from calibration.from_lanes import camera_from_lanes
from calibration.guess import GuessedCar, guess_car

IMAGES = 40  # of a source that are looked at, evenly over what is read
READ_FRAMES = 9000  # at most: five minutes at 30 frames/s
FITS_PITCH_RAD, FITS_HEIGHT = math.radians(2.0), 1.3  # from car.toml; beyond them a pipeline finds no lane

SAME_WIDTH, LEAST_TRACKED = 1.15, 0.5  # ratio to the width guessed with, and share of frames: else it is doubtful
DOUBTFUL = (
    "the guess is doubtful: with it the lane is seldom seen, or of another width; use a part of the drive with a "
    "straight road, or calibrate the camera"
)


class EvenSample:
    """Up to `2 * IMAGES` images, evenly spaced over however many are added."""

    def __init__(self) -> None:
        self.images: list[Image] = []
        self._every, self._count = 1, 0

    def add(self, image: Image) -> None:
        """One more image of the source."""
        if self._count % self._every == 0:
            self.images.append(image)
        self._count += 1
        if len(self.images) > 2 * IMAGES:
            self.images, self._every = self.images[::2], 2 * self._every


def guess_car_file(
    source: Path, car_file: Path, lane_width_m: float | None, view_rad: float | None, rate_hz: float | None
) -> CarConfig:
    """Guess the car of a video, folder of images or recording, say it, and write `car_file`.

    An older file is kept beside it. Raises ConfigError where the images do not show a lane or the file cannot be
    written, SourceError for a source that cannot be read.
    """
    images, own_hz = _images(source, rate_hz)
    try:
        guess = guess_car(images, rate_hz or own_hz, lane_width_m, view_rad, source.name)
    except ValueError as error:
        raise ConfigError(f"{source}: no car.toml can be guessed: {error}") from None
    text = car_text(guess, source.name)
    car = parse_car(text, str(car_file))
    try:
        backup = replace_file(Path(os.path.realpath(car_file)), text)
    except OSError as error:
        raise ConfigError(f"{car_file}: cannot be written: {error.strerror}") from None
    for line in summary(guess):
        say(line)
    say(f"{car_file}: written" + ("" if backup is None else f"; the old file is {backup}"))
    return car


def _images(path: Path, rate_hz: float | None) -> tuple[list[Image], float]:
    """Images of the source, all of one size, and its frame rate [Hz]."""
    sample, car = EvenSample(), CarConfig()
    with contextlib.closing(open_source(path, car, rate_hz)) as source, progress("looking at the lane", None) as bar:
        with contextlib.suppress(EndOfSource):
            for _ in range(READ_FRAMES):
                frame = source.read(1.0)
                if isinstance(frame, StereoFrame):
                    raise ConfigError(f"{path}: --guess is for one camera, not for a stereo pair")
                if frame is None:
                    continue
                if sample.images and frame.image.shape[:2] != sample.images[0].shape[:2]:
                    raise SourceError(f"{path}: frame {frame.index}: another size than the frames before it")
                sample.add(frame.image)
                bar()
        return sample.images, float(getattr(source, "rate_hz", 0.0) or car.camera.rate_hz)


def summary(guess: GuessedCar) -> list[str]:
    """What was guessed, with one sigma, and what that rests on; a line each."""
    e, lane, sigma = guess.car.camera.extrinsics, guess.car.lane, guess.sigma
    angles = "  ".join(
        f"{name} {math.degrees(getattr(e, f'{name}_rad')):+.1f} +- {math.degrees(sigma[f'{name}_rad']):.1f} deg"
        for name in ("pitch", "yaw", "roll")
    )
    lines = [
        f"guessed from {guess.lanes.frames_used} of {guess.lanes.frames_seen} images: {angles}  "
        f"height {e.z_m:.3g} +- {sigma['z_m']:.2g} m",
        f"{lane.markings} markings {lane.marking_width_m:.2g} m wide on a lane of {lane.width_m:g} m",
    ]
    if "lane width" not in guess.told:
        lines.append(
            f"the lane's width is only assumed ({lane.width_m:g} +- {sigma['width_m']:.2g} m): all metres are in "
            "proportion to it; give it with --lane-width-m"
        )
    if "focal length" not in guess.told:
        lines.append(
            "the lens is only assumed (that of a usual camera): pitch and heading are in proportion to it; give its "
            "horizontal field of view with --view-deg, or calibrate it (automodel calibrate camera)"
        )
    return lines


def car_text(guess: GuessedCar, source: str) -> str:
    """The car.toml, with one sigma beside each value."""
    camera, lane, vehicle, sigma = guess.car.camera, guess.car.lane, guess.car.vehicle, guess.sigma
    lens, place = camera.intrinsics, camera.extrinsics
    name = source.encode("unicode_escape").decode()
    rows = [
        "# Guessed from images by automodel replay --guess; behind each value stands one sigma.",
        f"# Source: {name}, {guess.lanes.frames_used} of {guess.lanes.frames_seen} images of a straight road.",
        "# All metres are in proportion to [lane] width_m, "
        + ("which was given." if "lane width" in guess.told else "which is only assumed."),
        "[camera]",
        f"width_px = {camera.width_px}",
        f"height_px = {camera.height_px}",
        f"rate_hz = {camera.rate_hz:g}",
        "",
        "[camera.intrinsics]",
        _row("fx_px", lens.fx_px, 1, sigma["fx_px"]),
        _row("fy_px", lens.fy_px, 1, sigma["fx_px"]),
        _row("cx_px", lens.cx_px, 1),
        _row("cy_px", lens.cy_px, 1),
        f"distortion = {list(lens.distortion)}",
        "",
        "[camera.extrinsics]",
        f"x_m = {place.x_m:g}  # distances and poses are those of the point below the camera",
        *(_row(key, getattr(place, key), 5, sigma[key]) for key in ("z_m", "pitch_rad", "yaw_rad", "roll_rad")),
        "",
        "[vehicle]  # of a usual car for such a lane; only a car that drives needs it",
        *(_row(key, getattr(vehicle, key), 3) for key in ("wheelbase_m", "reference_x_m", "width_m")),
        *(_row(key, getattr(vehicle, key), 3) for key in ("front_overhang_m", "rear_overhang_m")),
        "",
        "[lane]",
        _row("width_m", lane.width_m, 3, sigma["width_m"]),
        _row("marking_width_m", lane.marking_width_m, 4),
        f'markings = "{lane.markings}"',
        "",
        "[control]",
        _row("lookahead_min_m", guess.car.control.lookahead_min_m, 3),
    ]
    return "\n".join(rows) + "\n"


def _row(key: str, value: float, digits: int, sigma: float | None = None) -> str:
    error = "" if not sigma else f"  # +- {sigma:.2g}"
    return f"{key} = {round(value, digits)}{error}"


def trustworthy(widths_m: Sequence[float], frames: int, car: CarConfig) -> bool:
    """Whether a guessed car is confirmed by the widths [m] of the lane in the frames that show both of its lines.

    A pipeline measures the width over the whole road in view, bends too, of which the guess made no use.
    """
    if len(widths_m) < LEAST_TRACKED * frames:
        return False
    ratio = float(np.median(widths_m)) / car.lane.width_m
    return 1.0 / SAME_WIDTH < ratio < SAME_WIDTH


def why_lost(images: Sequence[Image], car: CarConfig) -> str:
    """Why no lane was found in the images: what is seen in them, and what of it does not fit car.toml; one line."""
    place, lane = car.camera.extrinsics, car.lane
    try:
        found = camera_from_lanes(images, CameraModel.from_config(car.camera), lane.width_m, place)
    except ValueError as error:
        return f"no straight lane is seen ({str(error).removeprefix('images: ')})"
    seen, misfits = found.extrinsics, []
    if abs(seen.pitch_rad - place.pitch_rad) > FITS_PITCH_RAD:
        pitches = (f"{math.degrees(pitch):.1f}" for pitch in (seen.pitch_rad, place.pitch_rad))
        misfits.append("the lines meet where pitch is {} deg, not {}".format(*pitches))
    if not 1.0 / FITS_HEIGHT < seen.z_m / place.z_m < FITS_HEIGHT:
        misfits.append(
            f"a lane of {lane.width_m:g} m is as wide as seen from {seen.z_m:.3g} m above it, not {place.z_m:.3g}"
        )
    if lane.markings not in ("both", found.markings):
        misfits.append(f"the markings are {found.markings}, not {lane.markings}")
    if not misfits:
        return f"straight lines are seen where car.toml says, but {car.pipeline.name} did not follow them"
    return f"{'; '.join(misfits)}. Correct car.toml, or let --guess write one"
