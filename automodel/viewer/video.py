"""Writing a video file, or an animated picture for a web page."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType

import cv2
import numpy as np

from automodel.config import ConfigError
from automodel.output_files import output_path
from automodel.types import Image

ANIMATED_PX, ANIMATED_HZ, ANIMATED_FRAMES = 480, 12.5, 400  # of an animated picture: some 10 kB a frame, 32 s


def film_writer(path: str | Path, rate_hz: float) -> VideoWriter | AnimationWriter:
    """A writer for the kind of file that the name says: .mp4, or .webp for an animated picture; raises ConfigError."""
    return AnimationWriter(path, rate_hz) if Path(path).suffix.lower() == ".webp" else VideoWriter(path, rate_hz)


class AnimationWriter:
    """Writes frames as `VideoWriter`, into an animated WebP: smaller, at most `ANIMATED_HZ` and `ANIMATED_FRAMES`.

    Raises ConfigError where there are more, or it cannot be written.
    """

    def __init__(self, path: str | Path, rate_hz: float) -> None:
        self.path, self._every = Path(path), max(1, round(rate_hz / ANIMATED_HZ))
        if not hasattr(cv2, "imwriteanimation"):
            raise ConfigError(f"{path}: animated pictures need OpenCV 4.11; write an .mp4, or update opencv")
        if not self.path.parent.is_dir():
            raise ConfigError(f"{path}: there is no folder {self.path.parent}")
        self._duration_ms = round(1000.0 * self._every / rate_hz)
        self._frames: list[Image] = []
        self._count = 0

    def __enter__(self) -> AnimationWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None or not self._frames:
            return
        animation = cv2.Animation()
        animation.frames = self._frames
        animation.durations = [self._duration_ms] * len(self._frames)
        with output_path(self.path) as part:
            if not cv2.imwriteanimation(str(part), animation, [cv2.IMWRITE_WEBP_QUALITY, 60]):
                raise ConfigError(
                    f"{self.path}: cannot be written as a picture; is the folder writable, the disk full?"
                )

    def write(self, image: Image) -> None:
        """Add a frame."""
        self._count += 1
        if (self._count - 1) % self._every:
            return
        if len(self._frames) == ANIMATED_FRAMES:
            seconds = 1e-3 * ANIMATED_FRAMES * self._duration_ms
            raise ConfigError(f"{self.path}: an animated picture is {seconds:.0f} s long at most; use --from and --to")
        colour = image if image.ndim == 3 else np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
        height = max(round(colour.shape[0] * ANIMATED_PX / colour.shape[1]), 1)
        self._frames.append(
            np.asarray(cv2.resize(colour, (ANIMATED_PX, height), interpolation=cv2.INTER_AREA), np.uint8)
        )


class VideoWriter:
    """Writes frames (h, w) or (h, w, 3) BGR, all of the same even size, into an MP4 file.

    The file appears when the `with` block ends without an error, if a frame was written. Raises ConfigError where it
    cannot be written.
    """

    def __init__(self, path: str | Path, rate_hz: float) -> None:
        self.path, self._rate_hz = Path(path), rate_hz
        if not rate_hz > 0:
            raise ValueError(f"rate_hz: expected a positive number, got {rate_hz}")
        if self.path.suffix.lower() != ".mp4":
            raise ConfigError(f"{path}: videos are written as MP4; choose a name that ends in .mp4")
        if not self.path.parent.is_dir():
            raise ConfigError(f"{path}: there is no folder {self.path.parent}")
        self._output = output_path(self.path)
        self._writer: cv2.VideoWriter | None = None
        self._shape: tuple[int, ...] = ()

    def __enter__(self) -> VideoWriter:
        self._part = self._output.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._writer is not None:
            self._writer.release()
        self._output.__exit__(kind, error, trace)

    def write(self, image: Image) -> None:
        """Add a frame; raises ValueError if its size differs from the first."""
        shape = image.shape[:2]
        if self._writer is None:
            self._writer, self._shape = self._open(shape[1], shape[0]), shape
        if shape != self._shape:
            raise ValueError(f"image: expected shape {self._shape} as the first frame, got {shape}")
        self._writer.write(image if image.ndim == 3 else np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)))

    def _open(self, width_px: int, height_px: int) -> cv2.VideoWriter:
        if width_px % 2 or height_px % 2:
            raise ValueError(f"image: expected an even size, got {width_px}x{height_px}")
        writer = cv2.VideoWriter(
            str(self._part), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"mp4v"), self._rate_hz, (width_px, height_px)
        )
        if not writer.isOpened():
            raise ConfigError(f"{self.path}: cannot be written as a video; is the folder writable, the disk full?")
        return writer
