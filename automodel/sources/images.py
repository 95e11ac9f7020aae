"""Decoding of image files, and checks of size and colour."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from automodel.config import CameraConfig
from automodel.signals import Frame, StereoFrame
from automodel.sources.errors import SourceError
from automodel.types import Image

_TAIL_BYTES = 4096  # cameras may write a few bytes after an image's end marker
_JPEG = (b"\xff\xd8", b"\xff\xd9")
_PNG = (b"\x89PNG", b"IEND")


@contextmanager
def opencv_silenced() -> Iterator[None]:
    """Suppress OpenCV's log on stderr: the error that is raised replaces it."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


@contextmanager
def decoders_silenced() -> Iterator[None]:
    """Suppress what libpng and others write to stderr by themselves; other threads are not heard either."""
    try:
        kept = os.dup(2)
    except OSError:  # it is closed
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def read_image(path: Path, colour: bool) -> Image:
    """The image in a file, (h, w) grey or (h, w, 3) BGR; raises SourceError if it is missing, cut or not an image.

    The end marker is checked first, as decoders silently fill the missing part of a cut JPEG with grey.
    """
    if path.exists() and not path.is_file():
        raise SourceError(f"{path}: is not a file")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error.strerror}") from error
    for start, end in (_JPEG, _PNG):
        if data.startswith(start) and end not in data[-_TAIL_BYTES:]:
            raise SourceError(f"{path}: the image is cut; replace or remove it")
    image: Image | None = None
    if data:
        with (
            opencv_silenced(),
            decoders_silenced(),
            contextlib.suppress(cv2.error),
        ):  # it raises for a size beyond 2^30 pixels
            flag = cv2.IMREAD_COLOR if colour else cv2.IMREAD_GRAYSCALE
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flag)  # type: ignore[assignment]
    if image is None:
        raise SourceError(f"{path}: not an image, or a damaged one; replace or remove it")
    return image


def with_channels(image: Image, colour: bool) -> Image:
    """The image as (h, w, 3) BGR if `colour`, else as (h, w) grey."""
    if colour == (image.ndim == 3):
        return image
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR if colour else cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def check_size(frame: Frame | StereoFrame, camera: CameraConfig) -> None:
    """Raise SourceError unless the frame, or each image of a pair, has the size that the camera was calibrated for."""
    images = {", left": frame.left, ", right": frame.right} if isinstance(frame, StereoFrame) else {"": frame.image}
    for side, image in images.items():
        height, width = image.shape[:2]
        if (width, height) == (camera.width_px, camera.height_px):
            continue
        raise SourceError(
            f"frame {frame.index}{side}: expected {camera.width_px}x{camera.height_px} pixels (car.toml), got "
            f"{width}x{height}; set [camera] width_px, height_px and the intrinsics for this source"
        )
