"""The cameras that car.toml names: one, or a pair, each with a device of its own."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
import pytest

from automodel.assembly.parts import left_alone, make_camera, make_pipeline, open_pair
from automodel.config import CarConfig, ConfigError, parse_car
from automodel.signals import Frame, StereoFrame
from automodel.sources import csi, usb
from automodel.sources.errors import SourceError
from automodel.sources.pairs import LivePair

LENS = "[camera.right.intrinsics]\nfx_px = 500.0\n[camera.right.extrinsics]\ny_m = -0.125\n"
DEVICES = {"usb": (0, 2), "csi": (1, 0), "team_pair_cameras:Webcam": (3, 1)}
GONE: set[int] = set()


class Opened:
    """A camera that this test made; `devices` are those that are open."""

    devices: ClassVar[list[int]] = []

    def __init__(self, camera: Any) -> None:
        self.device = camera if isinstance(camera, int) else camera.device
        if self.device in GONE:
            raise SourceError(f"camera {self.device}: cannot be opened")
        self.devices.append(self.device)
        self.index = 0

    def read(self, timeout_s: float) -> Frame:
        time.sleep(0.005)
        self.index += 1
        image = np.full((4, 4), 10 * self.device, np.uint8)
        image[0, 0] = self.index % 256
        return Frame(t_ns=time.monotonic_ns(), index=self.index, image=image)

    def close(self) -> None:
        if self.device in self.devices:
            self.devices.remove(self.device)


class V4L2(Opened):
    """OpenCV's capture of such a camera."""

    def __init__(self, device: int, backend: int) -> None:
        self.there = device not in GONE
        if self.there:
            super().__init__(device)

    def isOpened(self) -> bool:
        return self.there

    def set(self, key: int, value: float) -> bool:
        return True

    def get(self, key: int) -> float:
        return {cv2.CAP_PROP_FRAME_WIDTH: 640, cv2.CAP_PROP_FRAME_HEIGHT: 360}.get(key, 0.0)

    def grab(self) -> bool:
        return True

    def retrieve(self) -> tuple[bool, Any]:
        return True, self.read(0.0).image

    def release(self) -> None:
        if self.there:
            self.close()


@pytest.fixture(autouse=True)
def cameras(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[int]:
    """The devices that are open, of each kind of camera."""
    monkeypatch.setattr(cv2, "VideoCapture", V4L2)
    monkeypatch.setattr(usb, "set_controls", lambda device, camera: None)
    monkeypatch.setattr(csi, "csi_source", Opened)
    (tmp_path / "team_pair_cameras.py").write_text("from tests.assembly.test_parts import Opened as Webcam\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(Opened, "devices", [])
    GONE.clear()
    return Opened.devices


def car_of(source: str, pipeline: str = "windows", more: str = LENS) -> CarConfig:
    left, right = DEVICES[source]
    text = f'[camera]\nsource = "{source}"\ndevice = {left}\n[camera.right]\ndevice = {right}\n{more}'
    return parse_car(f'{text}[pipeline]\nname = "{pipeline}"\n', "car.toml")


@pytest.mark.parametrize("source", DEVICES)
def test_each_eye_is_a_camera_of_its_own(source: str, cameras: list[int]) -> None:
    camera = make_camera(car_of(source))
    assert isinstance(camera, LivePair)
    assert cameras == list(DEVICES[source])
    for _ in range(200):
        frame = camera.read(0.1)
        if isinstance(frame, StereoFrame):
            break
    assert isinstance(frame, StereoFrame)
    left, right = DEVICES[source]
    assert (frame.left[-1, -1], frame.right[-1, -1]) == (10 * left, 10 * right)
    camera.close()
    assert cameras == []


@pytest.mark.parametrize("source", DEVICES)
def test_where_one_eye_cannot_be_opened_neither_is(source: str, cameras: list[int]) -> None:
    for number, side in enumerate(("left", "right")):
        GONE.clear()
        GONE.add(DEVICES[source][number])
        with pytest.raises(SourceError, match=rf"^{side} camera: .*cannot be opened"):
            make_camera(car_of(source))
        assert cameras == []


def test_without_a_device_there_is_one_camera_as_before(cameras: list[int]) -> None:
    car = parse_car(f'[camera]\nsource = "usb"\n{LENS}[pipeline]\nname = "windows"\n', "car.toml")
    camera = make_camera(car)
    assert not isinstance(camera, LivePair)
    camera.close()
    stereo = parse_car(f'[camera]\nsource = "usb"\n{LENS}[pipeline]\nname = "stereo"\n', "car.toml")
    with pytest.raises(ConfigError) as caught:
        make_camera(stereo)
    assert str(caught.value) == (
        '[camera.right] device is missing: [camera] source "usb" is one camera, and the pipeline stereo sees through '
        "two; set it to the right one's number"
    )
    make_camera(stereo, any_mode=True).close()  # who calibrates one camera may
    make_camera(left_alone(car_of("usb", "stereo"))).close()
    assert cameras == []


def test_a_device_without_a_calibrated_lens_opens_and_does_not_drive_by_stereo() -> None:
    for more in ("", "[camera.right.intrinsics]\nfx_px = 500.0\n", "[camera.right.extrinsics]\ny_m = -0.1\n"):
        car = car_of("usb", "stereo", more)
        make_camera(car).close()
        with pytest.raises(ConfigError, match=r"^pipeline stereo: \[camera\.right\] has a device, and its lens or its"):
            make_pipeline("stereo", car)
    make_pipeline("stereo", car_of("usb", "stereo"))


def test_the_tolerance_of_a_pair_is_that_of_car_toml(tmp_path: Path) -> None:
    """A quarter of the period, or what is set: of live cameras and of videos alike."""
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        cv2.imwrite(str(tmp_path / side / "0.png"), np.zeros((360, 640), np.uint8))
    for more, tolerance_s in (("", 0.25 / 60.0), ("pair_tolerance_s = 0.002\n", 0.002)):
        car = car_of("usb", more=more + LENS)
        camera = make_camera(car)
        assert isinstance(camera, LivePair)
        assert camera.tolerance_s == pytest.approx(tolerance_s)
        camera.close()
        source = open_pair(tmp_path / "left", tmp_path / "right", car, 60.0)
        assert source.tolerance_s == pytest.approx(tolerance_s)
