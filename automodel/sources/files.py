"""Files as sources: videos, folders of images and donkeycar tubs (version 2); and the motion in motion.csv."""

from __future__ import annotations

import csv
import json
import math
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from automodel.config.toml_reader import ConfigError, check_file
from automodel.signals import Frame, Motion, MotionSource
from automodel.sources.errors import EndOfSource, SourceError
from automodel.sources.images import opencv_silenced, read_image, with_channels
from automodel.types import FloatArray

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read once by OpenCV: the errors raised here replace its log

SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff", ".pgm", ".ppm")
HEADER = ("t_s", "speed_mps", "yaw_rate_radps")  # of motion.csv
_COUNT_TOLERANCE = 0.02  # containers derive the number of frames from the duration, which is not exact
_IMAGE, _ANGLE, _THROTTLE = "cam/image_array", "user/angle", "user/throttle"  # keys of a tub's records
_MOST_INDEX = 2**31  # of a tub's record: a year at 60 images a second
_MOST_INPUT = 10.0  # of a driver's input, -1 .. 1; some tubs go a little beyond it
_MOST_MOTION = (1e9, 200.0, 100.0)  # [s] 30 years, [m/s] and [rad/s] faster than any car


class VideoSource:
    """The frames of a video file at the file's rate or at `rate_hz`, the first at time 0.

    Raises SourceError for a file that is missing, is no video or has no frame rate, and (from `read`) at the end of a
    cut file, which has clearly fewer frames than its header says.
    """

    def __init__(self, path: str | Path, rate_hz: float | None = None, colour: bool = False) -> None:
        self.path, self.colour = Path(path), colour
        if rate_hz is not None and not rate_hz > 0:
            raise ValueError(f"rate_hz: expected a positive number, got {rate_hz}")
        if not self.path.is_file():
            raise SourceError(f"{path}: no such file")
        try:
            self.path.open("rb").close()  # OpenCV does not say why it opens none
        except OSError as error:
            raise SourceError(f"{path}: cannot be read: {error.strerror}") from None
        with opencv_silenced():
            self._capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
        if not self._capture.isOpened():
            raise SourceError(f"{path}: cannot be opened as a video: it is cut, damaged or something else")
        own_hz = float(self._capture.get(cv2.CAP_PROP_FPS))
        if rate_hz is None and not (math.isfinite(own_hz) and 0 < own_hz <= 1000):
            self.close()
            raise SourceError(f"{path}: the file has no frame rate; give it with --rate")
        self.rate_hz = own_hz if rate_hz is None else rate_hz
        count = float(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        self.frame_count = int(count) if math.isfinite(count) and 0 < count < 1e9 else None  # None: unknown
        self._next = 0

    def read(self, timeout_s: float) -> Frame:
        """The next frame; raises EndOfSource after the last."""
        with opencv_silenced():
            there, image = self._capture.read()
        if not there:
            self._check_end()
            raise EndOfSource
        frame = Frame(
            t_ns=round(self._next * 1e9 / self.rate_hz),
            index=self._next,
            image=with_channels(np.asarray(image, dtype=np.uint8), self.colour),
        )
        self._next += 1
        return frame

    def close(self) -> None:
        """Close the file; may be called twice."""
        self.frame_count = None
        self._capture.release()

    def _check_end(self) -> None:
        if self.frame_count is None:
            return
        missing = self.frame_count - self._next
        if missing > max(2, _COUNT_TOLERANCE * self.frame_count):
            raise SourceError(f"{self.path}: ends after {self._next} of {self.frame_count} frames: the file is cut")


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """A sort key that puts `2.png` before `10.png`."""
    parts = re.findall(r"[0-9]+|[^0-9]+", name.lower())
    return tuple((0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts)


class ImageSource:
    """The images of a folder in natural order at a fixed rate, the first at time 0.

    Raises SourceError for a folder that is missing or has no images, and (from `read`) for a damaged image or one whose
    size differs from the first, by name.
    """

    def __init__(self, folder: str | Path, rate_hz: float = 20.0, colour: bool = False) -> None:
        self.folder, self.rate_hz, self.colour = Path(folder), rate_hz, colour
        if not rate_hz > 0:
            raise ValueError(f"rate_hz: expected a positive number, got {rate_hz}")
        if not self.folder.is_dir():
            raise SourceError(f"{folder}: no such folder")
        found = (p for p in self.folder.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file())
        self.files = sorted(found, key=lambda p: (natural_key(p.name), p.name))
        if not self.files:
            raise SourceError(f"{folder}: no images in this folder ({', '.join(SUFFIXES)})")
        self._next = 0
        self._shape: tuple[int, ...] | None = None

    def read(self, timeout_s: float) -> Frame:
        """The next image; raises EndOfSource after the last."""
        if self._next >= len(self.files):
            raise EndOfSource
        path = self.files[self._next]
        image = read_image(path, self.colour)
        shape = image.shape[:2]
        if self._shape is not None and shape != self._shape:
            raise SourceError(
                f"{path}: expected {self._shape[1]}x{self._shape[0]} pixels as in the other images, got "
                f"{shape[1]}x{shape[0]}; use one size per folder"
            )
        self._shape = shape
        frame = Frame(t_ns=round(self._next * 1e9 / self.rate_hz), index=self._next, image=image)
        self._next += 1
        return frame

    def close(self) -> None:
        """No more frames."""
        self._next = len(self.files)


@dataclass(frozen=True, slots=True, kw_only=True)
class TubRecord:
    """One line of a catalog: the image file and the driver's input, -1 .. 1, None where not recorded.

    `angle` is as recorded: donkeycar's is positive to the *right*.
    """

    index: int
    image: Path
    angle: float | None
    throttle: float | None


def is_tub(folder: str | Path) -> bool:
    """Whether the folder is a tub of version 2."""
    return (Path(folder) / "manifest.json").is_file()


class TubSource:
    """The images of a donkeycar tub at a given rate (a tub's timestamps are those of the file writer, not the camera).

    A tub is a folder with `manifest.json` (five JSON lines: inputs, types, metadata, manifest metadata, catalogs),
    `catalog_N.catalog` (one JSON object per line) and `images/`. Records in `deleted_indexes` are skipped and leave a
    gap in time. Raises SourceError with file and line for a missing or damaged manifest or catalog, and (from `read`)
    for a damaged image.
    """

    def __init__(self, folder: str | Path, rate_hz: float = 20.0, colour: bool = False) -> None:
        self.folder, self.rate_hz, self.colour = Path(folder), rate_hz, colour
        if not rate_hz > 0:
            raise ValueError(f"rate_hz: expected a positive number, got {rate_hz}")
        self.records = read_tub(self.folder)
        self._next = 0

    def read(self, timeout_s: float) -> Frame:
        """The next image; raises EndOfSource after the last."""
        if self._next >= len(self.records):
            raise EndOfSource
        record = self.records[self._next]
        since = record.index - self.records[0].index
        image = read_image(record.image, self.colour)
        frame = Frame(t_ns=round(since * 1e9 / self.rate_hz), index=self._next, image=image)
        self._next += 1
        return frame

    def record_of(self, frame: Frame) -> TubRecord:
        """The record of a frame that this source delivered."""
        return self.records[frame.index]

    def close(self) -> None:
        """No more frames."""
        self._next = len(self.records)


def read_tub(folder: Path) -> tuple[TubRecord, ...]:
    """The records of a tub in order without the deleted ones; raises SourceError."""
    manifest = folder / "manifest.json"
    lines = _json_lines(manifest)
    catalogs = lines[-1][1] if lines else None
    if not isinstance(catalogs, dict) or not isinstance(catalogs.get("paths"), list):
        raise SourceError(f'{manifest}: not a tub of version 2: its last line has no "paths" list')
    deleted = catalogs.get("deleted_indexes", [])
    if not isinstance(deleted, list) or not all(isinstance(index, int) for index in deleted):
        raise SourceError(f"{manifest}:{lines[-1][0]}: deleted_indexes is not a list of whole numbers")
    records = []
    for name in catalogs["paths"]:
        path = folder / str(name)
        records += [_record(folder, path, number, entry) for number, entry in _json_lines(path)]
    kept = tuple(r for r in records if r.index not in set(deleted))
    if not kept:
        raise SourceError(f"{folder}: the tub holds no records (or all of them are deleted)")
    return kept


def _json_lines(path: Path) -> list[tuple[int, Any]]:
    if path.exists() and not path.is_file():
        raise SourceError(f"{path}: is not a file")
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise SourceError(f"{path}: no such file; is this a donkeycar tub of version 2?") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"{path}: cannot be read: {error}") from error
    values = []
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        try:
            values.append((number, json.loads(line)))
        except (ValueError, RecursionError):  # the first also for a number of thousands of digits
            raise SourceError(f"{path}:{number}: not JSON: the line is cut or damaged; delete it") from None
    return values


def _record(folder: Path, path: Path, number: int, entry: Any) -> TubRecord:
    if not isinstance(entry, dict) or not isinstance(entry.get(_IMAGE), str):
        raise SourceError(f"{path}:{number}: a record without {_IMAGE}")
    index = entry.get("_index")
    if not isinstance(index, int) or isinstance(index, bool):
        raise SourceError(f"{path}:{number}: a record without _index")
    if not 0 <= index <= _MOST_INDEX:
        raise SourceError(f"{path}:{number}: _index: expected 0 .. {_MOST_INDEX}")
    return TubRecord(
        index=index,
        image=_image_path(folder, path, number, entry[_IMAGE]),
        angle=_number(path, number, entry, _ANGLE),
        throttle=_number(path, number, entry, _THROTTLE),
    )


def _image_path(folder: Path, path: Path, number: int, name: str) -> Path:
    """The image `name` of a record; a tub from a stranger may not point at files outside its own folder."""
    images = folder / "images"
    if "\0" in name or not (images / name).resolve().is_relative_to(images.resolve()):
        raise SourceError(f"{path}:{number}: {_IMAGE}: {name!r} is outside the tub's images/")
    return images / name


def _number(path: Path, number: int, entry: dict[str, Any], key: str) -> float | None:
    value = entry.get(key)
    if value is None:
        return None
    if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) <= _MOST_INPUT:
        raise SourceError(f"{path}:{number}: {key}: expected a number, -1 .. 1, got {str(value)[:40]}")
    return float(value)


class MotionTable:
    """Speed [m/s] and yaw rate [rad/s] over time, linearly interpolated; unknown outside the table."""

    def __init__(self, t_s: FloatArray, speed_mps: FloatArray, yaw_rate_radps: FloatArray):
        self._t_s, self._speed_mps, self._yaw_rate_radps = t_s, speed_mps, yaw_rate_radps

    def at(self, t_ns: int) -> Motion:
        """The motion at a frame's time; its source is RECORDED, or NONE outside the table."""
        t_s = t_ns * 1e-9
        if not self._t_s[0] - 1e-9 <= t_s <= self._t_s[-1] + 1e-9:
            return Motion(t_ns=t_ns, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)
        return Motion(
            t_ns=t_ns,
            speed_mps=float(np.interp(t_s, self._t_s, self._speed_mps)),
            yaw_rate_radps=float(np.interp(t_s, self._t_s, self._yaw_rate_radps)),
            source=MotionSource.RECORDED,
        )


def read_motion_csv(path: str | Path) -> MotionTable:
    """Read `t_s,speed_mps,yaw_rate_radps`; t_s counts from the first frame. Raises ConfigError with file and line."""
    check_file(path)
    try:
        with open(path, encoding="utf-8-sig", newline="") as file:
            rows = list(csv.reader(file))
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    if not rows or tuple(cell.strip() for cell in rows[0]) != HEADER:
        raise ConfigError(f"{path}:1: the first line must be {','.join(HEADER)}")
    table = [_numbers(path, line, row) for line, row in enumerate(rows[1:], 2) if row]
    if not table:
        raise ConfigError(f"{path}: no rows below the header")
    values = np.array(table, dtype=np.float64)
    backwards = np.flatnonzero(np.diff(values[:, 0]) <= 0)
    if len(backwards):
        raise ConfigError(f"{path}:{int(backwards[0]) + 3}: t_s must increase from row to row")
    return MotionTable(values[:, 0], values[:, 1], values[:, 2])


def _numbers(path: str | Path, line: int, row: list[str]) -> list[float]:
    if len(row) != len(HEADER):
        raise ConfigError(f"{path}:{line}: expected {len(HEADER)} values, got {len(row)}")
    values = []
    for name, cell, most in zip(HEADER, row, _MOST_MOTION, strict=True):
        try:
            value = float(cell)
        except ValueError:
            value = float("nan")
        if not np.isfinite(value):
            raise ConfigError(f"{path}:{line}: {name}: expected a finite number, got {cell.strip()[:40]!r}")
        if abs(value) > most:
            raise ConfigError(f"{path}:{line}: {name}: expected at most {most:g}, got {value:g}")
        values.append(value)
    return values
