"""The Raspberry Pi's camera against a stand-in for picamera2: its calls are those of picamera2 0.3."""

from __future__ import annotations

import sys
import time
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from automodel.config import CameraConfig
from automodel.config.toml_reader import parse_toml
from automodel.sources.errors import SourceError
from automodel.sources.picamera import PicameraSource

ROOT = Path(__file__).resolve().parents[2]
CAMERA = CameraConfig(source="picamera2", width_px=32, height_px=16, rate_hz=60.0)


class FakeRequest:
    def __init__(self, device: FakePicamera) -> None:
        self.device = device

    def get_metadata(self) -> dict[str, object]:
        age_ns = self.device.age_ns
        if age_ns is None:
            return {}
        return {"SensorTimestamp": time.clock_gettime_ns(time.CLOCK_BOOTTIME) - age_ns}

    def make_array(self, name: str) -> Any:
        assert name == "main"
        main = self.device.configured["main"]
        width, height = main["size"]
        if main["format"] == "YUV420":  # rows padded to 64 bytes, the Y plane first
            data = np.full((height * 3 // 2, (width + 63) // 64 * 64), 128, np.uint8)
            data[:height, :width] = np.arange(width)
            return data
        data = np.zeros((height, width, 3), np.uint8)
        data[..., 0] = 200  # picamera2's RGB888 is blue first
        return data

    def release(self) -> None:
        self.device.released += 1


class FakePicamera:
    last: FakePicamera
    sensor_modes = ({"size": (640, 480), "bit_depth": 10}, {"size": (1296, 972), "bit_depth": 10})

    def __init__(self, number: int) -> None:
        if number > 0:
            raise IndexError("list index out of range")
        FakePicamera.last = self
        self.released, self.running, self.closed = 0, False, 0
        self.age_ns: int | None = 8_000_000
        self.configured: dict[str, Any] = {}

    def create_video_configuration(self, **given: Any) -> dict[str, Any]:
        return given

    def configure(self, configuration: dict[str, Any]) -> None:
        self.configured = configuration

    def start(self) -> None:
        self.running = True

    def capture_request(self) -> FakeRequest:
        if not self.running:
            raise RuntimeError("Camera has been stopped")
        return FakeRequest(self)

    def close(self) -> None:
        self.running = False
        self.closed += 1


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> type[FakePicamera]:
    picamera2, libcamera = types.ModuleType("picamera2"), types.ModuleType("libcamera")
    picamera2.Picamera2 = FakePicamera  # type: ignore[attr-defined]
    libcamera.Transform = dict  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "picamera2", picamera2)
    monkeypatch.setitem(sys.modules, "libcamera", libcamera)
    return FakePicamera


def test_grey_frames_are_the_brightness_with_the_sensors_time(fake: type[FakePicamera]) -> None:
    source = PicameraSource(CAMERA)
    before_ns = time.monotonic_ns()
    frames = [source.read(1.0) for _ in range(2)]
    assert [f.index for f in frames] == [0, 1]
    for frame in frames:
        assert (frame.image == np.arange(32)).all()
        assert frame.image.shape == (16, 32)
    assert source.own_time
    assert abs(frames[0].t_ns - (before_ns - 8_000_000)) < 5_000_000_000  # on the monotonic clock
    assert fake.last.released == 2
    assert fake.last.configured == {
        "main": {"size": (32, 16), "format": "YUV420"},
        "transform": {"hflip": 0, "vflip": 0},
        "controls": {"FrameRate": 60.0},
        "buffer_count": 3,
        "queue": False,
    }
    source.close()
    with pytest.raises(SourceError, match="camera 0: no more frames: Camera has been stopped"):
        source.read(1.0)


def test_without_a_sensor_time_latency_counts(fake: type[FakePicamera]) -> None:
    source = PicameraSource(CameraConfig(width_px=32, height_px=16, latency_s=0.4))
    fake.last.age_ns = None
    frame = source.read(1.0)
    assert time.monotonic_ns() - frame.t_ns >= 400_000_000
    assert not source.own_time


def test_colour_is_bgr_and_all_that_car_toml_fixes_is_asked_for(fake: type[FakePicamera]) -> None:
    camera = CameraConfig(
        width_px=32,
        height_px=16,
        colour=True,
        exposure_s=0.005,
        gain=2.0,
        flicker_hz=50,
        flip="rotate-180",
        sensor_mode=1,
    )
    frame = PicameraSource(camera).read(1.0)
    assert (frame.image[0, 0] == (200, 0, 0)).all()
    asked = fake.last.configured
    assert asked["main"]["format"] == "RGB888"
    assert asked["transform"] == {"hflip": 1, "vflip": 1}
    assert asked["sensor"] == {"output_size": (1296, 972), "bit_depth": 10}
    assert asked["controls"] == {
        "FrameRate": 60.0,
        "ExposureTime": 5000,
        "AnalogueGain": 2.0,
        "AeEnable": False,
        "AeFlickerMode": 1,
        "AeFlickerPeriod": 10_000,
    }


def test_what_is_not_there_is_one_line(fake: type[FakePicamera], monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SourceError, match="camera 3: cannot be opened: list index"):
        PicameraSource(CameraConfig(device=3))
    with pytest.raises(SourceError, match=r"expected \[camera\] sensor_mode 0 \.\. 1, got 7"):
        PicameraSource(CameraConfig(sensor_mode=7))
    monkeypatch.setitem(sys.modules, "picamera2", None)
    with pytest.raises(SourceError, match="apt-get install python3-picamera2"):
        PicameraSource(CAMERA)


def test_the_package_offers_it_by_an_entry_point() -> None:
    entries = parse_toml((ROOT / "pyproject.toml").read_text(), "pyproject.toml")["project"]["entry-points"]
    assert entries["automodel.sources"] == {"picamera2": f"{PicameraSource.__module__}:{PicameraSource.__qualname__}"}
