from __future__ import annotations

import itertools
import queue
import shutil
import sys
import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from automodel.config import CameraConfig
from automodel.signals import Frame
from automodel.sources.cameras import (
    CaptureThread,
    CsiSource,
    UsbSource,
    captured_ns,
    gst_command,
    jetson_elements,
    synthetic_elements,
)
from automodel.sources.errors import EndOfSource, SourceError

CAMERA = CameraConfig(source="csi", device=1, width_px=320, height_px=180, rate_hz=59.94)
needs_gstreamer = pytest.mark.skipif(
    shutil.which("gst-launch-1.0") is None,
    reason="gst-launch-1.0 is not installed (apt-get install gstreamer1.0-tools gstreamer1.0-plugins-base)",
)

# --- CSI --------------------------------------------------------------------------------------------------------------


def test_the_jetson_pipeline_is_what_gstreamer_wants() -> None:
    assert " ".join(gst_command(CAMERA, jetson_elements(CAMERA), 7)) == (
        "gst-launch-1.0 --quiet nvarguscamerasrc sensor-id=1 "
        "! video/x-raw(memory:NVMM),width=320,height=180,framerate=59940/1000 ! nvvidconv "
        "! video/x-raw,format=GRAY8,width=320,height=180 "
        "! queue leaky=downstream max-size-buffers=1 ! fdsink fd=7 sync=false"
    )


def test_colour_and_whole_rates() -> None:
    camera = CameraConfig(colour=True, rate_hz=30.0)
    command = " ".join(gst_command(camera, jetson_elements(camera), 7))
    assert "format=BGRx,width=640,height=360" in command
    assert "framerate=30/1" in command


def next_frame(source: CsiSource | CaptureThread) -> Frame:
    for _ in range(100):
        frame = source.read(0.2)
        if frame is not None:
            assert isinstance(frame, Frame)
            return frame
    raise AssertionError("no frame within 20 s")


@needs_gstreamer
@pytest.mark.parametrize("width", [320, 161])  # 161: rows are padded
def test_frames_come_whole_and_in_order(width: int) -> None:
    camera = CameraConfig(width_px=width, height_px=90, rate_hz=30.0)
    source = CsiSource(camera, synthetic_elements(camera))
    try:
        frames = [next_frame(source) for _ in range(4)]
    finally:
        source.close()
        source.close()
    assert [f.index for f in frames] == [0, 1, 2, 3]
    assert all(a.t_ns < b.t_ns for a, b in itertools.pairwise(frames))
    for frame in frames:
        assert frame.image.shape == (90, width)
        bars = frame.image[:50].astype(int)  # the test picture's colour bars: rows alike, falling from left to right
        assert np.abs(bars - bars[0]).max() <= 2
        thirds = [bars[:, int(width * (i + 0.5) / 7)].mean() for i in range(7)]
        assert all(a > b for a, b in itertools.pairwise(thirds))
    with pytest.raises(SourceError, match="closed"):
        source.read(0.0)


@needs_gstreamer
def test_colour_frames_are_bgr() -> None:
    camera = CameraConfig(width_px=322, height_px=90, rate_hz=30.0, colour=True)
    source = CaptureThread(CsiSource(camera, synthetic_elements(camera)))
    try:
        image = next_frame(source).image
    finally:
        source.close()
    assert image.shape == (90, 322, 3)
    yellow = image[20, int(322 * 1.5 / 7)]
    assert yellow[0] < 60 < 150 < min(yellow[1], yellow[2])


def read_to_the_end(source: CsiSource) -> None:
    for _ in range(30):
        source.read(1.0)


@needs_gstreamer
def test_a_camera_that_stops_says_why() -> None:
    source = CsiSource(CAMERA, "videotestsrc num-buffers=2")
    with pytest.raises(SourceError, match="CSI camera 1: no more frames"):
        read_to_the_end(source)
    source.close()


@needs_gstreamer
def test_an_element_that_is_not_there_is_named() -> None:
    source = CsiSource(CAMERA, "nosuchcamerasrc")
    with pytest.raises(SourceError, match="nosuchcamerasrc"):
        read_to_the_end(source)
    source.close()


def test_without_gstreamer_the_user_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nonexistent")
    with pytest.raises(SourceError, match=r"apt-get install gstreamer1\.0-tools"):
        CsiSource(CAMERA)


TALKING_GST = """#!{python}
import os, re, sys
fd = int(re.search(r"fdsink fd=(\\d+)", " ".join(sys.argv))[1])
print("GST_ARGUS: Creating output stream", flush=True)
for shade in range(1, 4):
    os.write(1, b"CONSUMER: Producer has connected; continuing.\\n")
    picture = bytes([shade]) * (320 * 180)
    while picture:
        picture = picture[os.write(fd, picture) :]
os.write(fd, b"half a picture")
print("Error generated. gstnvarguscamerasrc.cpp, execute:751 Failed to create CaptureSession", flush=True)
"""


def test_what_the_plugin_prints_on_stdout_shifts_no_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake = tmp_path / "gst-launch-1.0"
    fake.write_text(TALKING_GST.format(python=sys.executable))
    fake.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    source = CsiSource(CAMERA)
    try:
        for shade in (1, 2, 3):
            image = next_frame(source).image
            assert (image == shade).all()
        with pytest.raises(SourceError, match="no more frames: Error generated"):
            read_to_the_end(source)
    finally:
        source.close()


# --- USB --------------------------------------------------------------------------------------------------------------


class FakeCapture:
    """Stands for OpenCV's V4L2 capture: says what it was asked for, gives scripted frames."""

    sizes = (320, 180)
    opened = True
    frames = 3
    driver_ms = float("nan")

    def __init__(self, device: int, backend: int) -> None:
        self.device, self.backend = device, backend
        self.asked: dict[int, float] = {}
        self.released = 0

    def isOpened(self) -> bool:
        return self.opened

    def set(self, key: int, value: float) -> bool:
        self.asked[key] = value
        return True

    def get(self, key: int) -> float:
        known = {cv2.CAP_PROP_FRAME_WIDTH: self.sizes[0], cv2.CAP_PROP_FRAME_HEIGHT: self.sizes[1]}
        return self.driver_ms if key == cv2.CAP_PROP_POS_MSEC else known[key]

    def grab(self) -> bool:
        self.frames -= 1
        return self.frames >= 0

    def retrieve(self) -> tuple[bool, Any]:
        return True, np.full((self.sizes[1], self.sizes[0], 3), 77, np.uint8)

    def release(self) -> None:
        self.released += 1


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> type[FakeCapture]:
    class Fresh(FakeCapture):
        pass

    monkeypatch.setattr(cv2, "VideoCapture", Fresh)
    return Fresh


def test_a_usb_camera_is_asked_for_size_rate_and_one_buffer(fake: type[FakeCapture]) -> None:
    source = UsbSource(CAMERA)
    capture: Any = source._capture
    assert (capture.device, capture.backend) == (1, cv2.CAP_V4L2)
    assert capture.asked == {
        cv2.CAP_PROP_FOURCC: cv2.VideoWriter.fourcc(*"MJPG"),
        cv2.CAP_PROP_FRAME_WIDTH: 320,
        cv2.CAP_PROP_FRAME_HEIGHT: 180,
        cv2.CAP_PROP_FPS: 59.94,
        cv2.CAP_PROP_BUFFERSIZE: 1,
    }
    frames = [source.read(1.0) for _ in range(3)]
    assert [f.index for f in frames] == [0, 1, 2]
    assert all(f.image.shape == (180, 320) for f in frames)
    assert all(a.t_ns < b.t_ns for a, b in itertools.pairwise(frames))
    with pytest.raises(SourceError, match="/dev/video1: no more frames"):
        source.read(1.0)
    source.close()
    assert capture.released == 1


def test_a_usb_camera_of_another_size_is_refused(fake: type[FakeCapture]) -> None:
    fake.sizes = (640, 480)
    with pytest.raises(SourceError, match=r"expected 320x180 pixels \(car\.toml\), got 640x480"):
        UsbSource(CAMERA)


def test_a_usb_camera_that_is_not_there(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SourceError, match=r"/dev/video97: cannot be opened"):
        UsbSource(CameraConfig(device=97))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("driver_ms", "want_ns"),
    [
        (4_990.0, 4_990_000_000),  # 10 ms ago on the same clock
        (5_000.5, 5_000_000_000),  # in the future: another clock
        (1_000.0, 5_000_000_000),  # 4 s ago: another clock
        (0.0, 5_000_000_000),
        (-1.0, 5_000_000_000),
        (float("nan"), 5_000_000_000),
    ],
)
def test_the_drivers_time_counts_where_it_can_be_right(driver_ms: float, want_ns: int) -> None:
    assert captured_ns(driver_ms, 5_000_000_000) == want_ns


WAIT_S = 20.0  # far beyond what any step takes; nothing waits for it when all is well


class Scripted:
    """A source that the test feeds; it counts what was taken from it."""

    def __init__(self) -> None:
        self.inbox: queue.Queue[Frame | Exception] = queue.Queue()
        self.closed = threading.Event()
        self.closed_by = ""

    def read(self, timeout_s: float) -> Frame | None:
        try:
            item = self.inbox.get(timeout=timeout_s)
        except queue.Empty:
            return None
        if isinstance(item, Exception):
            raise item
        return item

    def close(self) -> None:
        self.closed_by = threading.current_thread().name
        self.closed.set()


def frame(index: int) -> Frame:
    return Frame(t_ns=index, index=index, image=np.zeros((2, 2), np.uint8))


def wait_until_end(capture: CaptureThread, source: Scripted) -> None:
    assert source.closed.wait(WAIT_S)


def test_the_newest_frame_is_delivered_once_and_older_ones_count_as_drops() -> None:
    source = Scripted()
    for index in range(5):
        source.inbox.put(frame(index))
    source.inbox.put(EndOfSource())  # so that all five have gone through the thread
    capture = CaptureThread(source)
    wait_until_end(capture, source)
    newest = capture.read(WAIT_S)
    assert newest is not None
    assert newest.index == 4
    assert capture.drops == 4
    with pytest.raises(EndOfSource):
        capture.read(WAIT_S)


def test_every_frame_arrives_when_the_reader_is_fast() -> None:
    source = Scripted()
    capture = CaptureThread(source)
    for index in range(20):
        source.inbox.put(frame(index))
        got = capture.read(WAIT_S)
        assert got is not None
        assert got.index == index
    assert capture.drops == 0
    capture.close()


def test_no_frame_is_delivered_twice() -> None:
    source = Scripted()
    capture = CaptureThread(source)
    source.inbox.put(frame(0))
    assert capture.read(WAIT_S) is not None
    assert capture.read(0.0) is None
    assert capture.read(0.01) is None
    capture.close()


def test_an_error_is_passed_on_after_the_last_frame_and_stays() -> None:
    source = Scripted()
    source.inbox.put(frame(0))
    source.inbox.put(SourceError("/dev/video0: unplugged"))
    capture = CaptureThread(source)
    wait_until_end(capture, source)
    assert capture.read(WAIT_S) is not None
    for _ in range(2):
        with pytest.raises(SourceError, match="unplugged"):
            capture.read(WAIT_S)


def test_a_waiting_reader_is_woken_by_an_error() -> None:
    source = Scripted()
    capture = CaptureThread(source)
    threading.Timer(0.05, source.inbox.put, (OSError("gone"),)).start()
    with pytest.raises(OSError, match="gone"):
        capture.read(WAIT_S)


def test_closing_closes_the_source_in_its_own_thread_and_may_be_repeated() -> None:
    source = Scripted()
    capture = CaptureThread(source)
    capture.close()
    capture.close()
    assert source.closed.is_set()
    assert source.closed_by == "capture"
    with pytest.raises(EndOfSource):
        capture.read(0.0)


def test_a_bug_in_a_source_is_not_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threading, "excepthook", lambda args: None)
    source = Scripted()
    source.inbox.put(KeyError("bug"))
    capture = CaptureThread(source)
    with pytest.raises(SourceError, match="died"):
        capture.read(WAIT_S)
    capture.close()
