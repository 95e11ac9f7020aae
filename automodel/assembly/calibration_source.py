"""Images to calibrate with: files, folders, globs, videos and recordings, the camera itself, and pairs of images."""

from __future__ import annotations

import contextlib
import glob
from collections.abc import Iterator, Sequence
from pathlib import Path

from automodel.assembly.parts import is_live_camera, left_alone, make_camera, open_pair, open_source
from automodel.assembly.replay import frames_of
from automodel.config import CarConfig, ConfigError
from automodel.console.messages import say
from automodel.interfaces import Source
from automodel.recording.reader import RecordingSource
from automodel.signals import Frame, Motion, StereoFrame
from automodel.sources.cameras import CaptureThread
from automodel.sources.errors import EndOfSource, SourceError
from automodel.sources.files import SUFFIXES, MotionTable, is_tub, natural_key, read_motion_csv
from automodel.sources.images import read_image
from automodel.sources.pairs import PairSource
from automodel.types import Image
from calibration.stereo_dialogue import PairFeed
from calibration.stereo_lanes_dialogue import DriveFeed
from calibration.views import ImageFeed

LIVE = "live"
_FRAMES = 120  # of a video or recording that are used, evenly over its length
_EVERY = 10  # frames, where the length is not known
_READ_S = 5.0


@contextlib.contextmanager
def open_images(
    sources: Sequence[str], car_file: Path, car: CarConfig, *, any_mode: bool = False
) -> Iterator[ImageFeed]:
    """The images that the arguments name, `live` for those of the car's camera; raises ConfigError, SourceError.

    `any_mode` as that of `make_camera`: for the calibration of the lens itself.
    """
    if tuple(sources) == (LIVE,):
        with _live_camera(car, car_file, any_mode) as camera:
            yield ImageFeed(images=_live_frames(camera), live=True, total=None)
        return
    paths = named_paths(sources)
    total = len(paths) if all(path.suffix.lower() in SUFFIXES for path in paths) else None
    yield ImageFeed(images=_images_of(paths, car), live=False, total=total)


def named_paths(sources: Sequence[str]) -> list[Path]:
    """The files that the arguments name: globs expanded, folders as their images; raises ConfigError."""
    paths: list[Path] = []
    for source in sources:
        path = Path(source)
        if path.is_dir():
            found = [p for p in path.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file()]
            if not found:
                raise ConfigError(f"{source}: no images in this folder ({', '.join(SUFFIXES)})")
        elif path.exists():
            paths.append(path)
            continue
        else:
            found = [Path(name) for name in glob.glob(source)]
            if not found:
                raise ConfigError(f"{source}: no such file or folder")
        paths.extend(sorted(found, key=lambda p: (natural_key(p.name), p.name)))
    return list(dict.fromkeys(paths))


def _images_of(paths: Sequence[Path], car: CarConfig) -> Iterator[tuple[str, Image | SourceError]]:
    """Name and image, about a hundred of a video or recording; an unreadable image is its error."""
    short = len({path.name for path in paths}) == len(paths)
    for path in paths:
        if path.suffix.lower() in SUFFIXES:
            name = path.name if short else str(path)
            try:
                yield name, read_image(path, colour=False)
            except SourceError as error:
                yield name, error
        else:
            yield from _frames(path, car)


def _frames(path: Path, car: CarConfig) -> Iterator[tuple[str, Image]]:
    source = open_source(path, car, None)
    count = source.recording.counts.get("frames") if isinstance(source, RecordingSource) else None
    count = getattr(source, "frame_count", count)
    every = max(1, count // _FRAMES) if count else _EVERY
    with contextlib.closing(source), contextlib.suppress(EndOfSource):
        number = 0
        while True:
            frame = source.read(_READ_S)
            if isinstance(frame, Frame):
                if number % every == 0:
                    yield f"{path.name}:{frame.index}", frame.image
                number += 1


@contextlib.contextmanager
def open_pairs(left: Path, right: Path, car: CarConfig) -> Iterator[PairFeed]:
    """The images of two folders or videos in pairs; raises ConfigError, SourceError."""
    for path in (left, right):
        if path.suffix.lower() == ".mcap" or is_tub(path):
            raise ConfigError(f"{path}: expected two folders of images or two videos, got a recording")
    if left.exists() and right.exists() and left.is_dir() != right.is_dir():
        raise ConfigError(f"{left} and {right}: expected two folders of images or two videos, got one of each")
    with contextlib.closing(open_pair(left, right, car, None)) as source:
        yield PairFeed(pairs=_pairs_of(source, left), total=source.frame_count)
        if source.unpaired:
            apart_ms = 1e3 * source.tolerance_s
            say(f"{left}, {right}: {source.unpaired} frames have no partner within {apart_ms:.3g} ms")


def _pairs_of(source: PairSource, left: Path) -> Iterator[tuple[str, Image, Image]]:
    """Name and images of each pair; of videos about a hundred pairs."""
    every = 1 if left.is_dir() else max(1, source.frame_count // _FRAMES) if source.frame_count else _EVERY
    files = named_paths([str(left)]) if left.is_dir() else []
    with contextlib.suppress(EndOfSource):
        number = 0
        while (pair := source.read(_READ_S)) is not None:
            if number % every == 0:
                name = files[pair.index].name if files else f"{left.name}:{pair.index}"
                yield name, pair.left, pair.right
            number += 1


@contextlib.contextmanager
def open_drive(
    left: Path, right: Path | None, motion_file: Path | None, rate_hz: float | None, car: CarConfig
) -> Iterator[DriveFeed]:
    """A drive in pairs: a recording that has both cameras, or two videos or folders with a table of motion.

    `rate_hz` is as that of `open_source`. Raises ConfigError, SourceError.
    """
    if right is None and left.suffix.lower() != ".mcap":
        raise ConfigError(f"{left}: expected a recording of both cameras, or two videos or folders, LEFT and RIGHT")
    motion = None if motion_file is None else read_motion_csv(motion_file)
    source = open_source(left, car, rate_hz) if right is None else open_pair(left, right, car, rate_hz)
    with contextlib.closing(source):
        yield DriveFeed(pairs=_driven(source, motion, left), total=getattr(source, "frame_count", None))


def _driven(source: Source, motion: MotionTable | None, left: Path) -> Iterator[tuple[str, StereoFrame, Motion]]:
    """Name, pair and motion of each frame that is one; raises ConfigError where none is."""
    pairs = 0
    for frame, moved, _ in frames_of(source, motion):
        if isinstance(frame, StereoFrame):
            pairs += 1
            yield f"{left.name}:{frame.index}", frame, moved
    if not pairs:
        raise ConfigError(f"{left}: holds no pairs of images; record it with both cameras, by a pipeline of two")


@contextlib.contextmanager
def _live_camera(car: CarConfig, car_file: Path, any_mode: bool) -> Iterator[Source]:
    """The camera of car.toml (the left one of a pair), read in a thread that keeps the newest frame.

    A file is read frame by frame.
    """
    if car.camera.source == "sim":
        raise ConfigError(f'{car_file}: [camera] source "sim" gives no images; live is for a camera')
    camera = make_camera(left_alone(car), any_mode=any_mode)
    if is_live_camera(car):
        camera = CaptureThread(camera)
    try:
        yield camera
    finally:
        camera.close()


def _live_frames(camera: Source) -> Iterator[tuple[str, Image]]:
    """Name and image of every frame until the camera ends; raises SourceError after 5 s without one."""
    with contextlib.suppress(EndOfSource):
        while True:
            frame = camera.read(_READ_S)
            if frame is None:
                raise SourceError(f"no image from the camera in {_READ_S:.0f} s; is it plugged in and free?")
            if isinstance(frame, Frame):
                yield f"frame {frame.index}", frame.image
