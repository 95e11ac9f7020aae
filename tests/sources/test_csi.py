from __future__ import annotations

import contextlib
import itertools
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from automodel.config import CameraConfig
from automodel.interfaces import Source
from automodel.signals import Frame
from automodel.sources import csi
from automodel.sources.cameras import CameraWatch, CaptureThread
from automodel.sources.csi import (
    GstAppSource,
    GstPipeSource,
    OpenCvGstSource,
    csi_source,
    gst_command,
    jetson_elements,
    synthetic_elements,
)
from automodel.sources.errors import SourceError

CAMERA = CameraConfig(source="csi", device=1, width_px=320, height_px=180, rate_hz=59.94)
needs_gstreamer = pytest.mark.skipif(
    shutil.which("gst-launch-1.0") is None,
    reason="gst-launch-1.0 is not installed (apt-get install gstreamer1.0-tools gstreamer1.0-plugins-good)",
)
ENDS = {"grey": (0,), "colour": (0, 0, 0)}


def test_the_jetson_pipeline_is_what_gstreamer_wants() -> None:
    assert " ".join(gst_command(CAMERA, jetson_elements(CAMERA), 7)) == (
        "gst-launch-1.0 --quiet nvarguscamerasrc sensor-id=1 aeantibanding=1 "
        "! video/x-raw(memory:NVMM),width=320,height=180,framerate=59940/1000 ! nvvidconv flip-method=0 "
        "! video/x-raw,format=GRAY8,width=320,height=180 "
        "! queue leaky=downstream max-size-buffers=1 ! multipartmux boundary=automodel ! fdsink fd=7 sync=false"
    )


def test_what_car_toml_fixes_is_fixed_at_the_sensor() -> None:
    camera = CameraConfig(sensor_mode=4, exposure_s=0.004, gain=2.5, flicker_hz=50, flip="rotate-180")
    head = jetson_elements(camera)
    assert head[:8] == (
        "nvarguscamerasrc",
        "sensor-id=0",
        "sensor-mode=4",
        'exposuretimerange="4000000 4000000"',
        'gainrange="2.5 2.5"',
        'ispdigitalgainrange="1 1"',
        "aelock=true",
        "aeantibanding=2",
    )
    assert head[-1] == "flip-method=2"
    assert "aelock=true" not in jetson_elements(CameraConfig(exposure_s=0.004))  # the gain may still follow the light


def test_colour_and_whole_rates() -> None:
    camera = CameraConfig(colour=True, rate_hz=30.0)
    command = " ".join(gst_command(camera, jetson_elements(camera), 7))
    assert "format=BGRx,width=640,height=360" in command
    assert "framerate=30/1" in command


@needs_gstreamer
def test_gstreamer_takes_a_range_in_quotes_as_one_value() -> None:
    """The way in which exposure and gain are written, tried with an element that every machine has."""
    words = ["gst-launch-1.0", "--quiet", "fakesrc", "num-buffers=1", "!", "fakesink", 'name="4000000 4000000"']
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


def next_frame(source: Source) -> Frame:
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
    source = GstPipeSource(camera, synthetic_elements(camera))
    try:
        frames = [next_frame(source) for _ in range(4)]
    finally:
        source.close()
        source.close()
    assert [f.index for f in frames] == [0, 1, 2, 3]
    assert all(a.t_ns < b.t_ns for a, b in itertools.pairwise(frames))
    assert source.resyncs == 0
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
    source = CaptureThread(GstPipeSource(camera, synthetic_elements(camera)), CameraWatch(30.0))
    try:
        image = next_frame(source).image
    finally:
        source.close()
    assert image.shape == (90, 322, 3)
    yellow = image[20, int(322 * 1.5 / 7)]
    assert yellow[0] < 60 < 150 < min(yellow[1], yellow[2])


def read_to_the_end(source: Source) -> None:
    for _ in range(30):
        source.read(1.0)


@needs_gstreamer
def test_a_camera_that_stops_says_why() -> None:
    source = GstPipeSource(CAMERA, ("videotestsrc", "num-buffers=2"))
    with pytest.raises(SourceError, match="CSI camera 1: no more frames"):
        read_to_the_end(source)
    source.close()


@needs_gstreamer
def test_an_element_that_is_not_there_is_named() -> None:
    source = GstPipeSource(CAMERA, ("nosuchcamerasrc",))
    with pytest.raises(SourceError, match="nosuchcamerasrc"):
        read_to_the_end(source)
    source.close()


def test_without_gstreamer_the_user_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nonexistent")
    monkeypatch.setattr(csi, "_gstreamer", lambda: None)
    with pytest.raises(SourceError, match=r"apt-get install gstreamer1\.0-tools"):
        csi_source(CAMERA)


# --- a gst-launch that does what NVIDIA's does, and worse ------------------------------------------------------------

FAKE_GST = """#!{python}
import os, re, sys
fd = int(re.search(r"fdsink fd=(\\d+)", " ".join(sys.argv))[1])
def write(data):
    while data:
        data = data[os.write(fd, data) :]
def frame(shade, length=320 * 180):
    head = f"--automodel\\r\\nContent-Type: video/x-raw\\r\\nContent-Length: {{length}}\\r\\n\\r\\n".encode()
    return head + bytes([shade]) * length + b"\\r\\n"
print("GST_ARGUS: Creating output stream", flush=True)
{script}
print("Error generated. gstnvarguscamerasrc.cpp, execute:751 Failed to create CaptureSession", flush=True)
"""


def fake_gst(folder: Path, monkeypatch: pytest.MonkeyPatch, script: str) -> GstPipeSource:
    fake = folder / "gst-launch-1.0"
    fake.write_text(FAKE_GST.format(python=sys.executable, script=script))
    fake.chmod(0o755)
    monkeypatch.setenv("PATH", str(folder))
    return GstPipeSource(CAMERA, jetson_elements(CAMERA))


def shades(source: GstPipeSource) -> list[int]:
    """The grey levels of the frames up to the end, each of one level alone."""
    seen = []

    def read() -> None:
        while True:
            image = next_frame(source).image
            assert (image == image[0, 0]).all()
            seen.append(int(image[0, 0]))

    with contextlib.closing(source), pytest.raises(SourceError, match="no more frames: Error generated"):
        read()
    return seen


def test_what_the_plugin_prints_on_stdout_shifts_no_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = """
for shade in range(1, 4):
    os.write(1, b"CONSUMER: Producer has connected; continuing.\\n")
    write(frame(shade))
write(b"half a picture")
"""
    source = fake_gst(tmp_path, monkeypatch, script)
    assert shades(source) == [1, 2, 3]
    assert source.resyncs == 0


@pytest.mark.parametrize(
    "damage",
    [
        "write(b'something that is no frame')",
        "write(frame(2)[:-900])",  # cut
        "write(frame(2)[500:])",  # without its beginning
        "write(frame(2, 1000))",  # a short one
        "write(frame(2, 320 * 181))",  # a long one
        "write(b'-' * (320 * 180 * 3))",  # longer than frames are
        "write(b'--automodel\\r\\nContent-Type')",  # half a header
    ],
)
def test_after_damaged_bytes_the_next_whole_frame_is_found(
    damage: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = fake_gst(tmp_path, monkeypatch, f"write(frame(1))\n{damage}\nfor s in (3, 4, 5): write(frame(s))")
    assert shades(source) == [1, 3, 4, 5]
    assert source.resyncs > 0


def test_frames_of_another_length_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = fake_gst(tmp_path, monkeypatch, "for s in range(30): write(frame(s, 640 * 360))")
    try:
        with pytest.raises(SourceError, match="frames of another length than 57600"):
            read_to_the_end(source)
    finally:
        source.close()


def test_a_frame_without_a_time_is_as_old_as_car_toml_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = fake_gst(tmp_path, monkeypatch, "write(frame(1))")
    monkeypatch.setattr(time, "monotonic_ns", lambda: 5_000_000_000)
    source._latency_s = 0.045
    assert next_frame(source).t_ns == 4_955_000_000
    source.close()


# --- the other two ways ----------------------------------------------------------------------------------------------

APP = """
import sys
import time
sys.path.append("/usr/lib/python3/dist-packages")  # where Debian keeps PyGObject
import json, threading, time
from automodel.config import CameraConfig
from automodel.sources.cameras import CameraWatch, CaptureThread
from automodel.sources.csi import GstAppSource, synthetic_elements
from automodel.sources.errors import SourceError
if not GstAppSource.available():
    sys.exit("PyGObject cannot be imported")
found = {}
for colour, width in ((False, 161), (True, 322)):
    camera = CameraConfig(width_px=width, height_px=90, rate_hz=30.0, colour=colour)
    source = GstAppSource(camera, synthetic_elements(camera))
    frames = [source.read(10.0) for _ in range(10)]
    ages = [(time.monotonic_ns() - frames[-1].t_ns) * 1e-9]
    source.close()
    source.close()
    name = "colour" if colour else "grey"
    found[name] = [list(f.image.shape) for f in frames][-1]
    found[name + "_row"] = frames[-1].image[20].tolist()
    found[name + "_steps"] = [(b.t_ns - a.t_ns) * 1e-9 for a, b in zip(frames, frames[1:])]
    found[name + "_age"] = ages[0]
camera = CameraConfig(width_px=64, height_px=64)
source = GstAppSource(camera, ("videotestsrc", "num-buffers=2", "is-live=true"))
try:
    for _ in range(100):
        source.read(0.1)
except SourceError as error:
    found["end"] = str(error)
source.close()
try:
    GstAppSource(camera, ("nosuchcamerasrc",))
except SourceError as error:
    found["missing"] = str(error)
camera = CameraConfig(width_px=64, height_px=64, rate_hz=1.0)
source = GstAppSource(camera, synthetic_elements(camera))
source.read(10.0)
counted = [0]
def count():
    while counted[0] < 10_000:
        counted[0] += 1
        time.sleep(0.001)
threading.Thread(target=count, daemon=True).start()
before = counted[0]
found["waited"] = source.read(0.3) is None
found["meanwhile"] = counted[0] - before
source.close()
print(json.dumps(found))
"""


@needs_gstreamer
def test_gstreamers_own_library_gives_capture_times(tmp_path: Path) -> None:
    """In a process of its own: PyGObject is not in this environment, and does not pass `-W error`."""
    done = subprocess.run([sys.executable, "-c", APP], capture_output=True, text=True, timeout=120)
    if "PyGObject cannot be imported" in done.stderr:
        pytest.skip("apt-get install python3-gi gir1.2-gst-plugins-base-1.0, for this version of Python")
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    assert (found["grey"], found["colour"]) == ([90, 161], [90, 322, 3])
    bars = [found["grey_row"][int(161 * (i + 0.5) / 7)] for i in range(7)]
    assert all(a > b for a, b in itertools.pairwise(bars))
    blue, green, red = found["colour_row"][int(322 * 1.5 / 7)]
    assert blue < 60 < 150 < min(green, red)
    for name in ENDS:
        assert 0.0 <= found[f"{name}_age"] < 1.0
        # the element's own times: whole periods, which no arrival is
        assert all(
            abs(step * 30.0 - round(step * 30.0)) < 1e-4 and round(step * 30.0) >= 1 for step in found[f"{name}_steps"]
        )
    assert found["end"] == "CSI camera 0: no more frames: the stream ended"
    assert "nosuchcamerasrc" in found["missing"]
    assert found["waited"]
    assert found["meanwhile"] > 10  # other threads went on while it waited


class FakeOpenCv:
    """OpenCV's capture of a GStreamer pipeline."""

    opened = True
    asked = ""

    def __init__(self, text: str, backend: int) -> None:
        assert backend == cv2.CAP_GSTREAMER
        FakeOpenCv.asked = text
        self.left = 2

    def isOpened(self) -> bool:
        return self.opened

    def read(self) -> tuple[bool, Any]:
        self.left -= 1
        return self.left >= 0, np.full((180, 320), 9, np.uint8)

    def release(self) -> None:
        self.left = 0


def test_an_opencv_with_gstreamer_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(csi, "_gstreamer", lambda: None)
    monkeypatch.setattr(cv2.videoio_registry, "hasBackend", lambda backend: backend == cv2.CAP_GSTREAMER)
    monkeypatch.setattr(cv2, "VideoCapture", FakeOpenCv)
    source = csi_source(CAMERA)
    assert isinstance(source, OpenCvGstSource)
    assert FakeOpenCv.asked.startswith("nvarguscamerasrc sensor-id=1 ")
    assert FakeOpenCv.asked.endswith("! videoconvert ! appsink max-buffers=1 drop=true sync=false")
    first, second = source.read(1.0), source.read(1.0)
    assert isinstance(first, Frame)
    assert isinstance(second, Frame)
    assert (first.index, second.index, second.image.shape) == (0, 1, (180, 320))
    with pytest.raises(SourceError, match="CSI camera 1: no more frames"):
        source.read(1.0)
    source.close()
    monkeypatch.setattr(FakeOpenCv, "opened", False)
    with pytest.raises(SourceError, match="cannot open it"):
        csi_source(CAMERA)


def test_the_best_way_that_is_there_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    for kind in (GstAppSource, OpenCvGstSource, GstPipeSource):
        monkeypatch.setattr(csi, kind.__name__, type(kind.__name__, (), {
            "__init__": lambda self, camera, elements: None, "available": staticmethod(lambda: True)
        }))  # fmt: skip
    assert type(csi_source(CAMERA)).__name__ == "GstAppSource"
    csi.GstAppSource.available = staticmethod(lambda: False)  # type: ignore[method-assign]
    assert type(csi_source(CAMERA)).__name__ == "OpenCvGstSource"
    csi.OpenCvGstSource.available = staticmethod(lambda: False)  # type: ignore[method-assign]
    assert type(csi_source(CAMERA)).__name__ == "GstPipeSource"
