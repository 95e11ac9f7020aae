"""`centerline` with networks: files that are none, outputs that cannot be used, and what ships."""

from __future__ import annotations

import types
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest

from automodel.assembly.parts import make_pipeline
from automodel.config import CarConfig, CenterlineConfig, ConfigError, parse_car
from automodel.perception.markings.ridge import RidgeFilter
from automodel.perception.markings.unet import MarkingNetwork, UnetConfig
from automodel.pipelines.centerline import Centerline
from automodel.signals import Frame, LaneStatus, Motion
from automodel.sim.appearance import Appearance
from automodel.sim.track_files import load_track
from tests.support import onnx_files as files
from tests.support.masked_drives import arc, errors, gap, line, road
from tests.support.rendered_drives import CAR, RenderedDrive, Seen, check_sound
from tests.support.slow_lane import rest_slow

SIZE = (CAR.camera.height_px, CAR.camera.width_px)
PICTURES = {
    "black": np.zeros(SIZE, np.uint8),
    "white": np.full(SIZE, 255, np.uint8),
    "grey": np.full(SIZE, 120, np.uint8),
    "noise": np.random.default_rng(5).integers(0, 256, SIZE, dtype=np.uint8),
    "ramp": np.tile(np.linspace(0, 255, SIZE[1]).astype(np.uint8), (SIZE[0], 1)),
}


def car_with(**keys: Any) -> CarConfig:
    return replace(CAR, pipeline=replace(CAR.pipeline, centerline=CenterlineConfig(providers=("cpu",), **keys)))


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """A network of a few lines, which marks what is brighter than its surroundings."""
    path = tmp_path / "ridge.onnx"
    path.write_bytes(files.model())
    return path


def car_toml(model: Path, network: str = "256x128") -> CarConfig:
    """As a user writes it."""
    text = f"[pipeline.centerline]\nmodel = '{model}'\nnetwork = '{network}'\nproviders = ['cpu']\nthreads = 1\n"
    return parse_car(text, "car.toml")


def test_a_network_of_ones_own_drives(small: Path) -> None:
    pipeline = make_pipeline("centerline", car_toml(small))
    assert isinstance(pipeline, Centerline)
    found = errors(RenderedDrive(track=road(line(6.0)), pipeline=pipeline).run(0.8, 2.0), skip=10)
    assert found.statuses == {LaneStatus.TRACKING: 26}
    assert found.offset_max_m < 0.01


GOOD = files.model()
DAMAGED = {
    "empty": b"",
    "text": b"hello\n",
    "cut off": GOOD[: len(GOOD) // 2],
    "a bit turned": GOOD[:40] + bytes([GOOD[40] ^ 0x80]) + GOOD[41:],
    "random": np.random.default_rng(2).bytes(5000),
    "an evil operator": files.model(files.graph((*files.NODES, files.node("Evil", "grey", "x")))),
    "data elsewhere": files.model(
        files.graph(
            tensors=(
                *files.WEIGHTS,
                files.field(2, 1)
                + files.field(8, "far")
                + files.field(13, files.field(1, "location") + files.field(2, "/etc/passwd"))
                + files.field(14, 1),
            )
        )
    ),
    "too large": bytes(9_000_000),
    "marks nothing": files.model(files.graph((files.node("Sub", "image image", "marking"),))),
    "the picture itself": files.model(files.graph((files.node("Identity", "image", "marking"),))),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_a_file_that_is_no_network_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    path = tmp_path / "model.onnx"
    path.write_bytes(DAMAGED[name])
    with pytest.raises(ConfigError) as caught:
        make_pipeline("centerline", car_toml(path))
    said = str(caught.value)
    assert said.startswith(f"pipeline centerline: {path}: ")
    assert "\n" not in said
    assert len(said) < 600


def test_a_file_that_is_not_there_or_of_another_size_is_refused(tmp_path: Path, small: Path) -> None:
    for model, network, words in (
        (tmp_path / "none.onnx", "256x128", "no such file"),
        (tmp_path, "256x128", "cannot be read"),
        (small, "512x256", "256"),
    ):
        with pytest.raises(ConfigError, match=f"pipeline centerline: .*{words}") as caught:
            make_pipeline("centerline", car_toml(model, network))
        assert "\n" not in str(caught.value)


def test_wrong_keys_are_refused_by_name() -> None:
    for key, value, words in (
        ("markings", "'unot'", "did you mean 'unet'"),
        ("network", "'1024x512'", "512x256"),
        ("providers", "['tpu']", "cuda"),
        ("threads", "-1", "threads"),
        ("threshold", "1.5", "below 1"),
        ("modell", "'x'", "model"),
    ):
        with pytest.raises(ConfigError, match=words) as caught:
            parse_car(f"[pipeline.centerline]\n{key} = {value}\n", "car.toml")
        assert str(caught.value).startswith("car.toml:")


def _raise(*_: object) -> None:
    raise onnxruntime.capi.onnxruntime_pybind11_state.RuntimeException("the device is gone")


OUTPUTS: dict[str, Callable[..., Any]] = {
    "NaN": lambda *_: [np.full((1, 1, files.HEIGHT, files.WIDTH), np.nan, np.float32)],
    "another shape": lambda *_: [np.zeros((1, 1, 7, 9), np.uint8)],
    "an error": _raise,
    "nothing": lambda *_: [None],
}


@pytest.mark.parametrize("name", OUTPUTS)
def test_an_output_that_cannot_be_used_is_no_lane(small: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    network = MarkingNetwork(UnetConfig(model=str(small), size="256x128", providers=("cpu",), threads=1))
    pipeline = Centerline(CAR, network)
    seen = RenderedDrive(track=road(line(6.0)), pipeline=pipeline).run(0.8, 1.2)
    assert seen[-1].estimate.status is LaneStatus.TRACKING
    monkeypatch.setattr(network, "_session", types.SimpleNamespace(run=OUTPUTS[name]))
    reported = []
    for k in range(1, 91):
        t_ns = seen[-1].frame.t_ns + 33_333_333 * k
        frame = Frame(t_ns=t_ns, index=k, image=seen[-1].frame.image)
        estimate = pipeline.step(frame, Motion(t_ns=t_ns, speed_mps=1.0, yaw_rate_radps=0.0))
        check_sound(estimate, t_ns)
        reported.append(estimate.status)
    assert network.faults == 90
    coasted = reported.index(LaneStatus.LOST)
    assert set(reported[:coasted]) == {LaneStatus.COASTING}
    assert set(reported[coasted:]) == {LaneStatus.LOST}
    fresh = Centerline(CAR, network)
    assert fresh.step(seen[-1].frame, seen[-1].motion).status is LaneStatus.LOST
    assert network.faults == 91


@pytest.fixture(scope="module")
def shipped() -> Centerline:
    """The pipeline with the network that ships."""
    return Centerline(car_with())


@pytest.fixture(scope="module")
def picture() -> Centerline:
    """The pipeline with the network that sees the picture instead of the road from above."""
    return Centerline(car_with(network="512x256"))


@pytest.fixture(scope="module")
def by_ridge() -> Centerline:
    pipeline = Centerline(car_with(markings="ridge"))
    assert isinstance(pipeline._markings, RidgeFilter)
    return pipeline


@pytest.fixture(params=["shipped", "picture", "by_ridge"])
def either(request: pytest.FixtureRequest) -> Centerline:
    pipeline: Centerline = request.getfixturevalue(request.param)
    pipeline.reset()
    return pipeline


@pytest.mark.parametrize("name", PICTURES)
def test_pictures_of_nothing_are_lost(either: Centerline, name: str) -> None:
    image = PICTURES[name]
    for k in range(4):
        t_ns = 33_333_333 * (k + 1)
        frame = Frame(t_ns=t_ns, index=k, image=image)
        estimate = either.step(frame, Motion(t_ns=t_ns, speed_mps=1.0, yaw_rate_radps=0.0))
        check_sound(estimate, t_ns)
        assert estimate.status is LaneStatus.LOST


def check(seen: list[Seen], skip: int, heading_deg: float = 1.5) -> None:
    for one in seen:
        check_sound(one.estimate, one.frame.t_ns)
    found = errors(seen, skip)
    assert found.available == 1.0
    assert found.offset_mean_m < 0.008
    assert found.heading_mean_deg < heading_deg
    assert found.offset_max_m < 0.05


def test_straight_and_bend(either: Centerline) -> None:
    track = road(line(2.0), arc(1.2, 2.0))
    check(RenderedDrive(track=track, pipeline=either, rate_hz=20.0).run(0.8, 3.4), skip=8)


@pytest.mark.parametrize("seed", rest_slow((1, 4), 4))
def test_part_of_a_lap_in_competition_light(either: Centerline, seed: int) -> None:
    """A straight of the contest's floor, a corner, and the next straight."""
    look = Appearance.random(seed, "competition")
    drive = RenderedDrive(track=load_track("tmr"), pipeline=either, look=look, rate_hz=20.0, speed_mps=1.2)
    check(drive.run(24.6, 29.0), skip=10)


def test_a_line_that_is_missing(either: Centerline) -> None:
    drive = RenderedDrive(track=road(line(9.0), gap(2.0, 8.0, "right")), pipeline=either, rate_hz=15.0)
    seen = drive.run(0.8, 4.2)
    check(seen, skip=8)
    assert sum(s.estimate.status is LaneStatus.ONE_LINE for s in seen) > 20


def test_colour_is_as_good_as_grey(either: Centerline) -> None:
    track = road(line(6.0))
    grey = RenderedDrive(track=track, pipeline=either, rate_hz=20.0).run(0.8, 1.8)
    either.reset()
    colour = RenderedDrive(
        track=track, car=replace(CAR, camera=replace(CAR.camera, colour=True)), pipeline=either, rate_hz=20.0
    ).run(0.8, 1.8)
    for one, other in zip(grey, colour, strict=True):
        assert other.frame.image.ndim == 3
        assert one.estimate.pose is not None
        assert other.estimate.pose is not None
        assert other.estimate.pose.offset_m == pytest.approx(one.estimate.pose.offset_m, abs=0.003)
        assert other.estimate.pose.heading_rad == pytest.approx(one.estimate.pose.heading_rad, abs=0.01)


def test_the_network_that_ships_sees_the_road_from_above(shipped: Centerline) -> None:
    network = shipped._markings
    assert isinstance(network, MarkingNetwork)
    assert network.from_above
    assert network.first_row == 0


def test_a_view_of_another_depth_and_width_is_stretched_to_the_network() -> None:
    """Three quarters as wide, four thirds as deep."""
    pipeline = Centerline(car_with(view_half_lanes=1.35, view_ahead_lanes=4.0))
    drive = RenderedDrive(track=road(line(6.0)), pipeline=pipeline, rate_hz=20.0)
    check(drive.run(0.8, 2.3), skip=8)


def test_two_networks_run_alike() -> None:
    drive = RenderedDrive(track=road(line(6.0)), pipeline=Centerline(car_with(threads=1)), rate_hz=20.0)
    once = drive.run(0.8, 1.3)
    again = RenderedDrive(track=road(line(6.0)), pipeline=Centerline(car_with(threads=1)), rate_hz=20.0).run(0.8, 1.3)
    for one, other in zip(once, again, strict=True):
        assert one.estimate.pose is not None
        assert other.estimate.pose is not None
        assert one.estimate.pose.offset_m == other.estimate.pose.offset_m
        assert one.estimate.pose.covariance.tobytes() == other.estimate.pose.covariance.tobytes()
