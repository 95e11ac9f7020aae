"""USB cameras (V4L2), through OpenCV; their exposure, gain and anti-flicker through the kernel's own controls."""

from __future__ import annotations

import contextlib
import fcntl
import os
import struct
import time

import cv2
import numpy as np

from automodel.config import CameraConfig
from automodel.signals import Frame
from automodel.sources.cameras import captured_ns, flipped
from automodel.sources.errors import SourceError
from automodel.sources.images import opencv_silenced, with_channels

S_CTRL = 0xC008561C  # VIDIOC_S_CTRL: sets one control, of struct v4l2_control {u32 id; s32 value}
GAIN = 0x00980913  # V4L2_CID_...
POWER_LINE_FREQUENCY = 0x00980918  # 0 off, 1 50 Hz, 2 60 Hz
EXPOSURE_AUTO = 0x009A0901  # 1 by hand, 3 automatic (UVC's aperture priority)
EXPOSURE_ABSOLUTE = 0x009A0902  # in 100 us
EXPOSURE_AUTO_PRIORITY = 0x009A0903  # 1: the rate falls in the dark
AUTOGAIN = 0x00980912
_SAME_FOURCC = {"JPEG": "MJPG"}  # two names of one format


class UsbSource:
    """Frames of /dev/videoN with the kernel's capture time, or that of arrival less `latency_s` if it has none.

    Requests one buffer, so that no old frame is queued. Raises SourceError for a camera that is missing, has another
    size or pixel format, lacks a control that car.toml sets, or stops. `read` may block for the driver's timeout; wrap
    the source in a `CaptureThread` to limit the wait. `own_time` says whether the last frame's time was the kernel's.
    """

    def __init__(self, camera: CameraConfig) -> None:
        self.device = f"/dev/video{camera.device}"
        self.own_time = False
        self._camera = camera
        with opencv_silenced():
            self._capture = cv2.VideoCapture(camera.device, cv2.CAP_V4L2)
        if not self._capture.isOpened():
            raise SourceError(f"{self.device}: cannot be opened; is the camera plugged in, and [camera] device right?")
        try:
            self._configure()
            set_controls(self.device, camera)
        except SourceError:
            self.close()
            raise
        self._next = 0

    def read(self, timeout_s: float) -> Frame:
        """The next frame."""
        there, image = False, None
        with opencv_silenced():
            if self._capture.grab():
                now_ns = time.monotonic_ns()
                own_ns = float(self._capture.get(cv2.CAP_PROP_POS_MSEC)) * 1e6
                t_ns = captured_ns(own_ns, now_ns, self._camera.latency_s)
                self.own_time = np.isfinite(own_ns) and t_ns == round(own_ns)
                there, image = self._capture.retrieve()
        if not there or image is None:
            raise SourceError(f"{self.device}: no more frames; is the camera still plugged in?")
        seen = with_channels(np.asarray(image, dtype=np.uint8), self._camera.colour)
        frame = Frame(t_ns=t_ns, index=self._next, image=flipped(seen, self._camera.flip))
        self._next += 1
        return frame

    def close(self) -> None:
        """Release the camera; may be called twice."""
        self._capture.release()

    def _configure(self) -> None:
        camera, wanted = self._camera, self._camera.pixel_format
        size = (camera.width_px, camera.height_px)
        for key, value in (
            (cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*wanted)),
            (cv2.CAP_PROP_FRAME_WIDTH, size[0]),
            (cv2.CAP_PROP_FRAME_HEIGHT, size[1]),
            (cv2.CAP_PROP_FPS, camera.rate_hz),
            (cv2.CAP_PROP_BUFFERSIZE, 1),
        ):
            self._capture.set(key, value)
        got = tuple(int(self._capture.get(k)) for k in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if got != size:
            raise SourceError(
                f"{self.device}: expected {size[0]}x{size[1]} pixels (car.toml), got {got[0]}x{got[1]}; "
                f"choose a size that the camera supports (v4l2-ctl --list-formats-ext) and calibrate for it"
            )
        code = int(self._capture.get(cv2.CAP_PROP_FOURCC))
        name = (
            bytes(code >> shift & 0xFF for shift in (0, 8, 16, 24)).decode("ascii", "replace") if code > 0 else wanted
        )
        if _SAME_FOURCC.get(name, name) != wanted:
            raise SourceError(
                f"{self.device}: expected pixel format {wanted}, got {name.strip()}; set [camera] pixel_format to one "
                "that the camera has at this size (v4l2-ctl --list-formats-ext)"
            )


def controls(camera: CameraConfig) -> list[tuple[str, int, int, bool]]:
    """Key of car.toml, the control's number, its value, and whether the camera must have it."""
    wanted = [("exposure_s", EXPOSURE_AUTO_PRIORITY, 0, False)]  # a rate that stays, whatever the light
    if camera.exposure_s > 0.0:
        wanted.append(("exposure_s", EXPOSURE_AUTO, 1, True))
        wanted.append(("exposure_s", EXPOSURE_ABSOLUTE, max(1, round(camera.exposure_s * 1e4)), True))
    else:  # a camera keeps what was set last, until it is unplugged
        wanted.append(("exposure_s", EXPOSURE_AUTO, 3, False))
    if camera.gain > 0.0:
        wanted.append(("gain", AUTOGAIN, 0, False))
        wanted.append(("gain", GAIN, round(camera.gain), True))
    else:
        wanted.append(("gain", AUTOGAIN, 1, False))
    if camera.flicker_hz:
        wanted.append(("flicker_hz", POWER_LINE_FREQUENCY, 1 if camera.flicker_hz == 50 else 2, True))
    return wanted


def set_controls(device: str, camera: CameraConfig) -> None:
    """Exposure, gain and anti-flicker as car.toml says; raises SourceError for what it sets and the camera lacks."""
    try:
        descriptor = os.open(device, os.O_RDWR | os.O_NONBLOCK)
    except OSError as error:
        raise SourceError(f"{device}: {error.strerror}") from None
    try:
        for key, number, value, needed in controls(camera):
            with contextlib.ExitStack() as forgiving:
                if not needed:
                    forgiving.enter_context(contextlib.suppress(OSError))
                try:
                    fcntl.ioctl(descriptor, S_CTRL, struct.pack("=Ii", number, value))
                except OSError as error:
                    raise SourceError(
                        f"{device}: [camera] {key} cannot be set ({error.strerror}); v4l2-ctl --list-ctrls shows what "
                        "the camera can do, 0 leaves it to the camera"
                    ) from None
    finally:
        os.close(descriptor)
