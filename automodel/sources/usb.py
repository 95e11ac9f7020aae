"""A USB camera (V4L2) as a source."""

from __future__ import annotations

import time

import cv2
import numpy as np

from automodel.config import CameraConfig
from automodel.signals import Frame
from automodel.sources.errors import SourceError
from automodel.sources.pictures import in_colour, opencv_silenced

_OLDEST_NS = 1_000_000_000  # a driver's time of capture older than this is on another clock


class UsbSource:
    """Frames of /dev/videoN as they come, stamped with the driver's time of capture, or on arrival without one.

    Asks for MJPG (`fourcc` "YUYV" for cameras that have no MJPG) and one buffer only, so that no old frame waits.
    Raises SourceError for a camera that is not there, has another size, or stops. `read` stays in the driver for up to
    its own timeout; wrap the source in a `CaptureThread` to bound the wait.
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
        frame = Frame(t_ns=t_ns, index=self._next, image=in_colour(np.asarray(image, dtype=np.uint8), self.colour))
        self._next += 1
        return frame

    def close(self) -> None:
        """Give the camera back; may be called twice."""
        self._capture.release()

    def _configure(self, camera: CameraConfig, fourcc: str) -> None:
        wanted = (camera.width_px, camera.height_px)
        for key, value in (
            (cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*fourcc)),
            (cv2.CAP_PROP_FRAME_WIDTH, wanted[0]),
            (cv2.CAP_PROP_FRAME_HEIGHT, wanted[1]),
            (cv2.CAP_PROP_FPS, camera.rate_hz),
            (cv2.CAP_PROP_BUFFERSIZE, 1),
        ):
            self._capture.set(key, value)
        got = tuple(int(self._capture.get(k)) for k in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if got != wanted:
            self.close()
            raise SourceError(
                f"{self.device}: gives {got[0]}x{got[1]} pixels where car.toml asks for {wanted[0]}x{wanted[1]}; "
                f"choose a size that the camera has (v4l2-ctl --list-formats-ext) and calibrate for it"
            )


def captured_ns(driver_ms: float, now_ns: int) -> int:
    """The driver's time of capture [ns] where it is on the monotonic clock, else the time of arrival."""
    if not np.isfinite(driver_ms):
        return now_ns
    driver_ns = round(driver_ms * 1e6)
    return driver_ns if 0 <= now_ns - driver_ns <= _OLDEST_NS else now_ns
