from __future__ import annotations

import fcntl
import itertools
import shutil
import struct
import subprocess
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from automodel.config import CameraConfig
from automodel.sources import usb
from automodel.sources.errors import SourceError
from automodel.sources.usb import UsbSource, controls, set_controls

CAMERA = CameraConfig(source="usb", device=1, width_px=320, height_px=180, rate_hz=59.94)


class FakeCapture:
    """Stands for OpenCV's V4L2 capture: says what it was asked for, gives scripted frames."""

    sizes = (320, 180)
    opened = True
    frames = 3
    driver_ms = float("nan")
    fourcc = 0  # a driver that does not say
    image: Any = None

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
        known = {
            cv2.CAP_PROP_FRAME_WIDTH: self.sizes[0],
            cv2.CAP_PROP_FRAME_HEIGHT: self.sizes[1],
            cv2.CAP_PROP_FOURCC: self.fourcc,
        }
        return self.driver_ms if key == cv2.CAP_PROP_POS_MSEC else known[key]

    def grab(self) -> bool:
        self.frames -= 1
        return self.frames >= 0

    def retrieve(self) -> tuple[bool, Any]:
        return True, np.full((self.sizes[1], self.sizes[0], 3), 77, np.uint8) if self.image is None else self.image

    def release(self) -> None:
        self.released += 1


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> type[FakeCapture]:
    class Fresh(FakeCapture):
        pass

    monkeypatch.setattr(cv2, "VideoCapture", Fresh)
    monkeypatch.setattr(usb, "set_controls", lambda device, camera: None)  # there is no such device
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


def test_the_kernels_time_is_taken_and_latency_counts_without_one(
    fake: type[FakeCapture], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time, "monotonic_ns", lambda: 5_000_000_000)
    fake.driver_ms = 4_980.0
    source = UsbSource(CameraConfig(width_px=320, height_px=180, latency_s=0.03))
    assert (source.read(1.0).t_ns, source.own_time) == (4_980_000_000, True)
    fake.driver_ms = 12.0  # a driver that counts from somewhere else
    assert (source.read(1.0).t_ns, source.own_time) == (4_970_000_000, False)


@pytest.mark.parametrize("wanted", ["YUYV", "GREY", "MJPG"])
def test_the_pixel_format_is_asked_for_and_checked(fake: type[FakeCapture], wanted: str) -> None:
    camera = CameraConfig(device=1, width_px=320, height_px=180, pixel_format=wanted)
    fake.fourcc = cv2.VideoWriter.fourcc(*wanted)
    capture: Any = UsbSource(camera)._capture
    assert capture.asked[cv2.CAP_PROP_FOURCC] == cv2.VideoWriter.fourcc(*wanted)
    fake.fourcc = cv2.VideoWriter.fourcc(*"H264")
    with pytest.raises(SourceError, match=f"/dev/video1: expected pixel format {wanted}, got H264; set"):
        UsbSource(camera)
    fake.fourcc = cv2.VideoWriter.fourcc(*"JPEG")
    if wanted == "MJPG":
        UsbSource(camera)


def test_an_image_is_turned_where_the_camera_hangs_upside_down(fake: type[FakeCapture]) -> None:
    fake.image = np.zeros((180, 320, 3), np.uint8)
    fake.image[0, 0] = 200
    source = UsbSource(CameraConfig(width_px=320, height_px=180, flip="rotate-180"))
    image = source.read(1.0).image
    assert (image[-1, -1], image.sum()) == (200, 200)


class FakeControls:
    """A device's controls behind ioctl; those in `lacking` are refused as the kernel refuses them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, lacking: tuple[int, ...] = ()) -> None:
        self.values: dict[int, int] = {}
        self.lacking = lacking
        monkeypatch.setattr(fcntl, "ioctl", self.ioctl)

    def ioctl(self, descriptor: int, request: int, data: bytes) -> bytes:
        assert request == usb.S_CTRL
        number, value = struct.unpack("=Ii", data)
        if number in self.lacking:
            raise OSError(22, "Invalid argument")
        self.values[number] = value
        return data


def test_exposure_gain_and_anti_flicker_are_the_kernels_controls(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    device = tmp_path / "video0"
    device.write_text("")
    fake = FakeControls(monkeypatch)
    set_controls(str(device), CameraConfig(exposure_s=0.005, gain=32.0, flicker_hz=50))
    assert fake.values == {
        usb.EXPOSURE_AUTO_PRIORITY: 0,
        usb.EXPOSURE_AUTO: 1,
        usb.EXPOSURE_ABSOLUTE: 50,
        usb.AUTOGAIN: 0,
        usb.GAIN: 32,
        usb.POWER_LINE_FREQUENCY: 1,
    }
    set_controls(str(device), CameraConfig(flicker_hz=60))  # what was locked is automatic again
    assert [fake.values[n] for n in (usb.EXPOSURE_AUTO, usb.AUTOGAIN, usb.POWER_LINE_FREQUENCY)] == [3, 1, 2]


def test_a_camera_without_a_control_is_refused_only_where_it_was_asked_for(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    device = tmp_path / "video0"
    device.write_text("")
    lacking = tuple(number for _, number, _, _ in controls(CameraConfig()))
    FakeControls(monkeypatch, (*lacking, usb.EXPOSURE_ABSOLUTE, usb.GAIN))
    set_controls(str(device), CameraConfig())
    for key, wrong in (("exposure_s", {"exposure_s": 0.01}), ("gain", {"gain": 5.0})):
        with pytest.raises(SourceError, match=rf"\[camera\] {key} cannot be set \(Invalid argument\); v4l2-ctl"):
            set_controls(str(device), CameraConfig(**wrong))  # type: ignore[arg-type]
    with pytest.raises(SourceError, match="No such file"):
        set_controls(str(tmp_path / "none"), CameraConfig())


HEADER = """
#include <linux/videodev2.h>
#include <stdio.h>
int main(void) {
    printf("%lu %zu %u %u %u %u %u %u %d %d\\n", (unsigned long)VIDIOC_S_CTRL, sizeof(struct v4l2_control),
           V4L2_CID_GAIN, V4L2_CID_POWER_LINE_FREQUENCY, V4L2_CID_EXPOSURE_AUTO, V4L2_CID_EXPOSURE_ABSOLUTE,
           V4L2_CID_EXPOSURE_AUTO_PRIORITY, V4L2_CID_AUTOGAIN, V4L2_EXPOSURE_MANUAL, V4L2_EXPOSURE_APERTURE_PRIORITY);
    return V4L2_CID_POWER_LINE_FREQUENCY_50HZ != 1 || V4L2_CID_POWER_LINE_FREQUENCY_60HZ != 2;
}
"""


@pytest.mark.skipif(
    shutil.which("gcc") is None or not Path("/usr/include/linux/videodev2.h").exists(),
    reason="needs gcc and the kernel's headers (apt-get install gcc linux-libc-dev)",
)
def test_the_numbers_are_those_of_the_kernels_header(tmp_path: Path) -> None:
    (tmp_path / "numbers.c").write_text(HEADER)
    subprocess.run(["gcc", "numbers.c", "-o", "numbers"], cwd=tmp_path, check=True)
    said = subprocess.run([tmp_path / "numbers"], capture_output=True, text=True, check=True).stdout
    assert [int(word) for word in said.split()] == [
        usb.S_CTRL, struct.calcsize("=Ii"), usb.GAIN, usb.POWER_LINE_FREQUENCY, usb.EXPOSURE_AUTO,
        usb.EXPOSURE_ABSOLUTE, usb.EXPOSURE_AUTO_PRIORITY, usb.AUTOGAIN, 1, 3,
    ]  # fmt: skip
