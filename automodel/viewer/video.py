"""Writing a video file, or an animated picture for a web page."""

from __future__ import annotations

import contextlib
import functools
import shutil
import subprocess
import sys
import tempfile
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

    In H.264 where the program ffmpeg or OpenCV can, else in MPEG-4, which is larger and which browsers do not play.
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
        self._writer: _Ffmpeg | _OpenCv | None = None
        self._shape: tuple[int, ...] = ()

    def __enter__(self) -> VideoWriter:
        self._part = self._output.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        failed = "" if self._writer is None else self._writer.release()
        if failed and error is None:
            error = self._refused(failed)
            self._output.__exit__(ConfigError, error, None)
            raise error
        self._output.__exit__(kind, error, trace)

    def write(self, image: Image) -> None:
        """Add a frame; raises ValueError if its size differs from the first."""
        shape = image.shape[:2]
        if self._writer is None:
            self._writer, self._shape = self._open(shape[1], shape[0]), shape
        if shape != self._shape:
            raise ValueError(f"image: expected shape {self._shape} as the first frame, got {shape}")
        colour = image if image.ndim == 3 else np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
        if not self._writer.write(colour):
            failed, self._writer = self._writer.release(), None
            raise self._refused(failed)

    def _refused(self, why: str) -> ConfigError:
        return ConfigError(f"{self.path}: cannot be written as a video: {why}")

    def _open(self, width_px: int, height_px: int) -> _Ffmpeg | _OpenCv:
        if width_px % 2 or height_px % 2:
            raise ValueError(f"image: expected an even size, got {width_px}x{height_px}")
        size = width_px, height_px
        ffmpeg = ffmpeg_with_h264()
        if ffmpeg:
            try:
                self._part.open("ab").close()  # ffmpeg would complain at the end only
            except OSError as error:
                raise self._refused(str(error.strerror)) from None
            return _Ffmpeg(ffmpeg, self._part, self._rate_hz, size)
        writer = _OpenCv(self._part, "avc1" if opencv_writes_h264() else "mp4v", self._rate_hz, size)
        if not writer.is_open:
            raise self._refused("is the folder writable, the disk full?")
        return writer


class _OpenCv:
    """OpenCV's own encoder."""

    def __init__(self, path: Path, codec: str, rate_hz: float, size: tuple[int, int]) -> None:
        self._writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*codec), rate_hz, size)
        self.is_open = self._writer.isOpened()

    def write(self, image: Image) -> bool:
        self._writer.write(image)
        return True

    def release(self) -> str:
        self._writer.release()
        return ""


class _Ffmpeg:
    """The program ffmpeg, which gets the frames through a pipe.

    `write`: whether it took the frame; `release` ends it and returns what it complained about, if it failed.
    """

    def __init__(self, program: str, path: Path, rate_hz: float, size: tuple[int, int]) -> None:
        self._complaints = tempfile.TemporaryFile()  # noqa: SIM115 (`release` closes it)
        frames = ["-f", "rawvideo", "-pix_fmt", "bgr24", "-s", "{}x{}".format(*size), "-framerate", f"{rate_hz:.9g}"]
        coded = ["-c:v", "libx264", "-preset", "veryfast", "-crf", "23", "-pix_fmt", "yuv420p"]
        ends = ["-movflags", "+faststart", "-y", str(path)]  # what a page shows before all of it is there
        self._process = subprocess.Popen(
            [program, "-nostdin", "-loglevel", "error", *frames, "-i", "pipe:0", *coded, *ends],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=self._complaints,
            start_new_session=True,  # a Ctrl-C is ours
        )

    def write(self, image: Image) -> bool:
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(np.ascontiguousarray(image).data)
        except OSError:  # it has ended
            return False
        return True

    def release(self) -> str:
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        failed = self._process.wait() != 0
        self._complaints.seek(0)
        told = self._complaints.read().decode(errors="replace").strip().splitlines()
        self._complaints.close()
        return (told[-1] if told else "ffmpeg failed") if failed else ""


@functools.cache
def ffmpeg_with_h264() -> str:
    """The path of an ffmpeg that writes H.264; empty where there is none."""
    program = shutil.which("ffmpeg")
    if program is None:
        return ""
    try:
        command = [program, "-hide_banner", "-encoders"]
        asked = subprocess.run(command, capture_output=True, timeout=20.0, check=False, stdin=subprocess.DEVNULL)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return program if b" libx264 " in asked.stdout else ""


@functools.cache
def opencv_writes_h264() -> bool:
    """Whether this OpenCV writes H.264: asked in another process, because its libraries complain where it does not."""
    code = (
        "import cv2, sys, tempfile\n"
        "with tempfile.TemporaryDirectory() as folder:\n"
        "    avc1 = cv2.VideoWriter.fourcc(*'avc1')\n"
        "    sys.exit(not cv2.VideoWriter(folder + '/v.mp4', cv2.CAP_FFMPEG, avc1, 20, (64, 48)).isOpened())\n"
    )
    try:
        asked = subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=20.0, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return asked.returncode == 0
