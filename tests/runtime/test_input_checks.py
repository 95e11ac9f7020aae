"""What the checks say of a camera, a lane and a servo that are not well; and of those that are nothing."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from automodel.config import CameraConfig, CarConfig, PipelineConfig, SecondCamera, VehicleConfig
from automodel.curves import line
from automodel.runtime.input_checks import (
    FLAT_LEVELS,
    KEPT_S,
    ImageCheck,
    InputChecks,
    LaneJumpCheck,
    OffsetBoundCheck,
    SteeringCheck,
    contrast,
    width_fault,
)
from automodel.runtime.loop import Loop
from automodel.signals import (
    Frame,
    LaneEstimate,
    LanePose,
    LaneStatus,
    Motion,
    MotionSource,
    StereoFrame,
    VehicleState,
)
from tests.support.runner_fakes import MS, FakeController, FakeLimits, FakePipeline

CAR = dataclasses.replace(CarConfig(), camera=CameraConfig(width_px=160, height_px=90))
VEHICLE = VehicleConfig(width_m=0.2)  # 0.1 m free on either side in a lane of 0.4 m
MOTION = Motion(t_ns=0, speed_mps=1.0, yaw_rate_radps=0.0)
RNG = np.random.default_rng(0)
NOISY = [np.tile(np.linspace(20, 220, 160), (90, 1)) + RNG.normal(0, 2, (90, 160)) for _ in range(20)]
ROAD = [picture.clip(0, 255).astype(np.uint8) for picture in NOISY]


def make(at: dict[int, object] | None = None) -> tuple[Loop, FakePipeline]:
    pipeline = FakePipeline(at)
    return Loop(pipeline, FakeController(), FakeLimits(), validity_s=0.1, checks=InputChecks(CAR)), pipeline


def tick(loop: Loop, index: int, image: np.ndarray):
    frame = Frame(t_ns=index * 16 * MS, index=index, image=image)
    return loop.tick(frame, MOTION, None, frame.t_ns + 3 * MS)


def test_a_frame_of_another_size_never_reaches_the_pipeline() -> None:
    loop, pipeline = make()
    assert tick(loop, 0, ROAD[0]).faults == ()
    wrong = tick(loop, 1, ROAD[1][::2])
    assert wrong.estimate.status is LaneStatus.LOST
    assert wrong.faults == ("the image has 160x45 pixels; the camera has 160x90",)
    assert wrong.command.speed_mps == 0.0
    assert [frame.index for frame in pipeline.seen] == [0]
    assert tick(loop, 2, ROAD[2]).faults == ()


def test_a_fault_is_reported_beside_an_unchanged_estimate() -> None:
    loop, pipeline = make()
    ticks = [tick(loop, index, ROAD[0]) for index in range(6)]
    assert [len(each.faults) for each in ticks] == [0, 0, 0, 0, 1, 1]
    assert {each.estimate.status for each in ticks} == {LaneStatus.TRACKING}
    assert len(pipeline.seen) == 6


def test_a_lane_that_jumps_is_reported_in_its_tick() -> None:
    loop, _ = make({3: 0.3})
    faults = [tick(loop, index, ROAD[index]).lane_faults for index in range(5)]
    assert faults == [(), (), (), ("the lane has jumped sideways by 0.30 m",), ()]


def test_an_exception_of_the_pipeline_makes_nobody_forget_the_last_lane() -> None:
    loop, _ = make({1: 0.3})
    tick(loop, 0, ROAD[0])
    loop.reset()
    assert tick(loop, 1, ROAD[1]).lane_faults != ()


def test_both_pictures_of_a_pair_are_looked_at() -> None:
    checks = InputChecks(CAR)

    def of_pair(index: int, left: np.ndarray, right: np.ndarray) -> tuple[str, ...]:
        pair = StereoFrame(t_ns=index * 16 * MS, index=index, left=left, right=right)
        return checks.of_frame(pair, pair)

    found = [of_pair(index, ROAD[index], ROAD[0]) for index in range(6)]
    assert [len(texts) for texts in found] == [0, 0, 0, 0, 1, 1]
    pair = StereoFrame(t_ns=0, index=0, left=ROAD[0], right=ROAD[0][::2])
    assert checks.misfit(pair) is not None
    assert checks.misfit(Frame(t_ns=0, index=0, image=ROAD[0][::2], eye=1)) is not None


@pytest.mark.parametrize("bad", [0, 1])
def test_while_one_eye_is_seen_alone_the_other_one_s_images_are_not_asked_for(bad: int) -> None:
    """And once neither is good, as many bad pairs as of a single camera are as many that were dropped."""
    checks = InputChecks(CAR)
    dark = np.zeros((90, 160), np.uint8)

    def of_pair(index: int, good: np.ndarray, alone: bool) -> tuple[str, ...]:
        images = (good, dark) if bad else (dark, good)
        pair = StereoFrame(t_ns=index * 16 * MS, index=index, left=images[0], right=images[1])
        seen = Frame(t_ns=pair.t_ns, index=index, image=good, eye=1 - bad) if alone else pair
        return checks.of_frame(pair, seen)

    assert [of_pair(index, ROAD[index], True) for index in range(20)] == [()] * 20
    found = [of_pair(index, ROAD[19], False) for index in range(20, 26)]
    assert [len(texts) for texts in found] == [0, 0, 0, 2, 2, 2]
    assert set(found[3]) == {"the image is blank for 0.064 s", "the camera repeats the same image for 0.064 s"}


def test_images_that_were_not_taken_together_are_a_fault_also_where_one_is_seen_alone() -> None:
    camera = dataclasses.replace(CAR.camera, right=SecondCamera(pair_tolerance_s=0.004))
    checks = InputChecks(dataclasses.replace(CAR, camera=camera))
    pair = StereoFrame(t_ns=0, index=0, left=ROAD[0], right=ROAD[1], right_late_ns=-17 * MS)
    assert len(checks.of_frame(pair, Frame(t_ns=0, index=0, image=ROAD[1], eye=1))) == 1


def test_images_of_a_pair_that_were_not_taken_together_are_a_fault_where_that_lasts() -> None:
    """One such pair is as one that was dropped: [safety] frame_timeout_s counts from the last good one."""
    camera = dataclasses.replace(CAR.camera, right=SecondCamera(pair_tolerance_s=0.004))
    checks = InputChecks(dataclasses.replace(CAR, camera=camera))

    def of_pair(index: int, late_ms: int) -> tuple[str, ...]:
        left, right = ROAD[index], ROAD[19 - index]
        pair = StereoFrame(t_ns=index * 16 * MS, index=index, left=left, right=right, right_late_ns=late_ms * MS)
        return checks.of_frame(pair, pair)

    assert [of_pair(index, (4, -4, 0)[index]) for index in range(3)] == [()] * 3
    found = [of_pair(index, (-5, 17)[index % 2]) for index in range(3, 8)]
    assert [len(texts) for texts in found] == [0, 0, 0, 1, 1]
    assert found[-1] == ("the images of a pair were taken 17.0 ms apart (limit 4)",)
    assert of_pair(8, 1) == ()


def test_a_pair_s_tolerance_follows_the_rate_and_without_a_second_camera_any_times_do() -> None:
    two = dataclasses.replace(CAR, camera=dataclasses.replace(CAR.camera, rate_hz=50.0, right=SecondCamera()))
    for late_ms, car, faults in ((5, two, 0), (6, two, 1), (6, CAR, 0)):
        pair = StereoFrame(t_ns=0, index=0, left=ROAD[0], right=ROAD[1], right_late_ns=late_ms * MS)
        assert len(InputChecks(car).of_frame(pair, pair)) == faults


def test_an_image_of_the_right_camera_alone_is_compared_with_its_own() -> None:
    checks, found = InputChecks(CAR), []
    for index in range(12):  # the left camera's images change, and between them the right one repeats its own
        image = ROAD[0] if index % 2 else ROAD[index // 2]
        frame = Frame(t_ns=index * 16 * MS, index=index, image=image, eye=index % 2)
        found.append(checks.of_frame(frame, frame))
    assert found[:5] == [()] * 5
    assert found[-1] == ("the camera repeats the same image for 0.160 s",)


PERIOD_NS = 16_666_667
HEIGHT, WIDTH = CAR.camera.height_px, CAR.camera.width_px


def road(seed: int = 0, noise: float = 2.0) -> np.ndarray:
    """A bright line on a dark floor, with a sensor's noise."""
    picture = np.full((HEIGHT, WIDTH), 60.0)
    picture[:, 70:76] = 200.0
    return np.clip(picture + np.random.default_rng(seed).normal(0.0, noise, picture.shape), 0, 255).astype(np.uint8)


def blank(level: float, noise: float, seed: int = 0) -> np.ndarray:
    noisy = level + np.random.default_rng(seed).normal(0.0, noise, (HEIGHT, WIDTH))
    return np.clip(noisy, 0, 255).astype(np.uint8)


def image_faults(pictures: list[np.ndarray], period_ns: int = PERIOD_NS, noiseless: bool = False) -> list[str | None]:
    check = ImageCheck(WIDTH, HEIGHT, 0.06, noiseless=noiseless)
    return [check.step(picture, index * period_ns) for index, picture in enumerate(pictures)]


def test_pictures_of_a_road_are_well() -> None:
    assert image_faults([road(seed) for seed in range(20)]) == [None] * 20


def test_a_picture_that_repeats_is_reported_when_the_last_new_one_is_as_old_as_a_frame_may_be() -> None:
    texts = image_faults([road(0), *[road(1)] * 6])
    # picture 1 was new at 16.7 ms; 66.7 ms and 83.3 ms later pictures 5 and 6 are still the same
    assert [text is not None for text in texts] == [False] * 5 + [True, True]
    assert texts[5] == "the camera repeats the same image for 0.067 s"


@pytest.mark.parametrize(("period_ms", "first"), [(16, 4), (20, 3), (33, 2), (50, 2)])
def test_the_time_counts_not_the_number_of_pictures(period_ms: int, first: int) -> None:
    texts = image_faults([road(0)] * 8, period_ns=period_ms * MS)
    assert [index for index, text in enumerate(texts) if text is not None] == list(range(first, 8))


def test_one_bit_makes_another_picture() -> None:
    pictures = []
    for index in range(20):
        picture = road(0).copy()
        picture[17, 31] ^= index % 2
        pictures.append(picture)
    assert image_faults(pictures) == [None] * 20


def test_a_camera_that_has_no_noise_may_see_the_same_picture_for_ever() -> None:
    assert image_faults([road(0)] * 50, noiseless=True) == [None] * 50
    assert image_faults([blank(9.0, 0.0)] * 5, noiseless=True) == ["the image is blank"] * 5


def test_the_first_other_picture_makes_it_well() -> None:
    texts = image_faults([*[road(0)] * 10, road(1), road(2)])
    assert texts[9] is not None
    assert texts[10:] == [None, None]


@pytest.mark.parametrize("level", [0.0, 2.0, 50.0, 128.0, 253.0, 255.0])
@pytest.mark.parametrize("noise", [0.0, 2.0, 5.0])
def test_blank_pictures_are_reported_after_the_same_time(level: float, noise: float) -> None:
    texts = image_faults([road(0), *(blank(level, noise, seed) for seed in range(6))])
    assert [text is not None for text in texts] == [False] * 4 + [True] * 3
    assert texts[4] == "the image is blank for 0.067 s"


def test_blank_from_the_first_picture_on_is_reported_at_once() -> None:
    assert image_faults([blank(0.0, 2.0)]) == ["the image is blank"]


def test_single_bad_pictures_are_ridden_through() -> None:
    pictures = []
    for index in range(30):
        pictures.append(blank(0.0, 1.0) if index % 3 else road(index))
    assert image_faults(pictures) == [None] * 30


def test_contrast_is_that_of_the_brightest_and_the_darkest_part() -> None:
    halves = np.zeros((180, 320, 3), dtype=np.uint8)
    halves[:90, :, 1] = 40
    assert contrast(halves) == 40
    assert contrast(np.full((37, 61), 9, dtype=np.uint8)) == 0
    assert contrast(blank(100.0, 5.0)) < FLAT_LEVELS


def test_the_size_must_be_the_cameras() -> None:
    check = ImageCheck(WIDTH, HEIGHT, 0.06)
    assert check.misfit(road()) is None
    assert check.misfit(np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)) is None
    assert check.misfit(road()[:45]) == "the image has 160x45 pixels; the camera has 160x90"
    assert check.misfit(road().T) is not None


def lane_at(
    t_ms: float,
    offset_m: float = 0.0,
    heading_rad: float = 0.0,
    status: LaneStatus = LaneStatus.TRACKING,
    bound_m: float = math.inf,
    bound_rad: float = math.inf,
) -> LaneEstimate:
    if status is LaneStatus.LOST:
        return LaneEstimate(t_ns=round(t_ms * MS), status=status)
    pose = LanePose(
        offset_m=offset_m,
        heading_rad=heading_rad,
        width_m=0.4,
        curvature_per_m=0.0,
        covariance=np.eye(3) * 1e-4,
        offset_bound_m=bound_m,
        heading_bound_rad=bound_rad,
    )
    return LaneEstimate(t_ns=round(t_ms * MS), status=status, pose=pose, centerline=line(0.0, 0.0, 0.0, 1.4))


@pytest.mark.parametrize(
    ("offset_m", "heading_rad", "text"),
    [
        (0.19, 0.0, None),
        (-0.19, 0.55, None),
        (0.21, 0.0, "the lane has jumped sideways by 0.21 m"),
        (-0.40, 0.0, "the lane has jumped sideways by 0.40 m"),
        (0.0, 0.65, "the lane has turned by 0.65 rad at once"),
        (0.0, -1.5, "the lane has turned by 1.50 rad at once"),
    ],
)
def test_half_a_lane_aside_or_a_quarter_turn_is_another_line(
    offset_m: float, heading_rad: float, text: str | None
) -> None:
    check = LaneJumpCheck(VEHICLE)
    assert check.step(lane_at(0)) is None
    assert check.step(lane_at(16, offset_m, heading_rad)) == text


def test_headings_are_compared_around_the_circle() -> None:
    check = LaneJumpCheck(VEHICLE)
    check.step(lane_at(0, heading_rad=math.pi - 0.1))
    assert check.step(lane_at(16, heading_rad=-math.pi + 0.1)) is None


def test_a_lane_that_jumped_stays_wrong_until_it_is_back_or_the_right_one_is_long_ago() -> None:
    check = LaneJumpCheck(VEHICLE)
    check.step(lane_at(0))
    assert all(check.step(lane_at(t_ms, 0.3)) for t_ms in range(16, round(KEPT_S * 1000), 16))
    assert check.step(lane_at(KEPT_S * 1000, 0.3)) is None
    assert check.step(lane_at(KEPT_S * 1000 + 16, 0.0)) is not None  # and the old one has jumped now
    check = LaneJumpCheck(VEHICLE)
    check.step(lane_at(0))
    check.step(lane_at(16, 0.3))
    assert check.step(lane_at(32, 0.01)) is None


@pytest.mark.parametrize(
    ("width_m", "well"), [(0.19, False), (0.2, True), (0.4, True), (2.0, True), (2.1, False), (-0.4, False)]
)
def test_a_lane_is_as_wide_as_a_car_and_no_hall(width_m: float, well: bool) -> None:
    pose = LanePose(offset_m=0.0, heading_rad=0.0, width_m=width_m, curvature_per_m=0.0, covariance=np.eye(3))
    estimate = LaneEstimate(t_ns=0, status=LaneStatus.TRACKING, centerline=line(0.0, 0.0, 0.0, 1.0), pose=pose)
    assert (width_fault(estimate, VEHICLE) is None) is well
    assert width_fault(LaneEstimate(t_ns=0, status=LaneStatus.LOST), VEHICLE) is None
    checks = InputChecks(dataclasses.replace(CAR, vehicle=VEHICLE))
    said = checks.of_estimate(estimate, MOTION, None)
    assert any("m wide" in text for text in said) is not well


def test_a_lane_that_wanders_may_go_anywhere() -> None:
    check = LaneJumpCheck(VEHICLE)
    assert [check.step(lane_at(16 * i, 0.05 * i, 0.1 * i)) for i in range(20)] == [None] * 20


def test_a_lost_lane_is_no_jump_but_may_be_one_when_it_is_found() -> None:
    check = LaneJumpCheck(VEHICLE)
    check.step(lane_at(0))
    assert check.step(lane_at(16, status=LaneStatus.LOST)) is None
    assert check.step(lane_at(32, 0.3)) is not None


def test_after_dead_reckoning_a_line_that_is_seen_again_is_right() -> None:
    check = LaneJumpCheck(VEHICLE)
    check.step(lane_at(0))
    check.step(lane_at(16, 0.1, status=LaneStatus.COASTING))
    assert check.step(lane_at(32, 0.35)) is None
    assert check.step(lane_at(48, 0.0)) is not None


@pytest.mark.parametrize("status", [LaneStatus.TRACKING, LaneStatus.ONE_LINE, LaneStatus.COASTING])
@pytest.mark.parametrize(
    ("before_m", "after_m", "most_m"),
    [
        (0.10, 0.05, 0.15),  # what the bounds explain
        (0.20, 0.30, 0.50),
        (0.01, 0.02, 0.10),  # less than the free space brings no car out of its lane
    ],
)
def test_bounds_that_are_stated_say_what_a_jump_is_whatever_the_status(
    status: LaneStatus, before_m: float, after_m: float, most_m: float
) -> None:
    for step_m, jumps in ((most_m - 0.005, False), (most_m + 0.005, True)):
        for sign in (-1.0, 1.0):
            check = LaneJumpCheck(VEHICLE)
            check.step(lane_at(0, status=status, bound_m=before_m))
            said = check.step(lane_at(16, sign * step_m, bound_m=after_m))
            assert said == (f"the lane has jumped sideways by {step_m:.2f} m" if jumps else None)


@pytest.mark.parametrize(("before_m", "after_m"), [(0.01, math.inf), (math.inf, 0.01)])
def test_one_bound_alone_changes_nothing(before_m: float, after_m: float) -> None:
    for status, step_m, jumps in (
        (LaneStatus.TRACKING, 0.19, False),
        (LaneStatus.TRACKING, 0.21, True),
        (LaneStatus.COASTING, 0.35, False),
    ):
        check = LaneJumpCheck(VEHICLE)
        check.step(lane_at(0, status=status, bound_m=before_m))
        assert (check.step(lane_at(16, step_m, bound_m=after_m)) is not None) is jumps


def test_after_dead_reckoning_a_turn_that_the_bounds_do_not_explain_is_a_jump() -> None:
    for turn_rad, bound_rad, jumps in ((0.65, 0.1, True), (0.55, 0.1, False), (0.65, 0.35, False), (0.65, 0.3, True)):
        check = LaneJumpCheck(VEHICLE)
        check.step(lane_at(0, status=LaneStatus.COASTING, bound_rad=bound_rad))
        assert (check.step(lane_at(16, 0.0, turn_rad, bound_rad=bound_rad)) is not None) is jumps


def uncertain(
    seconds: float,
    bound_m: float,
    speed_mps: float = 1.0,
    armed: bool = True,
    check: OffsetBoundCheck | None = None,
    from_s: float = 0.0,
) -> list[str | None]:
    """What is said each 10 ms of a car that may bridge 1.5 m and 2 s."""
    check = check or OffsetBoundCheck(VEHICLE, 1.5, 2.0)
    said = []
    for t_ms in range(round(from_s * 1000), round((from_s + seconds) * 1000), 10):
        motion = Motion(t_ns=t_ms * MS, speed_mps=speed_mps, yaw_rate_radps=0.0)
        state = VehicleState(t_ns=t_ms * MS, armed=armed)
        said.append(check.step(lane_at(t_ms, bound_m=bound_m), motion, state))
    return said


@pytest.mark.parametrize(("speed_mps", "after_s"), [(1.0, 1.5), (-1.5, 1.0), (0.5, 2.0), (0.0, 2.0)])
def test_a_car_that_may_be_outside_its_lane_goes_on_as_far_as_one_without_lines(
    speed_mps: float, after_s: float
) -> None:
    said = uncertain(2.5, 0.14, speed_mps)
    first = next(index for index, text in enumerate(said) if text is not None)
    assert first * 0.01 == pytest.approx(after_s, abs=0.011)
    assert set(said[first:]) == {"offset uncertain: 0.14 m (limit 0.10)"}


@pytest.mark.parametrize("bound_m", [0.0, 0.09, math.inf])
def test_a_bound_within_the_free_space_or_not_stated_holds_nobody(bound_m: float) -> None:
    assert not any(uncertain(5.0, bound_m))
    assert not any(uncertain(1.0, bound_m, armed=False))


def test_a_car_that_is_not_armed_is_refused_where_it_is_not_known_which_lane_it_is_in() -> None:
    check = OffsetBoundCheck(VEHICLE, 1.5, 2.0)
    half_m = 0.2
    assert set(uncertain(0.5, half_m, 0.0, armed=False, check=check)) == {"offset uncertain: 0.20 m (limit 0.10)"}
    assert not any(uncertain(3.0, half_m - 0.01, 0.0, armed=False, check=check, from_s=0.5))
    assert not any(uncertain(1.4, 0.14, check=check, from_s=3.5))  # what came before it was armed does not count
    assert OffsetBoundCheck(VEHICLE, 1.5, 2.0).step(lane_at(0, bound_m=half_m), MOTION, None) is not None
    assert OffsetBoundCheck(VEHICLE, 1.5, 2.0).step(lane_at(0, bound_m=half_m - 0.01), MOTION, None) is None


def test_an_offset_that_was_certain_again_may_be_uncertain_for_as_long_again() -> None:
    check = OffsetBoundCheck(VEHICLE, 1.5, 2.0)
    for begin_s in (0.0, 2.0, 4.0):
        assert not any(uncertain(1.4, 0.14, check=check, from_s=begin_s))
        assert not any(uncertain(0.1, 0.05, check=check, from_s=begin_s + 1.4))
    assert any(uncertain(1.6, 0.14, check=check, from_s=6.0))


def test_a_lost_lane_does_not_make_an_uncertain_one_certain() -> None:
    check = OffsetBoundCheck(VEHICLE, 1.5, 2.0)
    uncertain(1.0, 0.14, check=check)
    assert check.step(lane_at(1000, status=LaneStatus.LOST), MOTION, VehicleState(t_ns=0, armed=True)) is None
    assert any(uncertain(0.6, 0.14, check=check, from_s=1.01))


def test_the_car_bridges_what_its_pipeline_does_and_its_width_counts() -> None:
    car = dataclasses.replace(CAR, pipeline=PipelineConfig(name="windows"), vehicle=VehicleConfig(width_m=0.3))
    checks, armed = InputChecks(car), VehicleState(t_ns=0, armed=True)
    coast_s = car.pipeline.windows.coast_s
    for t_ms in range(0, round(coast_s * 1000), 10):
        motion = Motion(t_ns=t_ms * MS, speed_mps=0.1, yaw_rate_radps=0.0)
        assert checks.of_estimate(lane_at(t_ms, bound_m=0.06), motion, armed) == ()
    late = lane_at(coast_s * 1000, bound_m=0.06)
    assert checks.of_estimate(late, MOTION, armed) == ("offset uncertain: 0.06 m (limit 0.05)",)


WHEELBASE_M = 0.26


def steering_faults(
    seconds: float,
    told_rad: float | None,
    wheels_rad: float,
    speed_mps: float = 1.0,
    source: MotionSource = MotionSource.MEASURED,
    check: SteeringCheck | None = None,
    from_s: float = 0.0,
) -> list[str | None]:
    """What is said each 16 ms of a car whose wheels stand at `wheels_rad`; the yaw rate is that of its circle."""
    check = check or SteeringCheck(WHEELBASE_M)
    radius_m = math.inf if wheels_rad == 0.0 else WHEELBASE_M / math.tan(wheels_rad)
    said = []
    for t_ms in range(round(from_s * 1000), round((from_s + seconds) * 1000), 16):
        motion = Motion(t_ns=t_ms * MS, speed_mps=speed_mps, yaw_rate_radps=speed_mps / radius_m, source=source)
        said.append(check.step(motion, VehicleState(t_ns=t_ms * MS, steering_rad=told_rad)))
    return said


@pytest.mark.parametrize("told_rad", [-0.4, -0.1, 0.0, 0.2, 0.45])
@pytest.mark.parametrize("off_rad", [-0.05, 0.0, 0.05])
def test_a_car_that_turns_as_steered_is_well_with_a_servo_three_degrees_off(told_rad: float, off_rad: float) -> None:
    assert not any(steering_faults(1.0, told_rad, told_rad + off_rad, speed_mps=1.5))


def test_slipping_tyres_are_no_fault() -> None:
    assert not any(steering_faults(1.0, 0.4, math.atan(0.65 * math.tan(0.4)), speed_mps=1.5))


@pytest.mark.parametrize(("told_rad", "wheels_rad"), [(0.35, 0.0), (-0.35, 0.0), (0.0, 0.2), (0.3, -0.1)])
def test_wheels_that_do_not_follow_are_reported_after_a_quarter_of_a_second(told_rad: float, wheels_rad: float) -> None:
    said = steering_faults(0.5, told_rad, wheels_rad)
    first = next(index for index, text in enumerate(said) if text is not None)
    assert first == math.ceil(250 / 16)
    assert said[first] == "the car does not turn as it is steered; look at the servo and its linkage"
    assert all(said[first:])


def test_a_servos_lag_is_no_fault() -> None:
    check = SteeringCheck(WHEELBASE_M)
    for turn in range(10):
        begin_s = 0.4 * turn
        assert not any(steering_faults(0.2, 0.4, -0.4, check=check, from_s=begin_s))
        assert not any(steering_faults(0.2, 0.4, 0.4, check=check, from_s=begin_s + 0.2))


def test_a_car_that_was_slowed_down_for_it_is_not_well_at_once() -> None:
    check = SteeringCheck(WHEELBASE_M)
    steering_faults(0.4, 0.35, 0.0, check=check)
    after = steering_faults(1.0, 0.35, 0.0, speed_mps=0.1, check=check, from_s=0.4)
    assert [text is not None for text in after] == sorted((text is not None for text in after), reverse=True)
    assert 0.3 < 0.016 * sum(text is not None for text in after) <= 0.5  # longer than a car is held


@pytest.mark.parametrize(
    "how",
    [{"speed_mps": 0.3}, {"source": MotionSource.MODEL}, {"source": MotionSource.NONE}, {"told_rad": None}],
)
def test_where_nothing_can_be_said_nothing_is(how: dict[str, object]) -> None:
    assert not any(steering_faults(1.0, **{"told_rad": 0.4, "wheels_rad": -0.4, **how}))  # type: ignore[arg-type]


def test_without_a_state_nothing_is_said() -> None:
    motion = Motion(t_ns=0, speed_mps=1.0, yaw_rate_radps=3.0)
    assert SteeringCheck(WHEELBASE_M).step(motion, None) is None
