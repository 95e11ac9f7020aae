"""CSI cameras of a Jetson, through GStreamer: by its own library, by OpenCV, or by a process with a pipe.

The library (PyGObject) is the best of them, because frames carry their capture time there; the process needs nothing
but GStreamer's tools. `csi_source` takes the first that this machine has.
"""

from __future__ import annotations

import fcntl
import os
import select
import subprocess
import tempfile
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from automodel.config import CameraConfig
from automodel.interfaces import Source
from automodel.signals import Frame
from automodel.sources.cameras import captured_ns
from automodel.sources.errors import SourceError
from automodel.sources.images import opencv_silenced, with_channels
from automodel.types import Image

Words = tuple[str, ...]

_PIPE_BYTES = 1 << 20  # room for a whole frame; with the kernel's 64 KiB, every piece costs a context switch
_STOP_S = 2.0
_START_S = 5.0
_MESSAGE_NS = 1_000_000  # for the message that says why there are no frames
_BOUNDARY = "automodel"
_END = b"\r\n"
_MOST_ASTRAY = 10  # frames' lengths without a frame: what comes is not what was asked for
_FLIP_METHODS = {"none": 0, "rotate-180": 2, "horizontal": 4, "vertical": 6}  # nvvidconv's
_ANTIBANDING = {0: 1, 50: 2, 60: 3}  # nvarguscamerasrc's; 1: it finds the lamps' frequency by itself
_NEWEST = ("!", "queue", "leaky=downstream", "max-size-buffers=1")


def jetson_elements(camera: CameraConfig) -> Words:
    """The head of the pipeline on a Jetson: the sensor, and its frames copied from the ISP's memory."""
    fixed: list[str] = []
    if camera.sensor_mode >= 0:
        fixed.append(f"sensor-mode={camera.sensor_mode}")
    if camera.exposure_s > 0.0:
        time_ns = round(camera.exposure_s * 1e9)
        fixed.append(f'exposuretimerange="{time_ns} {time_ns}"')
    if camera.gain > 0.0:
        fixed += [f'gainrange="{camera.gain:g} {camera.gain:g}"', 'ispdigitalgainrange="1 1"']
    if camera.exposure_s > 0.0 and camera.gain > 0.0:
        fixed.append("aelock=true")
    return (
        "nvarguscamerasrc", f"sensor-id={camera.device}", *fixed, f"aeantibanding={_ANTIBANDING[camera.flicker_hz]}",
        "!", f"video/x-raw(memory:NVMM),width={camera.width_px},height={camera.height_px},"
        f"framerate={_fraction(camera.rate_hz)}",
        "!", "nvvidconv", f"flip-method={_FLIP_METHODS[camera.flip]}",
    )  # fmt: skip


def synthetic_elements(camera: CameraConfig) -> Words:
    """The head of the pipeline on any machine: GStreamer's test image at the camera's rate."""
    return (
        "videotestsrc", "is-live=true",
        "!", f"video/x-raw,framerate={_fraction(camera.rate_hz)}",
        "!", "videoconvert",
    )  # fmt: skip


def csi_source(camera: CameraConfig) -> Source:
    """The camera, by the best way that this machine has; raises SourceError where it cannot be opened."""
    elements = jetson_elements(camera)
    if GstAppSource.available():
        return GstAppSource(camera, elements)
    if OpenCvGstSource.available():
        return OpenCvGstSource(camera, elements)
    return GstPipeSource(camera, elements)


class RawVideo:
    """How GStreamer lays out the frames of a camera: BGRx or grey, rows padded to multiples of 4 bytes."""

    def __init__(self, camera: CameraConfig) -> None:
        self._camera = camera
        self._row_bytes = (camera.width_px * (4 if camera.colour else 1) + 3) // 4 * 4
        pixel = "BGRx" if camera.colour else "GRAY8"
        self.caps = f"video/x-raw,format={pixel},width={camera.width_px},height={camera.height_px}"
        self.frame_bytes = self._row_bytes * camera.height_px

    def image(self, data: Image) -> Image:
        """(h, w) grey or (h, w, 3) BGR of a frame's bytes."""
        rows = data.reshape(self._camera.height_px, self._row_bytes)
        if not self._camera.colour:
            return np.ascontiguousarray(rows[:, : self._camera.width_px])
        return np.ascontiguousarray(rows.reshape(self._camera.height_px, self._camera.width_px, 4)[:, :, :3])


def gst_command(camera: CameraConfig, elements: Words, fd: int) -> list[str]:
    """The whole command: `elements`, conversion to the configured format, and the newest frame to descriptor `fd`.

    `multipartmux` writes a header before each frame that says how long it is.
    """
    mux = ("!", "multipartmux", f"boundary={_BOUNDARY}", "!", "fdsink", f"fd={fd}", "sync=false")
    return ["gst-launch-1.0", "--quiet", *elements, "!", RawVideo(camera).caps, *_NEWEST, *mux]


class GstPipeSource:
    """Frames through a pipe from a `gst-launch-1.0` process, captured `latency_s` before they arrive.

    The pipe is the pictures' own: NVIDIA's camera plugin prints its messages on stdout, where they would shift every
    picture after them; they go to the log instead. Each frame comes with a header that holds its length; bytes that
    are not a whole frame are skipped up to the next header, and `resyncs` counts that. Raises SourceError with
    GStreamer's error message where GStreamer is missing, cannot open the camera, or stops.
    """

    own_time = False

    def __init__(self, camera: CameraConfig, elements: Words) -> None:
        self.resyncs = 0
        self._name, self._latency_s = f"CSI camera {camera.device}", camera.latency_s
        self._raw = RawVideo(camera)
        self._header = (
            f"--{_BOUNDARY}\r\nContent-Type: video/x-raw\r\nContent-Length: {self._raw.frame_bytes}\r\n\r\n".encode()
        )
        self._buffer, self._filled, self._next, self._astray = self._empty(), 0, 0, 0
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the process that writes to it
        reading, writing = os.pipe()
        self._pipe = open(reading, "rb", buffering=0)  # noqa: SIM115 - closed by close()
        try:
            self._process = subprocess.Popen(
                gst_command(camera, elements, writing),
                stdin=subprocess.DEVNULL,
                stdout=self._log,
                stderr=subprocess.STDOUT,
                pass_fds=[writing],
            )
        except FileNotFoundError:
            self._pipe.close()
            self._log.close()
            raise SourceError(
                "gst-launch-1.0: not found; a CSI camera needs GStreamer (apt-get install gstreamer1.0-tools "
                "gstreamer1.0-plugins-good)"
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
        while True:
            if not self._fill(deadline_ns):
                return None
            if self._is_whole():
                break
            self._resynchronise()
        t_ns = captured_ns(None, time.monotonic_ns(), self._latency_s)
        image = self._raw.image(self._buffer[len(self._header) : -len(_END)])
        self._buffer, self._filled, self._astray = self._empty(), 0, 0
        self._next += 1
        return Frame(t_ns=t_ns, index=self._next - 1, image=image)

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
        return np.empty(len(self._header) + self._raw.frame_bytes + len(_END), np.uint8)

    def _fill(self, deadline_ns: int) -> bool:
        """Whether as many bytes have come as a frame has with its header."""
        while self._filled < len(self._buffer):
            left_s = max(deadline_ns - time.monotonic_ns(), 0) * 1e-9
            if not select.select([self._pipe], [], [], left_s)[0]:
                return False
            got = os.readv(self._pipe.fileno(), [self._buffer[self._filled :].data])
            if got == 0:
                raise SourceError(f"{self._name}: no more frames: {self._error_text()}")
            self._filled += got
        return True

    def _is_whole(self) -> bool:
        ends = self._buffer[: len(self._header)].tobytes(), self._buffer[-len(_END) :].tobytes()
        return ends == (self._header, _END)

    def _resynchronise(self) -> None:
        """Keep what comes after the next header, or what may be the beginning of one."""
        self.resyncs += 1
        self._astray += 1
        if self._astray > _MOST_ASTRAY:
            raise SourceError(f"{self._name}: GStreamer sends frames of another length than {self._raw.frame_bytes}")
        start = self._buffer.tobytes().find(self._header, 1)
        start = start if start > 0 else len(self._buffer) - len(self._header) + 1
        rest = self._buffer[start:].copy()
        self._buffer[: len(rest)] = rest
        self._filled = len(rest)

    def _error_text(self) -> str:
        try:
            self._process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            return "GStreamer closed the pipe"
        self._log.seek(0)
        lines = self._log.read().decode("utf-8", "replace").splitlines()
        errors = [line for line in lines if "error" in line.lower() or "erroneous" in line]
        return errors[0].strip() if errors else f"GStreamer ended with code {self._process.returncode}"


class GstAppSource:
    """Frames through GStreamer's own library (PyGObject), with the capture time that the camera's element gave them.

    Raises SourceError with GStreamer's error message where it cannot open the camera, or stops.
    """

    own_time = True

    def __init__(self, camera: CameraConfig, elements: Words) -> None:
        self._gst = _gstreamer()
        assert self._gst is not None, "see available()"
        self._name, self._latency_s = f"CSI camera {camera.device}", camera.latency_s
        self._raw, self._next = RawVideo(camera), 0
        sink = ("!", "appsink", "name=frames", "max-buffers=1", "drop=true", "sync=false")
        try:
            self._pipeline = self._gst.parse_launch(" ".join((*elements, "!", self._raw.caps, *sink)))
        except Exception as error:  # noqa: BLE001 - GLib.Error, which is known only where the library is
            raise SourceError(f"{self._name}: {error}") from None
        self._pipeline.use_clock(self._gst.SystemClock.obtain())  # the monotonic clock: capture times are on ours
        self._frames = self._pipeline.get_by_name("frames")
        self._pipeline.set_state(self._gst.State.PLAYING)
        self._pipeline.get_state(round(_START_S * 1e9))  # before it has started, `read` would not wait

    @staticmethod
    def available() -> bool:
        """Whether this Python sees the library."""
        return _gstreamer() is not None

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame, or None if none came within `timeout_s`."""
        if self._pipeline is None:
            raise SourceError(f"{self._name}: closed")
        sample = self._frames.try_pull_sample(round(timeout_s * 1e9))
        if sample is None:
            self._check()
            return None
        now_ns = time.monotonic_ns()
        buffer = sample.get_buffer()
        running_ns = sample.get_segment().to_running_time(self._gst.Format.TIME, buffer.pts)
        own_ns = None if running_ns == self._gst.CLOCK_TIME_NONE else self._pipeline.get_base_time() + running_ns
        mapped, info = buffer.map(self._gst.MapFlags.READ)
        if not mapped or info.size != self._raw.frame_bytes:
            raise SourceError(f"{self._name}: expected frames of {self._raw.frame_bytes} bytes, got {info.size}")
        try:
            image = self._raw.image(np.frombuffer(info.data, np.uint8).copy())
        finally:
            buffer.unmap(info)
        frame = Frame(t_ns=captured_ns(own_ns, now_ns, self._latency_s), index=self._next, image=image)
        self._next += 1
        return frame

    def close(self) -> None:
        """Release the camera; may be called twice."""
        if self._pipeline is not None:
            self._pipeline.set_state(self._gst.State.NULL)
            self._pipeline = self._frames = None

    def _check(self) -> None:
        """Raise SourceError where the pipeline has failed or ended."""
        kinds = self._gst.MessageType.ERROR | self._gst.MessageType.EOS
        message = self._pipeline.get_bus().timed_pop_filtered(_MESSAGE_NS, kinds)
        if message is None:
            return
        text = "the stream ended"
        if message.type == self._gst.MessageType.ERROR:
            text = message.parse_error()[0].message
        raise SourceError(f"{self._name}: no more frames: {text}")


class OpenCvGstSource:
    """Frames through an OpenCV that was built with GStreamer, captured `latency_s` before they arrive.

    `read` may block until GStreamer gives up; wrap the source in a `CaptureThread`. Raises SourceError where the camera
    cannot be opened, or stops.
    """

    own_time = False

    def __init__(self, camera: CameraConfig, elements: Words) -> None:
        self._name, self._camera, self._next = f"CSI camera {camera.device}", camera, 0
        sink = ("!", "appsink", "max-buffers=1", "drop=true", "sync=false")
        with opencv_silenced():
            text = " ".join((*elements, "!", RawVideo(camera).caps, "!", "videoconvert", *sink))
            self._capture = cv2.VideoCapture(text, cv2.CAP_GSTREAMER)
        if not self._capture.isOpened():
            raise SourceError(
                f"{self._name}: OpenCV's GStreamer cannot open it; is the ribbon cable in, the port free?"
            )

    @staticmethod
    def available() -> bool:
        """Whether OpenCV was built with GStreamer; its wheels are not."""
        return cv2.videoio_registry.hasBackend(cv2.CAP_GSTREAMER)

    def read(self, timeout_s: float) -> Frame:
        """The next frame."""
        with opencv_silenced():
            there, image = self._capture.read()
        now_ns = time.monotonic_ns()
        if not there:
            raise SourceError(f"{self._name}: no more frames")
        seen = with_channels(np.asarray(image, dtype=np.uint8), self._camera.colour)
        frame = Frame(t_ns=captured_ns(None, now_ns, self._camera.latency_s), index=self._next, image=seen)
        self._next += 1
        return frame

    def close(self) -> None:
        """Release the camera; may be called twice."""
        self._capture.release()


def _gstreamer() -> Any:
    """GStreamer's library as a module, None where this Python does not see it."""
    try:
        import gi

        gi.require_version("Gst", "1.0")
        gi.require_version("GstApp", "1.0")
        from gi.repository import Gst, GstApp  # noqa: F401 - the second gives appsink its methods
    except (ImportError, ValueError):
        return None
    start: Callable[[None], object] = Gst.init
    start(None)
    return Gst


def _fraction(rate_hz: float) -> str:
    milli = round(rate_hz * 1000)
    return f"{milli // 1000}/1" if milli % 1000 == 0 else f"{milli}/1000"
