"""`contour` on nonsense: noise, images of a few pixels, odometers and clocks that say anything."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from automodel.config import ContourConfig
from automodel.pipelines.contour import Contour
from automodel.signals import Frame, LaneStatus, Motion, MotionSource
from tests.support.masked_drives import arc, line, road
from tests.support.rendered_drives import CAR, RenderedDrive, Seen, camera, check_sound, with_camera
from tests.support.slow_lane import rest_slow

SIZE = (CAR.camera.height_px, CAR.camera.width_px)
BLACK, WHITE = np.zeros(SIZE, np.uint8), np.full(SIZE, 255, np.uint8)
PERIOD_NS = 33_333_333
ODD = (math.nan, math.inf, -math.inf, 1e300, -1e300, 0.0)


@pytest.fixture(scope="module")
def seen() -> list[Seen]:
    """A metre of a straight and the beginning of a bend."""
    return RenderedDrive(track=road(line(1.6), arc(1.5, 1.0)), pipeline=Contour(CAR)).run(0.4, 1.4)


def motion(t_ns: int, speed_mps: float = 0.0) -> Motion:
    return Motion(t_ns=t_ns, speed_mps=speed_mps, yaw_rate_radps=0.0)


def noises() -> list[np.ndarray]:
    rng = np.random.default_rng(3)
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    return [
        rng.integers(0, 256, SIZE, dtype=np.uint8),
        rng.integers(0, 256, (*SIZE, 3), dtype=np.uint8),
        np.where(rng.random(SIZE) < 0.02, 255, 0).astype(np.uint8),
        np.kron(rng.integers(0, 256, (9, 16), dtype=np.uint8), np.ones((40, 40), np.uint8)),
        np.where((u // 20 + v // 20) % 2, 255, 0).astype(np.uint8),
        np.where(np.sin(u * 0.3) > 0.6, 255, 20).astype(np.uint8),
        np.clip(rng.normal(90.0, 10.0, SIZE), 0, 255).astype(np.uint8),
    ]


def test_black_white_and_plain_noise_are_no_lane() -> None:
    faint = np.clip(np.random.default_rng(5).normal(90.0, 4.0, SIZE), 0, 255).astype(np.uint8)
    for image in (BLACK, WHITE, faint, noises()[0]):
        pipeline = Contour(CAR)
        for k in range(6):
            reported = pipeline.step(Frame(t_ns=k * PERIOD_NS, index=k, image=image), motion(k * PERIOD_NS))
            check_sound(reported, k * PERIOD_NS)
            assert reported.status is LaneStatus.LOST


OPTIONS: tuple[dict[str, Any], ...] = ({"precision": "single"}, {"update": "gradient_descent"})


@pytest.mark.parametrize("options", rest_slow(OPTIONS, OPTIONS[1]), ids=str)
def test_noise_in_a_drive_gives_no_nan(seen: list[Seen], options: dict[str, Any]) -> None:
    car = replace(CAR, pipeline=replace(CAR.pipeline, contour=ContourConfig(**options)))
    for image in noises():
        pipeline = Contour(car)
        for s in seen[:6]:
            pipeline.step(s.frame, s.motion)
        for k in range(1, 5):
            t_ns = seen[-1].frame.t_ns + k * PERIOD_NS
            check_sound(pipeline.step(Frame(t_ns=t_ns, index=k, image=image), motion(t_ns, 1.0)), t_ns)
        after = [pipeline.step(replace(s.frame, t_ns=s.frame.t_ns + 10**12), s.motion) for s in seen[:6]]
        assert after[-1].valid  # and it does not last


@st.composite
def pictures(draw: st.DrawFn) -> np.ndarray:
    rng = np.random.default_rng(draw(st.integers(0, 2**31)))
    kind = draw(st.sampled_from(("noise", "black", "white", "stripes", "colour", "small")))
    if kind == "stripes":
        angle, period = rng.uniform(0.0, np.pi), rng.uniform(8.0, 200.0)
        v, u = np.mgrid[: SIZE[0], : SIZE[1]]
        bright = np.sin((u * np.cos(angle) + v * np.sin(angle)) * np.pi / period) > 0.6
        return np.where(bright, 255, 20).astype(np.uint8)
    if kind == "colour":
        return rng.integers(0, 256, (*SIZE, 3), dtype=np.uint8)
    if kind == "small":
        return rng.integers(0, 256, tuple(rng.integers(1, 50, 2)), dtype=np.uint8)
    return {"black": BLACK, "white": WHITE}.get(kind, rng.integers(0, 256, SIZE, dtype=np.uint8))


STEPS = st.tuples(
    st.one_of(st.none(), pictures()),  # None: a good image
    st.sampled_from([0, 1, 16_666_667, 33_333_333, 400_000_000, 10**10, -(10**8), -(10**12)]),
    st.one_of(st.floats(-5.0, 5.0), st.sampled_from([1.0, 100.0, *ODD])),
    st.one_of(st.floats(-5.0, 5.0), st.sampled_from([50.0, -400.0, *ODD])),
    st.sampled_from(list(MotionSource)),
)


@pytest.mark.parametrize("precision", rest_slow(("double", "single"), "double"))
@settings(max_examples=12, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(steps=st.lists(STEPS, min_size=4, max_size=14))
def test_nothing_a_camera_or_gyro_says_raises_or_gives_nan(
    seen: list[Seen], precision: str, steps: list[tuple[np.ndarray | None, int, float, float, MotionSource]]
) -> None:
    pipeline = Contour(replace(CAR, pipeline=replace(CAR.pipeline, contour=ContourConfig(precision=precision))))
    t_ns = 10**13
    for s in seen[:3]:
        pipeline.step(replace(s.frame, t_ns=t_ns + s.frame.t_ns), s.motion)
    for index, (picture, dt_ns, speed, yaw_rate, source) in enumerate(steps):
        t_ns += dt_ns
        image = seen[index].frame.image if picture is None else picture
        moved = Motion(t_ns=t_ns, speed_mps=speed, yaw_rate_radps=yaw_rate, source=source)
        check_sound(pipeline.step(Frame(t_ns=t_ns, index=index, image=image), moved), t_ns)


@pytest.mark.parametrize(
    ("width_px", "height_px"),
    [(1, 1), (1, 4), (2, 2), (3, 3), (3, 361), (8, 6), (16, 9), (32, 18), (40, 360), (640, 12)],
)
def test_a_picture_smaller_than_the_search_is_refused_or_no_lane(width_px: int, height_px: int) -> None:
    """The road's ridges must be there: either a clear error, or a pipeline that says LOST."""
    car = with_camera(camera(width_px, height_px, 0.75 * width_px))
    if height_px == 1:  # no row of it shows the ground
        with pytest.raises(ValueError, match="pitch_rad: the image shows no ground"):
            Contour(car)
        return
    pipeline = Contour(car)
    rng = np.random.default_rng(1)
    for k in range(6):
        image = (
            rng.integers(0, 256, (height_px, width_px), dtype=np.uint8)
            if k % 2
            else np.zeros((height_px, width_px), np.uint8)
        )
        t_ns = k * PERIOD_NS
        check_sound(pipeline.step(Frame(t_ns=t_ns, index=k, image=image), motion(t_ns, 1.0)), t_ns)
