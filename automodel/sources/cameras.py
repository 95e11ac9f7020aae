"""Cameras as sources: USB (V4L2), CSI on a Jetson, and a capture thread that always has the newest frame."""

from __future__ import annotations

import fcntl
import os
import select
import subprocess
import tempfile
import threading
import time

import cv2
import numpy as np

from automodel.config import CameraConfig
from automodel.interfaces import Source
from automodel.signals import Frame, StereoFrame
from automodel.sources.errors import EndOfSource, SourceError
from automodel.sources.images import opencv_silenced, with_channels
from automodel.types import Image

_OLDEST_NS = 1_000_000_000  # a driver's capture time older than this is on another clock
_PIPE_BYTES = 1 << 20  # room for a whole frame; with the kernel's 64 KiB, every piece costs a context switch
_STOP_S = 2.0
_POLL_S = 0.1  # timeout of a read in the capture thread, after which it checks whether to stop
_JOIN_S = 2.0


class UsbSource:
    """Frames of /dev/videoN with the driver's capture time, or the time of arrival if the driver has none.

    Requests MJPG (`fourcc` "YUYV" for cameras without MJPG) and a single buffer, so that no old frame is queued. Raises
    SourceError for a camera that is missing, has another size, or stops. `read` may block for the driver's timeout;
    wrap the source in a `CaptureThread` to limit the wait.
    """

    def __init__(self, camera: CameraConfig, fourcc: str = "MJPG") -> None:
        self.device = f"/dev/video{camera.device}"
        self.colour = camera.colour
        with opencv_silenced():
            self._capture = cv2.VideoCapture(camera.device, cv2.CAP_V4L2)
        if not self._capture.isOpened():
            raise SourceError(f"{self.device}: cannot be opened; is the camera plugged in, and [camera] device right?")
        self._configure(camera, fourcc)
        self._next = 0

    def read(self, timeout_s: float) -> Frame:
        """The next frame."""
        there, image = False, None
        with opencv_silenced():
            if self._capture.grab():
                now_ns = time.monotonic_ns()
                t_ns = captured_ns(float(self._capture.get(cv2.CAP_PROP_POS_MSEC)), now_ns)
                there, image = self._capture.retrieve()
        if not there or image is None:
            raise SourceError(f"{self.device}: no more frames; is the camera still plugged in?")
        frame = Frame(t_ns=t_ns, index=self._next, image=with_channels(np.asarray(image, dtype=np.uint8), self.colour))
        self._next += 1
        return frame

    def close(self) -> None:
        """Release the camera; may be called twice."""
        self._capture.release()

    def _configure(self, camera: CameraConfig, fourcc: str) -> None:
        size = (camera.width_px, camera.height_px)
        for key, value in (
            (cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*fourcc)),
            (cv2.CAP_PROP_FRAME_WIDTH, size[0]),
            (cv2.CAP_PROP_FRAME_HEIGHT, size[1]),
            (cv2.CAP_PROP_FPS, camera.rate_hz),
            (cv2.CAP_PROP_BUFFERSIZE, 1),
        ):
            self._capture.set(key, value)
        got = tuple(int(self._capture.get(k)) for k in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if got != size:
            self.close()
            raise SourceError(
                f"{self.device}: expected {size[0]}x{size[1]} pixels (car.toml), got {got[0]}x{got[1]}; "
                f"choose a size that the camera supports (v4l2-ctl --list-formats-ext) and calibrate for it"
            )


def captured_ns(driver_ms: float, now_ns: int) -> int:
    """The driver's capture time [ns] if it is on the monotonic clock, else the time of arrival."""
    if not np.isfinite(driver_ms):
        return now_ns
    driver_ns = round(driver_ms * 1e6)
    return driver_ns if 0 <= now_ns - driver_ns <= _OLDEST_NS else now_ns


def jetson_elements(camera: CameraConfig) -> str:
    """The head of the pipeline on a Jetson: the sensor, and its frames copied from the ISP's memory."""
    return (
        f"nvarguscamerasrc sensor-id={camera.device} "
        f"! video/x-raw(memory:NVMM),width={camera.width_px},height={camera.height_px},"
        f"framerate={_fraction(camera.rate_hz)} ! nvvidconv"
    )


def synthetic_elements(camera: CameraConfig) -> str:
    """The head of the pipeline on any machine: GStreamer's test image at the camera's rate."""
    return f"videotestsrc is-live=true ! video/x-raw,framerate={_fraction(camera.rate_hz)} ! videoconvert"


def gst_command(camera: CameraConfig, elements: str, fd: int) -> list[str]:
    """The whole command: `elements`, conversion to the configured format, and the newest frame to descriptor `fd`."""
    pixel = "BGRx" if camera.colour else "GRAY8"
    caps = f"video/x-raw,format={pixel},width={camera.width_px},height={camera.height_px}"
    tail = f"! {caps} ! queue leaky=downstream max-size-buffers=1 ! fdsink fd={fd} sync=false"
    return ["gst-launch-1.0", "--quiet", *elements.split(), *tail.split()]


class CsiSource:
    """Frames of a CSI camera with the monotonic time of arrival, through a pipe from a `gst-launch-1.0` process.

    (The pip wheels of OpenCV are built without GStreamer.) The pipe is the pictures' own: NVIDIA's camera plugin prints
    its messages on stdout, where they would shift every picture after them; they go to the log instead. Raises
    SourceError with GStreamer's error message where GStreamer is missing, cannot open the camera, or stops.
    """

    def __init__(self, camera: CameraConfig, elements: str | None = None) -> None:
        self.colour = camera.colour
        self._name = f"CSI camera {camera.device}"
        # GStreamer pads the rows of raw video to multiples of 4 bytes
        self._row_bytes = (camera.width_px * (4 if self.colour else 1) + 3) // 4 * 4
        self._width, self._height = camera.width_px, camera.height_px
        self._buffer, self._filled, self._next = self._empty(), 0, 0
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the process that writes to it
        reading, writing = os.pipe()
        self._pipe = open(reading, "rb", buffering=0)  # noqa: SIM115 - closed by close()
        try:
            self._process = subprocess.Popen(
                gst_command(camera, elements or jetson_elements(camera), writing),
                stdin=subprocess.DEVNULL,
                stdout=self._log,
                stderr=subprocess.STDOUT,
                pass_fds=[writing],
            )
        except FileNotFoundError:
            self._pipe.close()
            self._log.close()
            raise SourceError(
                "gst-launch-1.0: not found; a CSI camera needs GStreamer (apt-get install gstreamer1.0-tools)"
            ) from None
        finally:
            os.close(writing)  # held by GStreamer alone, so that the pipe ends when it ends
        fcntl.fcntl(self._pipe, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        os.set_blocking(self._pipe.fileno(), False)

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame, or None if it was not complete within `timeout_s`; the part received so far is kept."""
        if self._pipe.closed:
            raise SourceError(f"{self._name}: closed")
        deadline_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        while self._filled < len(self._buffer):
            left_s = max(deadline_ns - time.monotonic_ns(), 0) * 1e-9
            if not select.select([self._pipe], [], [], left_s)[0]:
                return None
            got = os.readv(self._pipe.fileno(), [self._buffer[self._filled :].data])
            if got == 0:
                raise SourceError(f"{self._name}: no more frames: {self._error_text()}")
            self._filled += got
        frame = Frame(t_ns=time.monotonic_ns(), index=self._next, image=self._image())
        self._buffer, self._filled = self._empty(), 0
        self._next += 1
        return frame

    def close(self) -> None:
        """Stop GStreamer and release the camera; may be called twice."""
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

    def _error_text(self) -> str:
        try:
            self._process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            return "GStreamer closed the pipe"
        self._log.seek(0)
        lines = self._log.read().decode("utf-8", "replace").splitlines()
        errors = [line for line in lines if "error" in line.lower() or "erroneous" in line]
        return errors[0].strip() if errors else f"GStreamer ended with code {self._process.returncode}"


def _fraction(rate_hz: float) -> str:
    milli = round(rate_hz * 1000)
    return f"{milli // 1000}/1" if milli % 1000 == 0 else f"{milli}/1000"


class CaptureThread:
    """Reads a source in a daemon thread and delivers only the newest frame.

    `drops` counts the frames that were replaced before they were read. `read` passes on an error or the end of the
    wrapped source after its last frame. The thread itself closes the wrapped source, so that a driver is never closed
    during a read.
    """

    def __init__(self, source: Source) -> None:
        self.drops = 0
        self._source = source
        self._changed = threading.Condition()
        self._newest: Frame | StereoFrame | None = None
        self._end: OSError | EndOfSource | None = None
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="capture", daemon=True)
        self._thread.start()

    def read(self, timeout_s: float) -> Frame | StereoFrame | None:
        """The newest frame that was not delivered yet, or None if none came within `timeout_s`."""
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not None or self._end is not None, timeout_s)
            frame, self._newest = self._newest, None
            if frame is None and self._end is not None:
                raise self._end
            return frame

    def close(self) -> None:
        """Stop the thread and release the device; may be called twice."""
        with self._changed:
            self._stopping = True
        self._thread.join(_JOIN_S)

    def _run(self) -> None:
        end: OSError | EndOfSource = SourceError("the capture thread died")
        try:
            while not self._stopping:
                frame = self._source.read(_POLL_S)
                if frame is not None:
                    self._put(frame)
            end = EndOfSource("closed")
        except (OSError, EndOfSource) as error:
            end = error
        finally:
            with self._changed:
                self._end = end
                self._changed.notify_all()
            self._source.close()

    def _put(self, frame: Frame | StereoFrame) -> None:
        with self._changed:
            if self._newest is not None:
                self.drops += 1
            self._newest = frame
            self._changed.notify_all()
