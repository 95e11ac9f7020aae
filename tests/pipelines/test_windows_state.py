"""`windows` over time: coasting, loss, reset, and whatever a camera may deliver."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from automodel.assembly.parts import make_pipeline
from automodel.config import ConfigError
from automodel.interfaces import Pipeline
from automodel.pipelines.windows import Windows
from automodel.signals import Frame, LaneEstimate, LaneStatus, Motion, MotionSource
from automodel.sim.track_files import load_track
from automodel.tracking.frame_motion import FrameMotion
from tests.support.rendered_drives import CAR, RenderedDrive, Seen, camera, check_sound, with_camera

SIZE = (CAR.camera.height_px, CAR.camera.width_px)
BLACK = np.zeros(SIZE, np.uint8)
PERIOD_NS = 33_333_333


@pytest.fixture(scope="module")
def seen() -> list[Seen]:
    """A metre of the oval's straight."""
    return RenderedDrive(track=load_track("oval")).run(0.8, 1.8)


def motion(t_ns: int, speed_mps: float = 0.0, yaw_rate_radps: float = 0.0) -> Motion:
    return Motion(t_ns=t_ns, speed_mps=speed_mps, yaw_rate_radps=yaw_rate_radps)


def replayed(pipeline: Pipeline, drive: list[Seen], from_ns: int = 0) -> list[LaneEstimate]:
    return [
        pipeline.step(Frame(t_ns=s.frame.t_ns + from_ns, index=s.frame.index, image=s.frame.image), s.motion)
        for s in drive
    ]


def go_dark(pipeline: Pipeline, drive: list[Seen], frames: int, speed_mps: float) -> list[LaneEstimate]:
    last_ns = drive[-1].frame.t_ns
    reported = []
    for k in range(1, frames + 1):
        t_ns = last_ns + k * PERIOD_NS
        reported.append(pipeline.step(Frame(t_ns=t_ns, index=100 + k, image=BLACK), motion(t_ns, speed_mps)))
        check_sound(reported[-1], t_ns)
    return reported


def test_a_reflection_is_neither_looked_at_nor_followed(seen: list[Seen], monkeypatch: pytest.MonkeyPatch) -> None:
    pipeline, looked = Windows(CAR), []
    replayed(pipeline, seen)
    monkeypatch.setattr(pipeline._reflections, "step", lambda view, lines, paint: np.zeros_like(lines))
    monkeypatch.setattr(pipeline._tracking, "looks_around", lambda followed: True)
    monkeypatch.setattr(pipeline._tracking, "judge", lambda lines, followed: looked.append(len(lines)))
    replayed(pipeline, seen[-1:], from_ns=PERIOD_NS)
    assert looked == [0]
    monkeypatch.setattr(pipeline._reflections, "any_points_to_camera", lambda *lines: True)
    assert replayed(pipeline, seen[-1:], from_ns=2 * PERIOD_NS)[0].status is LaneStatus.COASTING


def test_a_lane_that_the_odometry_lost_leaves_no_points_behind(
    seen: list[Seen], monkeypatch: pytest.MonkeyPatch
) -> None:
    pipeline = Windows(CAR)
    replayed(pipeline, seen)
    assert len(pipeline._tracker._memory)
    predict = pipeline._tracking.predict

    def lost(frame: Frame, motion: Motion) -> FrameMotion | None:
        moved = predict(frame, motion)
        pipeline._tracking.forget()
        return moved

    monkeypatch.setattr(pipeline._tracking, "predict", lost)
    monkeypatch.setattr(pipeline._tracking, "start", lambda t_ns, lines: None)
    monkeypatch.setattr(pipeline._gentle, "step", lambda image: None)
    assert replayed(pipeline, seen[-1:], from_ns=PERIOD_NS)[0].status is LaneStatus.LOST
    assert not len(pipeline._tracker._memory)


def bits(estimate: LaneEstimate) -> tuple[object, ...]:
    """Everything that an estimate says, to be compared for equality."""
    numbers: list[bytes] = []
    if estimate.pose is not None and estimate.left is not None and estimate.right is not None:
        pose = estimate.pose
        assert estimate.centerline is not None
        along = np.linspace(0.0, estimate.centerline.length_m, 7)
        fields = (pose.offset_m, pose.heading_rad, pose.width_m, pose.curvature_per_m)
        numbers = [np.array(fields).tobytes(), pose.covariance.tobytes()]
        numbers += [estimate.left.points_m.tobytes(), estimate.right.points_m.tobytes()]
        numbers += [estimate.centerline.position(along).tobytes()]
    return (estimate.t_ns, estimate.status, estimate.frame_age_ns, estimate.crossing, *numbers)


def test_the_same_frames_give_the_same_bits(seen: list[Seen]) -> None:
    first = [bits(e) for e in replayed(Windows(CAR), seen)]
    assert first == [bits(e) for e in replayed(Windows(CAR), seen)]
    assert first == [bits(s.estimate) for s in seen]


def test_reset_forgets_everything(seen: list[Seen]) -> None:
    pipeline = Windows(CAR)
    replayed(pipeline, seen[::-1], 10**12)
    go_dark(pipeline, seen, 5, 1.0)
    pipeline.reset()
    assert [bits(e) for e in replayed(pipeline, seen)] == [bits(s.estimate) for s in seen]


def test_the_frames_are_left_alone(seen: list[Seen]) -> None:
    before = seen[3].frame.image.copy()
    replayed(Windows(CAR), seen[:5])
    np.testing.assert_array_equal(seen[3].frame.image, before)


def test_a_dark_picture_is_coasted_over_for_a_while(seen: list[Seen]) -> None:
    pipeline, options = Windows(CAR), CAR.pipeline.windows
    last = replayed(pipeline, seen)[-1]
    assert last.status is LaneStatus.TRACKING
    assert last.frame_age_ns == 0
    reported = go_dark(pipeline, seen, 90, 1.0)
    coasting = [e for e in reported if e.valid]
    assert all(e.status is LaneStatus.COASTING for e in coasting)
    assert reported[: len(coasting)] == coasting  # once lost, lost for good
    assert len(reported) > len(coasting)
    bound_s = min(options.coast_s, options.coast_lanes * 0.4 / 1.0)
    assert len(coasting) * PERIOD_NS * 1e-9 == pytest.approx(bound_s, abs=0.1)
    for k, estimate in enumerate(coasting, 1):
        assert estimate.frame_age_ns == k * PERIOD_NS
        assert estimate.left is not None
        assert not estimate.left.seen
    assert last.pose is not None
    moved = coasting[5].pose
    assert moved is not None
    distance = 6 * PERIOD_NS * 1e-9
    assert moved.heading_rad == pytest.approx(last.pose.heading_rad, abs=0.02)  # no turn on a straight road
    assert moved.offset_m == pytest.approx(last.pose.offset_m + distance * np.sin(last.pose.heading_rad), abs=0.004)


def test_coasting_is_bounded_in_time_where_the_car_stands(seen: list[Seen]) -> None:
    pipeline = Windows(CAR)
    replayed(pipeline, seen)
    reported = go_dark(pipeline, seen, 90, 0.0)
    assert sum(e.valid for e in reported) * PERIOD_NS * 1e-9 == pytest.approx(CAR.pipeline.windows.coast_s, abs=0.1)


def test_age_goes_on_growing_once_lost(seen: list[Seen]) -> None:
    pipeline = Windows(CAR)
    replayed(pipeline, seen)
    reported = go_dark(pipeline, seen, 90, 1.0)
    ages = [e.frame_age_ns for e in reported]
    assert not reported[-1].valid
    assert ages == [k * PERIOD_NS for k in range(1, 91)]


def test_the_lane_is_found_again(seen: list[Seen]) -> None:
    pipeline = Windows(CAR)
    replayed(pipeline, seen)
    assert not go_dark(pipeline, seen, 90, 1.0)[-1].valid
    again = replayed(pipeline, seen, 10**11)
    assert all(e.status is LaneStatus.TRACKING for e in again[2:])
    for estimate, s in zip(again[10:], seen[10:], strict=True):
        assert estimate.pose is not None
        assert estimate.pose.offset_m == pytest.approx(s.truth.offset_m, abs=0.01)


def test_a_gap_in_time_starts_again(seen: list[Seen]) -> None:
    pipeline = Windows(CAR)
    replayed(pipeline, seen)
    for jump_ns in (-(10**10), 10**10):
        t_ns = seen[-1].frame.t_ns + jump_ns
        assert not pipeline.step(Frame(t_ns=t_ns, index=0, image=BLACK), motion(t_ns, 1.0)).valid


def test_a_car_that_stands_keeps_its_lane(seen: list[Seen]) -> None:
    pipeline = Windows(CAR)
    last = seen[-1]
    replayed(pipeline, seen)
    for k in range(1, 60):
        t_ns = last.frame.t_ns + k * PERIOD_NS
        estimate = pipeline.step(Frame(t_ns=t_ns, index=100 + k, image=last.frame.image), motion(t_ns))
        assert estimate.status is LaneStatus.TRACKING
        assert estimate.pose is not None
        assert estimate.pose.offset_m == pytest.approx(last.truth.offset_m, abs=0.01)
        assert estimate.pose.heading_rad == pytest.approx(last.truth.heading_rad, abs=0.02)


@pytest.mark.parametrize("shape", [(240, 320), (360, 641), (1, 1), (720, 1280, 3), (640, 360)])
def test_pictures_of_another_size_are_no_lane(seen: list[Seen], shape: tuple[int, ...]) -> None:
    pipeline = Windows(CAR)
    replayed(pipeline, seen)
    t_ns = seen[-1].frame.t_ns + PERIOD_NS
    estimate = pipeline.step(Frame(t_ns=t_ns, index=99, image=np.zeros(shape, np.uint8)), motion(t_ns, 1.0))
    check_sound(estimate, t_ns)
    assert not estimate.valid
    t_ns += PERIOD_NS
    right = pipeline.step(Frame(t_ns=t_ns, index=100, image=seen[-1].frame.image), motion(t_ns))
    check_sound(right, t_ns)
    assert right.valid


@st.composite
def pictures(draw: st.DrawFn) -> np.ndarray:
    rng = np.random.default_rng(draw(st.integers(0, 2**31)))
    kind = draw(st.sampled_from(("noise", "specks", "black", "white", "stripes", "blocks", "colour", "small", "ramp")))
    if kind == "black":
        return BLACK
    if kind == "white":
        return np.full(SIZE, 255, np.uint8)
    if kind == "stripes":
        angle, period = rng.uniform(0.0, np.pi), rng.uniform(8.0, 200.0)
        v, u = np.mgrid[: SIZE[0], : SIZE[1]]
        return np.where(np.sin((u * np.cos(angle) + v * np.sin(angle)) * np.pi / period) > 0.6, 255, 20).astype(
            np.uint8
        )
    if kind == "blocks":
        small = rng.integers(0, 256, (9, 16), dtype=np.uint8)
        return np.kron(small, np.ones((40, 40), np.uint8))
    if kind == "specks":
        return np.where(rng.random(SIZE) < 0.02, 255, 0).astype(np.uint8)
    if kind == "colour":
        return rng.integers(0, 256, (*SIZE, 3), dtype=np.uint8)
    if kind == "small":
        return rng.integers(0, 256, tuple(rng.integers(1, 50, 2)), dtype=np.uint8)
    if kind == "ramp":
        return np.tile(np.linspace(0, 255, SIZE[1]).astype(np.uint8), (SIZE[0], 1))
    return rng.integers(0, 256, SIZE, dtype=np.uint8)


STEPS = st.tuples(
    st.one_of(st.none(), pictures()),  # None: a good image
    st.sampled_from([0, 1, 16_666_667, 33_333_333, 400_000_000, 10**10, -(10**8), -(10**12)]),
    st.one_of(st.floats(-5.0, 5.0), st.sampled_from([0.0, 1.0, 100.0, -100.0])),
    st.one_of(st.floats(-5.0, 5.0), st.sampled_from([0.0, 50.0, -400.0, 1e6])),
    st.sampled_from(list(MotionSource)),
)


@settings(max_examples=40, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(steps=st.lists(STEPS, min_size=4, max_size=16))
def test_nothing_a_camera_or_gyro_says_raises_or_gives_nan(
    seen: list[Seen], steps: list[tuple[np.ndarray | None, int, float, float, MotionSource]]
) -> None:
    pipeline = Windows(CAR)
    t_ns = 10**13
    replayed(pipeline, seen[:3], t_ns)
    for index, (picture, dt_ns, speed, yaw_rate, source) in enumerate(steps):
        t_ns += dt_ns
        image = seen[index].frame.image if picture is None else picture
        moved = Motion(t_ns=t_ns, speed_mps=speed, yaw_rate_radps=yaw_rate, source=source)
        check_sound(pipeline.step(Frame(t_ns=t_ns, index=index, image=image), moved), t_ns)


def test_stages_are_timed_by_the_stopwatch_alone(seen: list[Seen]) -> None:
    pipeline = Windows(CAR)
    replayed(pipeline, seen[:2])
    assert pipeline.stages.durations_ns == {}
    ticks = iter(range(0, 10**9, 7))
    pipeline.stages.stopwatch = lambda: next(ticks)
    replayed(pipeline, seen[2:4])
    assert set(pipeline.stages.durations_ns.values()) <= {7, 14, 21}
    assert {"birdseye", "white_areas", "windows", "lane_fit"} <= set(pipeline.stages.durations_ns)


def test_a_camera_that_sees_no_ground_is_refused() -> None:
    with pytest.raises(ConfigError, match="pitch_rad"):
        make_pipeline("windows", with_camera(camera(pitch_rad=-1.2)))
    with pytest.raises(ConfigError, match="expected one of centerline, windows"):
        make_pipeline("window", CAR)
