"""A video file as a source."""

from __future__ import annotations

import math
import os
from pathlib import Path

import cv2
import numpy as np

from automodel.signals import Frame
from automodel.sources.errors import EndOfSource, SourceError
from automodel.sources.pictures import in_colour, opencv_silenced

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read once by OpenCV; the errors raised here say it instead

_COUNT_TOLERANCE = 0.02  # containers give the number of frames by duration, which may be off by a few


class VideoSource:
    """The frames of a video file at the file's rate, or at `rate_hz` where given; the first at time 0.

    Raises SourceError for a file that is not there, is no video or says no rate, and (from `read`) at the end of one
    that is cut: when clearly fewer frames came than the file promises.
    """

    def __init__(self, path: str | Path, rate_hz: float | None = None, colour: bool = False) -> None:
        self.path, self.colour = Path(path), colour
        if rate_hz is not None and not rate_hz > 0:
            raise ValueError(f"rate_hz: {rate_hz} where a positive number is wanted")
        if not self.path.is_file():
            raise SourceError(f"{path}: no such file")
        with opencv_silenced():
            self._capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
        if not self._capture.isOpened():
            raise SourceError(f"{path}: cannot be opened as a video: it is cut, damaged or something else")
        own_hz = float(self._capture.get(cv2.CAP_PROP_FPS))
        if rate_hz is None and not (math.isfinite(own_hz) and 0 < own_hz <= 1000):
            self.close()
            raise SourceError(f"{path}: the file does not say its frame rate; give it with --rate")
        self.rate_hz = own_hz if rate_hz is None else rate_hz
        count = float(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        self.frame_count = int(count) if math.isfinite(count) and 0 < count < 1e9 else None  # None: not known
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
            image=in_colour(np.asarray(image, dtype=np.uint8), self.colour),
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
