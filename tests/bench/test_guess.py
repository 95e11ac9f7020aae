"""`bench guess`: the cameras, the worlds, and when a guess is right, wrong, misled or refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from automodel.bench import guess
from automodel.bench.guess import GuessChoice, measure_world, random_camera, summary
from automodel.config import CarConfig
from automodel.geometry import CameraModel
from calibration.from_lanes import LanesCalibration
from calibration.guess import GuessedCar


def guessed(pitch_deg: float, height: float, sigma_deg: float, sigma_height: float) -> GuessedCar:
    """What is guessed of a camera 0.2 m above the road that looks down by 10 deg: with these errors, and this sure."""
    car = CarConfig()
    place = replace(car.camera.extrinsics, pitch_rad=math.radians(10.0 + pitch_deg), z_m=0.2 * height)
    camera = replace(car.camera, extrinsics=replace(place, yaw_rad=0.0, roll_rad=0.0))
    lanes = LanesCalibration(
        extrinsics=place, lane_width_m=0.4, roll_known=True, residual_px=1.0, vanishing_px=(0.0, 0.0),
        vanishing_sigma_px=(0.0, 0.0), ground_error_m={}, std={}, markings="light", marking_heights=0.1,
        frames_used=9, frames_seen=9,
    )  # fmt: skip
    sigma = {"pitch_rad": math.radians(sigma_deg), "z_m": 0.2 * height * sigma_height}
    return GuessedCar(car=replace(car, camera=camera), sigma=sigma, told=(), lanes=lanes)


@pytest.mark.parametrize(
    ("found", "result"),
    [
        (guessed(0.4, 1.04, 0.01, 0.001), "right"),  # within the limits: how sure it is does not matter
        (guessed(0.6, 1.0, 0.25, 0.01), "wrong"),
        (guessed(0.6, 1.0, 0.1, 0.01), "misled"),
        (guessed(0.0, 2.0, 0.1, 0.1), "misled"),
        (guessed(0.0, 0.9, 0.1, 0.1), "wrong"),
    ],
)
def test_a_guess_misleads_that_is_wrong_and_sure(found: GuessedCar, result: str) -> None:
    true = replace(CarConfig().camera.extrinsics, pitch_rad=math.radians(10.0), z_m=0.2, yaw_rad=0.0, roll_rad=0.0)
    row = guess._errors(found, true)
    assert row["result"] == result


def test_the_summary_counts_the_right_ones_among_those_that_were_answered() -> None:
    right = {"result": "right", "pitch_error_deg": -0.2, "height_error_pct": 1.0}
    misled = {"result": "misled", "pitch_error_deg": 0.6, "height_error_pct": -3.0}
    row = summary([right, misled, right, {"result": "refused"}], "given")
    assert (row["worlds"], row["refused"], row["answered"], row["right"], row["misled"]) == (4, 1, 3, 2, 1)
    assert row["right_pct"] == pytest.approx(200.0 / 3.0)
    assert row["pitch_mae_deg"] == pytest.approx(1.0 / 3.0)
    assert summary([{"result": "refused"}], "given")["right_pct"] is None


def test_cameras_differ_and_see_the_road() -> None:
    cameras = [random_camera(seed, 3.5 if street else 0.4, street) for seed in range(8) for street in (False, True)]
    assert len({camera.extrinsics.pitch_rad for camera in cameras}) == 16
    for camera in cameras:
        lens = CameraModel(camera.intrinsics, camera.width_px, camera.height_px)
        assert np.isfinite(lens.rays([(0.0, 0.0), (camera.width_px - 1.0, camera.height_px - 1.0)])).all()
        assert 0.0 < camera.extrinsics.pitch_rad < math.radians(26.0)


def test_the_kinds_of_roads_take_turns_and_circuits_are_streets() -> None:
    assert GuessChoice(seeds=range(4), kinds=("plain", "street")).cases() == [
        (0, "plain"),
        (1, "street"),
        (2, "plain"),
        (3, "street"),
    ]
    own = [kind for _, kind in GuessChoice(seeds=range(20)).cases()]
    assert own.count("street") == 4
    assert "circuit" not in own


@pytest.mark.slow
def test_a_road_without_markings_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guess, "IMAGES", 8)
    done: list[float] = []
    row = measure_world(CarConfig(), GuessChoice(), (1, "unmarked"), done.append)
    assert row["result"] == "refused"
    assert "straight road" in row["refusal"]
    assert sum(done) == pytest.approx(1.0)
