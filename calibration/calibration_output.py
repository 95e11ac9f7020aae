"""What the calibrations write: pictures into a folder, and the values, last of all, into car.toml."""

from __future__ import annotations

import datetime
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2

from automodel.config import ConfigError
from automodel.console.messages import say
from automodel.types import Image
from calibration.car_file import check_car_file, update_car_file

FOLDER = "calibration_pictures"


def picture_folder(out: Path | None, car_file: Path) -> Path:
    """Where the pictures go: the folder that was given, or one beside car.toml; raises ConfigError for a bad place."""
    folder = out if out is not None else car_file.parent / FOLDER
    there = folder
    while not there.exists() and there != there.parent:
        there = there.parent
    if not there.is_dir():
        raise ConfigError(f"--out {folder}: {there} is not a folder")
    if not os.access(there, os.W_OK):
        raise ConfigError(f"--out {folder}: cannot be written; look at the permissions")
    return folder


def check_before(car_file: Path, dry_run: bool) -> None:
    """Refuse now what could not be written after the work; raises ConfigError."""
    if not dry_run:
        check_car_file(car_file)


def write_pictures(folder: Path, pictures: Mapping[str, Image]) -> Sequence[Path]:
    """Write `<name>.png` each, the old one replaced in one step; raises ConfigError."""
    paths = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, picture in pictures.items():
            path = folder / f"{name}.png"
            part = folder / f".{name}.part"
            try:
                part.write_bytes(cv2.imencode(".png", picture)[1].tobytes())
                os.replace(part, path)
            finally:
                part.unlink(missing_ok=True)
            paths.append(path)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be written: {error.strerror}") from None
    return paths


def write_values(
    car_file: Path, values: Mapping[str, Mapping[str, object]], *, residual: str, method: str, dry_run: bool
) -> None:
    """Write the values into car.toml and say so, or say that nothing was written."""
    if dry_run:
        say(f"{car_file}: left as it is (--dry-run)")
        return
    backup = update_car_file(car_file, values, residual=residual, date=datetime.date.today(), method=method)
    sections = ", ".join(f"[{name}]" for name in values)
    say(f"{car_file}: {sections} written" + ("" if backup is None else f"; the old file is {backup}"))
