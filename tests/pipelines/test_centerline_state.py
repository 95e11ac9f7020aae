"""`centerline` over time: starting, coasting, loss, reset, and whatever a camera, a mask or a gyro may say."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from automodel.pipelines.centerline import Centerline
from automodel.signals import Frame, LaneEstimate, LaneStatus, Motion, MotionSource
from automodel.sim.truth import Truth
from automodel.types import Image
from tests.support.masked_drives import PERIOD_NS, GivenMarkings, MaskedDrive, arc, bits, gap, line, road
from tests.support.rendered_drives import CAR, check_sound
from tests.support.slow_lane import rest_slow

SIZE = (CAR.camera.height_px, CAR.camera.width_px)
BLANK = np.zeros(SIZE, np.uint8)
OPTIONS = CAR.pipeline.centerline


@dataclass(frozen=True, kw_only=True)
class Shown:
    """A frame whose mask is known."""

    frame: Frame
    motion: Motion
    mask: Image
    truth: Truth

    def __repr__(self) -> str:  # short, for failures
        return f"Shown({self.frame.t_ns})"


def shown(drive: MaskedDrive, from_m: float, to_m: float) -> list[Shown]:
    made = []
    for frame, motion, pose in drive.frames(from_m, to_m):
        drive.oracle.pose = pose
        mask = drive.oracle.step(frame.image)
        truth = drive.follower.step(pose.x_m, pose.y_m, pose.yaw_rad)
        made.append(Shown(frame=frame, motion=motion, mask=mask, truth=truth))
    return made


@pytest.fixture(scope="module")
def both() -> list[Shown]:
    """A metre of a straight lane."""
    return shown(MaskedDrive(track=road(line(6.0))), 0.8, 1.8)


@pytest.fixture(scope="module")
def single() -> list[Shown]:
    """The same with the left line alone."""
    return shown(MaskedDrive(track=road(line(6.0), gap(0.0, 6.0, "right"))), 0.8, 1.8)


class Car:
    """`centerline` fed by hand; every estimate is checked to be sound."""

    def __init__(self) -> None:
        self.markings = GivenMarkings(SIZE)
        self.pipeline = Centerline(CAR, self.markings)
        self.t_ns = 0

    def see(self, mask: Image, dt_ns: int = PERIOD_NS, speed_mps: float = 1.0, image: Image = BLANK) -> LaneEstimate:
        """One frame `dt_ns` after the last."""
        self.t_ns += dt_ns
        self.markings.mask = mask
        motion = Motion(t_ns=self.t_ns, speed_mps=speed_mps, yaw_rate_radps=0.0)
        return self.step(Frame(t_ns=self.t_ns, index=0, image=image), motion)

    def step(self, frame: Frame, motion: Motion) -> LaneEstimate:
        estimate = self.pipeline.step(frame, motion)
        check_sound(estimate, frame.t_ns)
        return estimate

    def replay(self, drive: list[Shown], from_ns: int = 0) -> list[LaneEstimate]:
        """The frames as they were, their times `from_ns` later."""
        reported = []
        for one in drive:
            self.t_ns = one.frame.t_ns + from_ns
            self.markings.mask = one.mask
            reported.append(self.step(Frame(t_ns=self.t_ns, index=0, image=one.frame.image), one.motion))
        return reported


def statuses(estimates: list[LaneEstimate]) -> list[LaneStatus]:
    return [estimate.status for estimate in estimates]


def check_lone(estimates: list[LaneEstimate]) -> None:
    """A line alone is a lane from its second frame on at the latest, with a bound that fills the lane."""
    assert estimates[0].status in (LaneStatus.LOST, LaneStatus.ONE_LINE)
    assert all(estimate.status is LaneStatus.ONE_LINE for estimate in estimates[1:])
    for estimate in estimates[1:]:
        assert estimate.pose is not None
        assert estimate.pose.offset_bound_m >= estimate.pose.width_m


def test_the_first_frame_with_two_lines_tells_the_lane(both: list[Shown]) -> None:
    first = Car().replay(both[:1])[0]
    assert first.status is LaneStatus.TRACKING
    assert first.frame_age_ns == 0
    assert first.pose is not None
    assert first.pose.offset_m == pytest.approx(both[0].truth.offset_m, abs=0.02)
    assert first.pose.heading_rad == pytest.approx(both[0].truth.heading_rad, abs=0.05)


def test_a_lane_of_one_line_is_told_with_a_bound_that_fills_the_lane(single: list[Shown]) -> None:
    reported = Car().replay(single[:8])
    check_lone(reported)
    for estimate, one in zip(reported[4:], single[4:], strict=False):
        assert estimate.pose is not None
        assert estimate.pose.offset_m == pytest.approx(one.truth.offset_m, abs=0.02)


def test_no_line_is_no_lane() -> None:
    car = Car()
    for fill in (0, 126, 127, 255):
        estimate = car.see(np.full(SIZE, fill, np.uint8))
        assert estimate.status is LaneStatus.LOST


def test_coasting_is_bounded_in_way(both: list[Shown]) -> None:
    car = Car()
    last = car.replay(both)[-1]
    reported = [car.see(BLANK) for _ in range(90)]
    coasting = [e for e in reported if e.valid]
    assert set(statuses(coasting)) == {LaneStatus.COASTING}
    assert reported[: len(coasting)] == coasting  # once lost, lost for good
    assert len(coasting) * PERIOD_NS * 1e-9 == pytest.approx(OPTIONS.coast_lanes * CAR.lane.width_m, abs=0.04)
    assert [e.frame_age_ns for e in reported] == [k * PERIOD_NS for k in range(1, 91)]  # it goes on growing
    assert last.pose is not None
    moved = coasting[14].pose
    assert moved is not None
    assert moved.heading_rad == pytest.approx(last.pose.heading_rad, abs=0.03)  # no turn on a straight road
    assert moved.offset_m == pytest.approx(last.pose.offset_m + 0.5 * np.sin(last.pose.heading_rad), abs=0.01)
    bounds = [(e.pose.offset_bound_m, e.pose.heading_bound_rad) for e in coasting if e.pose]
    assert (np.diff(bounds, axis=0) > 0.0).all()


def test_coasting_is_bounded_in_time_where_the_car_stands(both: list[Shown]) -> None:
    car = Car()
    car.replay(both)
    reported = [car.see(BLANK, speed_mps=0.0) for _ in range(90)]
    assert sum(e.valid for e in reported) * PERIOD_NS * 1e-9 == pytest.approx(OPTIONS.coast_s, abs=0.04)


def test_coasting_backwards_is_bounded_too(both: list[Shown]) -> None:
    car = Car()
    car.replay(both)
    reported = [car.see(BLANK, speed_mps=-1.0) for _ in range(90)]
    most = OPTIONS.coast_lanes * CAR.lane.width_m
    assert sum(e.valid for e in reported) * PERIOD_NS * 1e-9 <= most + 0.04


def test_the_lane_is_found_again(both: list[Shown]) -> None:
    car = Car()
    car.replay(both)
    assert not [car.see(BLANK) for _ in range(90)][-1].valid
    again = car.replay(both, 10**11)
    assert set(statuses(again)) == {LaneStatus.TRACKING}
    for estimate, one in zip(again[10:], both[10:], strict=True):
        assert estimate.pose is not None
        assert estimate.pose.offset_m == pytest.approx(one.truth.offset_m, abs=0.005)


def test_a_car_that_stands_keeps_its_lane(both: list[Shown]) -> None:
    car = Car()
    car.replay(both)
    for _ in range(40):
        estimate = car.see(both[-1].mask, speed_mps=0.0)
        assert estimate.status is LaneStatus.TRACKING
        assert estimate.pose is not None
        assert estimate.pose.offset_m == pytest.approx(both[-1].truth.offset_m, abs=0.01)
        assert estimate.pose.heading_rad == pytest.approx(both[-1].truth.heading_rad, abs=0.02)


def test_a_car_that_was_carried_to_one_side_finds_its_lane(both: list[Shown]) -> None:
    """While the camera was covered, 6 cm to the left, which the odometry does not know of."""
    drive = MaskedDrive(track=road(line(6.0)), offset=lambda s: 0.15)
    moved = shown(drive, 0.8, 2.4)
    car = Car()
    car.replay(both)
    for _ in range(20):
        car.see(BLANK, speed_mps=0.0)
    reported = [car.see(one.mask) for one in moved]
    assert reported[-1].status is LaneStatus.TRACKING
    assert reported[-1].pose is not None
    assert reported[-1].pose.offset_m == pytest.approx(moved[-1].truth.offset_m, abs=0.01)


@pytest.mark.parametrize("jump_ns", [-(10**10), -1, 0, 500_000_001, 10**10])
def test_time_that_goes_back_and_gaps_start_again(both: list[Shown], single: list[Shown], jump_ns: int) -> None:
    car = Car()
    car.replay(both)
    assert car.see(BLANK, jump_ns).status is LaneStatus.LOST
    car = Car()
    car.replay(both)
    reported = [car.see(single[0].mask, jump_ns)] + [car.see(one.mask) for one in single[1:5]]
    check_lone(reported)


def test_half_a_second_is_no_gap(both: list[Shown]) -> None:
    car = Car()
    car.replay(both)
    assert car.see(BLANK, 500_000_000, speed_mps=0.5).status is LaneStatus.COASTING


@pytest.mark.parametrize("shape", [(240, 320), (360, 641), (1, 1), (720, 1280, 3), (640, 360)])
def test_images_of_another_size_are_no_lane(both: list[Shown], shape: tuple[int, ...]) -> None:
    car = Car()
    car.replay(both)
    odd = np.zeros(shape, np.uint8)
    assert car.see(both[-1].mask, image=odd, speed_mps=0.0).status is LaneStatus.LOST
    assert car.see(both[-1].mask, speed_mps=0.0).status is LaneStatus.TRACKING
    fresh = Car()
    assert fresh.see(both[0].mask, image=odd).status is LaneStatus.LOST
    assert fresh.see(both[0].mask).status is LaneStatus.TRACKING


def test_blind_time_counts_images_of_another_size(both: list[Shown]) -> None:
    car = Car()
    car.replay(both)
    for _ in range(90):
        car.see(both[-1].mask, image=np.zeros((10, 10), np.uint8), speed_mps=0.0)
    assert car.see(BLANK, speed_mps=0.0).status is LaneStatus.LOST


def spoilt(kind: str, rng: np.random.Generator) -> Image:
    """A mask that shows no lane."""
    if kind == "full":
        return np.full(SIZE, 255, np.uint8)
    if kind == "noise":
        return rng.integers(0, 256, SIZE, dtype=np.uint8)
    if kind == "specks":
        return np.where(rng.random(SIZE) < 0.02, 255, 0).astype(np.uint8)
    if kind == "stripes":
        angle, period = rng.uniform(0.0, np.pi), rng.uniform(8.0, 200.0)
        v, u = np.mgrid[: SIZE[0], : SIZE[1]]
        return np.where(np.sin((u * np.cos(angle) + v * np.sin(angle)) * np.pi / period) > 0.6, 255, 0).astype(np.uint8)
    if kind == "blocks":
        return np.kron(rng.integers(0, 256, (9, 16), dtype=np.uint8), np.ones((40, 40), np.uint8))
    if kind == "lines":
        mask = BLANK.copy()
        for _ in range(int(rng.integers(1, 8))):
            begin, end = (tuple(map(int, rng.integers(-100, 700, 2))) for _ in range(2))
            cv2.line(mask, begin, end, 255, int(rng.integers(1, 30)))
        return mask
    if kind == "one pixel":
        return np.full((1, 1), 255, np.uint8)
    return BLANK


KINDS = ("blank", "full", "noise", "specks", "stripes", "blocks", "lines", "one pixel")


@pytest.mark.parametrize("kind", ["blank", "full", "noise", "one pixel"])
def test_masks_of_nothing_are_lost_and_coasted_over(both: list[Shown], kind: str) -> None:
    rng = np.random.default_rng(3)
    fresh = Car()
    assert {fresh.see(spoilt(kind, rng)).status for _ in range(6)} == {LaneStatus.LOST}
    car = Car()
    car.replay(both)
    reported = [car.see(spoilt(kind, rng)) for _ in range(80)]
    assert reported[-1].status is LaneStatus.LOST
    for estimate in reported[:15]:
        if estimate.pose is not None:
            assert abs(estimate.pose.offset_m - both[-1].truth.offset_m) < 0.1


@pytest.mark.parametrize("size", [(128, 256), (256, 512), (720, 1280)])
def test_masks_of_any_size_are_the_whole_image(both: list[Shown], size: tuple[int, int]) -> None:
    car = Car()
    method = cv2.INTER_AREA
    reported = car.replay(
        [replace(s, mask=np.asarray(cv2.resize(s.mask, size[::-1], interpolation=method))) for s in both[:20]]
    )
    assert set(statuses(reported)) == {LaneStatus.TRACKING}
    assert reported[-1].pose is not None
    assert reported[-1].pose.offset_m == pytest.approx(both[19].truth.offset_m, abs=0.006)


def test_the_same_frames_give_the_same_bits(both: list[Shown]) -> None:
    first = [bits(e) for e in Car().replay(both)]
    assert len(set(first)) == len(first)
    assert first == [bits(e) for e in Car().replay(both)]


def test_reset_forgets_everything(both: list[Shown], single: list[Shown]) -> None:
    car = Car()
    car.replay(single, 10**12)
    car.replay(both[::-1], 2 * 10**12)
    [car.see(BLANK) for _ in range(5)]
    car.pipeline.reset()
    assert [bits(e) for e in car.replay(both)] == [bits(e) for e in Car().replay(both)]
    car.pipeline.reset()
    check_lone(car.replay(single[:5]))


class Keeping(GivenMarkings):
    """Keeps what it was given."""

    def step(self, grey: Image) -> Image:
        self.grey = grey
        return super().step(grey)


def test_colour_frames_are_turned_grey(both: list[Shown]) -> None:
    markings = Keeping(SIZE)
    pipeline = Centerline(CAR, markings)
    markings.mask = both[0].mask
    image = np.random.default_rng(1).integers(0, 256, (*SIZE, 3), dtype=np.uint8)
    before, mask_before = image.copy(), both[0].mask.copy()
    estimate = pipeline.step(Frame(t_ns=5, index=0, image=image), both[0].motion)
    assert estimate.status is LaneStatus.TRACKING
    assert markings.grey.dtype == np.uint8
    assert markings.grey.shape == SIZE
    weighted = image.astype(float) @ (0.114, 0.587, 0.299)
    assert np.abs(markings.grey - weighted).max() <= 1.0
    np.testing.assert_array_equal(image, before)
    np.testing.assert_array_equal(both[0].mask, mask_before)


def test_stages_are_timed_by_the_stopwatch_alone(both: list[Shown]) -> None:
    car = Car()
    car.replay(both[:2])
    assert car.pipeline.stages.durations_ns == {}
    ticks = iter(range(0, 10**9, 7))
    car.pipeline.stages.stopwatch = lambda: next(ticks)
    car.replay(both[2:4])
    assert set(car.pipeline.stages.durations_ns) == {
        "prediction",
        "markings",
        "birdseye",
        "following",
        "estimation",
        "estimate",
    }
    assert set(car.pipeline.stages.durations_ns.values()) == {7}


STEPS = st.tuples(
    st.one_of(st.none(), st.sampled_from(KINDS)),  # None: a good mask
    st.integers(0, 2**31),
    st.sampled_from([0, 1, 16_666_667, 33_333_333, 33_333_333, 400_000_000, 10**10, -(10**8), -(10**12)]),
    st.one_of(st.floats(-5.0, 5.0), st.sampled_from([0.0, 1.0, 1.0, 100.0, -100.0, 1e9])),
    st.one_of(st.floats(-5.0, 5.0), st.sampled_from([0.0, 0.0, 50.0, -400.0, 1e6])),
    st.sampled_from(list(MotionSource)),
)


@pytest.mark.parametrize(
    ("speed_mps", "yaw_rate_radps"),
    [(1e30, 0.0), (-1e300, 1.0), (0.0, 1e300), (np.inf, 0.0), (np.nan, 0.0), (0.0, -np.inf), (1.0, np.nan)],
)
@pytest.mark.parametrize("blank", [False, True])
def test_motion_that_cannot_be(both: list[Shown], speed_mps: float, yaw_rate_radps: float, blank: bool) -> None:
    car = Car()
    car.replay(both[:5])
    for one in both[5:9]:
        t_ns = one.frame.t_ns
        car.markings.mask = BLANK if blank else one.mask
        moved = Motion(t_ns=t_ns, speed_mps=speed_mps, yaw_rate_radps=yaw_rate_radps)
        car.step(Frame(t_ns=t_ns, index=0, image=BLANK), moved)
    assert car.replay(both[9:])[-1].status is LaneStatus.TRACKING


@settings(max_examples=30, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(steps=st.lists(STEPS, min_size=4, max_size=16))
def test_nothing_a_mask_or_gyro_says_raises_or_gives_nan(
    both: list[Shown], steps: list[tuple[str | None, int, int, float, float, MotionSource]]
) -> None:
    car = Car()
    t_ns = 10**13
    car.replay(both[:3], t_ns)
    for index, (kind, seed, dt_ns, speed, yaw_rate, source) in enumerate(steps):
        t_ns += dt_ns
        car.markings.mask = both[index].mask if kind is None else spoilt(kind, np.random.default_rng(seed))
        moved = Motion(t_ns=t_ns, speed_mps=speed, yaw_rate_radps=yaw_rate, source=source)
        car.step(Frame(t_ns=t_ns, index=index, image=BLANK), moved)


@pytest.mark.parametrize("seed", rest_slow(range(6), 0, 1))
def test_good_frames_among_bad_ones_are_taken(both: list[Shown], seed: int) -> None:
    """After masks in which there is no line, good frames tell the lane again, also of a car at rest."""
    rng = np.random.default_rng(seed)
    car = Car()
    for kind in rng.choice(["blank", "full", "noise", "specks", "one pixel"], 10):
        car.see(spoilt(kind, rng))
    for _ in range(90):
        last = car.see(both[-1].mask, speed_mps=0.0)
    assert last.status is LaneStatus.TRACKING
    assert last.pose is not None
    assert last.pose.offset_m == pytest.approx(both[-1].truth.offset_m, abs=0.015)
    assert last.pose.heading_rad == pytest.approx(both[-1].truth.heading_rad, abs=0.06)  # seen only from afar


def test_a_bend_is_coasted_through() -> None:
    drive = MaskedDrive(track=road(line(2.0), arc(1.2, 2.5)))
    frames = shown(drive, 1.4, 3.4)
    car = Car()
    car.replay(frames[:40])
    for one in frames[40:50]:
        car.markings.mask = BLANK
        estimate = car.step(one.frame, one.motion)
        assert estimate.status is LaneStatus.COASTING
        assert estimate.pose is not None
        assert estimate.pose.offset_m == pytest.approx(one.truth.offset_m, abs=0.03)
        assert estimate.pose.heading_rad == pytest.approx(one.truth.heading_rad, abs=0.12)
