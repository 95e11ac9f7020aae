"""`replay --guess`: from a stranger's video to a car.toml and a picture; and why a replay saw no lane."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from automodel.assembly.guess import why_lost
from automodel.config import CameraConfig, CarConfig, Extrinsics, Intrinsics, LaneConfig, load_car
from automodel.sources.files import VideoSource
from automodel.types import Image
from automodel.viewer.video import VideoWriter
from tests.support.highway_pictures import LANE_M, SOLID, Line, camera_model, draw, lane, mounted

SIZE, FOCAL_PX = (480, 270), 384.0
CAMERA = mounted(camera_model(*SIZE, FOCAL_PX), z_m=1.4, pitch_rad=0.12)
VIEW_DEG = math.degrees(2.0 * math.atan(0.5 * SIZE[0] / FOCAL_PX))


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """24 frames of a drawn road, the car drifting in its lane."""
    path = tmp_path_factory.mktemp("film") / "drive.mp4"
    with VideoWriter(path, 10.0) as video:
        for k in range(24):
            image = draw_at(0.3 * math.sin(0.5 * k), 2.0 * k, k)
            video.write(np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8))
    return path


def draw_at(offset_m: float, phase_m: float, seed: int) -> Image:
    lines = [*lane(offset_m, SOLID, SOLID), Line(-offset_m + 1.5 * LANE_M, phase_m=phase_m)]
    return draw(CAMERA, lines, seed=seed)


def camera_config(**place: float) -> CameraConfig:
    lens = Intrinsics(fx_px=FOCAL_PX, fy_px=FOCAL_PX, cx_px=239.5, cy_px=134.5)
    where = Extrinsics(**{"x_m": 0.0, "z_m": 1.4, "pitch_rad": 0.12, **place})
    return CameraConfig(width_px=SIZE[0], height_px=SIZE[1], intrinsics=lens, extrinsics=where)


def test_one_command_makes_a_car_and_an_overlay(
    film: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cli
) -> None:
    monkeypatch.chdir(tmp_path)
    said = cli("replay", film, "--guess", "--lane-width-m", LANE_M, "--view-deg", VIEW_DEG, "--json")
    assert said.code == 0, said.err
    (row,) = said.rows
    assert row["frames"] == 24
    assert row["availability_pct"] > 90.0
    assert "doubtful" not in said.err
    assert "assumed" not in said.err
    car = load_car(Path("drive.car.toml"))
    assert car.camera.extrinsics.pitch_rad == pytest.approx(0.12, abs=math.radians(0.5))
    assert car.camera.extrinsics.z_m == pytest.approx(1.4, rel=0.05)
    assert car.lane.width_m == LANE_M
    assert "+-" in Path("drive.car.toml").read_text()
    assert VideoSource("drive.overlay.mp4").frame_count == 24

    Path("dark.toml").write_text(Path("drive.car.toml").read_text().replace('"light"', '"dark"'))
    said = cli("replay", film, "--car", "dark.toml", "--pipeline", "windows")
    assert said.code == 0
    assert "followed in 0 of 24 frames: the markings are light, not dark. Correct car.toml" in said.err


def test_what_does_not_fit_car_toml_is_named(film: Path) -> None:
    images = [draw_at(0.3 * math.sin(k), 2.0 * k, k) for k in range(6)]
    right = CarConfig(camera=camera_config(), lane=LaneConfig(width_m=LANE_M))
    assert "centerline did not follow them" in why_lost(images, right)
    low = dataclasses.replace(right, camera=camera_config(pitch_rad=0.3))
    assert "the lines meet where pitch is 6.9 deg, not 17.2" in why_lost(images, low)
    high = dataclasses.replace(right, camera=camera_config(z_m=2.8))
    assert f"a lane of {LANE_M} m is as wide as seen from 1.4 m above it, not 2.8" in why_lost(images, high)
    assert "no straight lane is seen (expected 3 of a straight road with two lines; 0 of 4 show" in why_lost(
        [np.full((270, 480), 90, np.uint8)] * 4, right
    )


def test_a_size_that_is_not_the_simulated_car_s_names_the_command(film: Path, cli) -> None:
    said = cli("replay", film)
    assert said.code == 2
    assert said.line().endswith(f"let one be guessed: automodel replay {film} --guess")


def test_what_is_only_assumed_is_said(film: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cli) -> None:
    monkeypatch.chdir(tmp_path)
    said = cli("replay", film, "--guess", "--video", "other.mp4")
    assert said.code == 0
    assert "give it with --lane-width-m" in said.err
    assert "--view-deg" in said.err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drive.car.toml", "other.mp4"]


def test_a_car_and_a_guess_exclude_each_other(film: Path, tmp_path: Path, cli) -> None:
    said = cli("replay", film, "--guess", "--car", tmp_path / "car.toml")
    assert said.code == 2
    assert "--guess writes a car.toml; leave out --car" in said.line()
