"""A CSI camera of a Jetson as a source: GStreamer in a process of its own, frames through a pipe.

The pip wheels of OpenCV are built without GStreamer; `gst-launch-1.0` comes with every Jetson.
"""

from __future__ import annotations

import fcntl
import os
import select
import subprocess
import tempfile
import time

import numpy as np

from automodel.config import CameraConfig
from automodel.signals import Frame
from automodel.sources.errors import SourceError
from automodel.types import Image

_PIPE_BYTES = 1 << 20  # a frame fits in one go; the kernel's default of 64 KiB takes a switch per piece
_STOP_S = 2.0


def jetson_elements(camera: CameraConfig) -> str:
    """The head of the pipeline on a Jetson: the sensor, and its pictures out of the ISP's memory."""
    return (
        f"nvarguscamerasrc sensor-id={camera.device} "
        f"! video/x-raw(memory:NVMM),width={camera.width_px},height={camera.height_px},"
        f"framerate={_fraction(camera.rate_hz)} ! nvvidconv"
    )


def synthetic_elements(camera: CameraConfig) -> str:
    """The head of the pipeline on any machine: GStreamer's test picture at the camera's rate."""
    return f"videotestsrc is-live=true ! video/x-raw,framerate={_fraction(camera.rate_hz)} ! videoconvert"


def gst_command(camera: CameraConfig, elements: str) -> list[str]:
    """The whole command: `elements`, then the wanted format, the newest frame only, to stdout."""
    pixel = "BGRx" if camera.colour else "GRAY8"
    caps = f"video/x-raw,format={pixel},width={camera.width_px},height={camera.height_px}"
    tail = f"! {caps} ! queue leaky=downstream max-size-buffers=1 ! fdsink sync=false"
    return ["gst-launch-1.0", "--quiet", *elements.split(), *tail.split()]


class CsiSource:
    """Frames of a CSI camera as they come, stamped on arrival with the monotonic clock.

    Raises SourceError where GStreamer is missing, cannot open the camera, or stops; the text has its last words.
    """

    def __init__(self, camera: CameraConfig, elements: str | None = None) -> None:
        self.colour = camera.colour
        self._name = f"CSI camera {camera.device}"
        # GStreamer pads the rows of raw video to multiples of 4 bytes
        self._row_bytes = (camera.width_px * (4 if self.colour else 1) + 3) // 4 * 4
        self._width, self._height = camera.width_px, camera.height_px
        self._buffer, self._filled, self._next = self._empty(), 0, 0
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the process that writes to it
        try:
            self._process = subprocess.Popen(
                gst_command(camera, elements or jetson_elements(camera)),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=self._log,
                bufsize=0,
            )
        except FileNotFoundError:
            self._log.close()
            raise SourceError(
                "gst-launch-1.0: not found; a CSI camera needs GStreamer (apt-get install gstreamer1.0-tools)"
            ) from None
        assert self._process.stdout is not None
        self._pipe = self._process.stdout
        fcntl.fcntl(self._pipe, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        os.set_blocking(self._pipe.fileno(), False)

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame, or None when it was not complete within `timeout_s`; what has come of it is kept."""
        if self._pipe.closed:
            raise SourceError(f"{self._name}: closed")
        deadline_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        while self._filled < len(self._buffer):
            left_s = max(deadline_ns - time.monotonic_ns(), 0) * 1e-9
            if not select.select([self._pipe], [], [], left_s)[0]:
                return None
            got = os.readv(self._pipe.fileno(), [self._buffer[self._filled :].data])
            if got == 0:
                raise SourceError(f"{self._name}: no more frames: {self._last_words()}")
            self._filled += got
        frame = Frame(t_ns=time.monotonic_ns(), index=self._next, image=self._image())
        self._buffer, self._filled = self._empty(), 0
        self._next += 1
        return frame

    def close(self) -> None:
        """Stop GStreamer and give the camera back; may be called twice."""
        self._pipe.close()
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._log.close()

    def _empty(self) -> Image:
        return np.empty(self._row_bytes * self._height, np.uint8)

    def _image(self) -> Image:
        rows = self._buffer.reshape(self._height, self._row_bytes)
        if not self.colour:
            return np.ascontiguousarray(rows[:, : self._width])
        return np.ascontiguousarray(rows.reshape(self._height, self._width, 4)[:, :, :3])

    def _last_words(self) -> str:
        try:
            self._process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            return "GStreamer closed the pipe"
        self._log.seek(0)
        lines = self._log.read().decode("utf-8", "replace").splitlines()
        errors = [line for line in lines if "ERROR" in line or "erroneous" in line] or lines
        return errors[0].strip() if errors else f"GStreamer ended with code {self._process.returncode}"


def _fraction(rate_hz: float) -> str:
    milli = round(rate_hz * 1000)
    return f"{milli // 1000}/1" if milli % 1000 == 0 else f"{milli}/1000"
