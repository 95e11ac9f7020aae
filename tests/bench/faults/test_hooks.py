"""What the faulty parts do, alone."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from random import Random

import numpy as np
import pytest

from automodel.bench.faults import hooks
from automodel.bench.faults.catalogue import chosen
from automodel.bench.faults.fault import At, CameraHook, Hooks, PairHook, Stall
from automodel.bench.faults.faulty_parts import FaultyPeripherals, FaultyPipeline, FaultySource, Staller
from automodel.bench.faults.judge import Plan
from automodel.config import CameraConfig, SecondCamera, VehicleConfig
from automodel.runtime.clocks import VirtualClock
from automodel.runtime.loop import Loop
from automodel.signals import BoardSensors, Frame, LaneEstimate, LaneStatus, Motion, StereoFrame
from automodel.sources.errors import SourceError
from firmware_link import messages
from tests.support.runner_fakes import MS, FakeController, FakeLimits, FakePipeline, estimate

PERIOD_MS = 20
PLAN = Plan(
    seed="",
    start_ns=2000 * MS,
    end_ns=2200 * MS,
    until_ns=4000 * MS,
    press_ns=None,
    drives_again=False,
    coast_s=1.0,
    place=0.0,
    offset_m=0.0,
    speed_mps=1.0,
    look=0,
)


class Ticking:
    """A camera that takes a frame every 20 ms and delivers it at once."""

    def __init__(self, clock: VirtualClock) -> None:
        self._clock = clock
        self._next = 0

    def read(self, timeout_s: float) -> Frame | None:
        self._next = max(self._next, math.ceil(self._clock.now_ns() / (PERIOD_MS * MS)))
        t_ns, until_ns = self._next * PERIOD_MS * MS, self._clock.now_ns() + round(timeout_s * 1e9)
        self._clock.advance_to(min(t_ns, until_ns))
        if t_ns > until_ns:
            return None
        self._next += 1
        return Frame(t_ns=t_ns, index=self._next - 1, image=np.full((4, 6), self._next % 251, dtype=np.uint8))

    def close(self) -> None:
        pass


def delivered(hook: CameraHook, stall: Stall | None = None) -> list[tuple[int, Frame]]:
    """When [ms] which frame came, from 1.9 s to 2.4 s."""
    clock = VirtualClock(1900 * MS)
    source = FaultySource(Ticking(clock), Hooks(camera=hook), PLAN, clock, Staller(stall, PLAN, clock))
    came = []
    while clock.now_ns() < 2400 * MS:
        frame = source.read(0.015)
        if isinstance(frame, Frame):
            came.append((clock.now_ns() // MS, frame))
    return came


def times(came: list[tuple[int, Frame]]) -> list[int]:
    return [t_ms for t_ms, _ in came]


NORMAL = list(range(1900, 2401, PERIOD_MS))


def test_a_camera_is_faulty_from_begin_to_end_only() -> None:
    assert times(delivered(hooks.at_once(hooks.drop))) == [t for t in NORMAL if not 2000 <= t < 2200]
    assert times(delivered(hooks.at_once(lambda frame: frame))) == NORMAL


def test_bursts_and_first_frames() -> None:
    missing = sorted(set(NORMAL) - set(times(delivered(hooks.at_once(hooks.in_bursts(2, 3, hooks.drop))))))
    assert missing == [2000, 2020, 2100, 2120]
    missing = sorted(set(NORMAL) - set(times(delivered(hooks.at_once(hooks.for_first(2, hooks.drop))))))
    assert missing == [2000, 2020]


def test_a_frozen_camera_goes_on_in_time() -> None:
    came = delivered(hooks.at_once(hooks.frozen()))
    assert [frame.t_ns // MS for _, frame in came] == NORMAL
    frozen = {int(frame.image[0, 0]) for t_ms, frame in came if 2000 <= t_ms < 2200}
    assert frozen == {101}
    assert len({int(frame.image[0, 0]) for _, frame in came}) == len(NORMAL) - 9


def test_late_frames_come_in_their_order_at_their_time() -> None:
    came = delivered(hooks.late(lambda: 90 * MS))
    assert [t for t in times(came) if t < 2090] == [t for t in NORMAL if t < 2000]
    late = [(t_ms, frame.t_ns // MS) for t_ms, frame in came if 2090 <= t_ms <= 2270]
    assert late[0] == (2090, 2000)
    assert [frame.t_ns for _, frame in came] == sorted(frame.t_ns for _, frame in came)
    assert late[-5:] == [(2270, t_ms) for t_ms in range(2180, 2261, 20)]  # those after the fault do not overtake
    delays = iter([50, 10, 10, 10, 10, 10, 10, 10, 10, 10])
    came = delivered(hooks.late(lambda: next(delays) * MS))
    assert [frame.t_ns // MS for _, frame in came] == NORMAL


def test_a_camera_that_is_gone_or_gives_another_type_raises() -> None:
    with pytest.raises(SourceError, match="is it plugged in"):
        delivered(hooks.at_once(hooks.gone))
    with pytest.raises(ValueError, match="uint16"):
        delivered(hooks.at_once(hooks.of_another_type))


def test_spoilt_images() -> None:
    frame = Frame(t_ns=5, index=3, image=np.arange(3600, dtype=np.uint8).reshape(60, 60))
    black = hooks.blank(0.0, 2.0, Random(1))(frame)
    assert black is not None
    assert (black.t_ns, black.index, black.image.shape) == (5, 3, (60, 60))
    assert 0.5 < black.image.mean() < 1.2  # half of a normal distribution of width 2
    early, small = hooks.shifted_in_time(-7)(frame), hooks.resized(Random(0))(frame)
    assert early is not None
    assert early.t_ns == -2
    assert small is not None
    assert small.image.shape != (60, 60)


def test_a_stall_takes_its_time_once_or_again() -> None:
    hook = hooks.at_once(lambda frame: frame)
    missing = set(NORMAL) - set(times(delivered(hook, Stall(at=At.CAMERA, seconds=0.1))))
    assert missing == set(range(2000, 2100, PERIOD_MS)) - {2000}
    clock = VirtualClock(1990 * MS)
    staller = Staller(Stall(at=At.AFTER, seconds=0.03, again=True), PLAN, clock)
    spent = []
    for _ in range(30):
        before_ns = clock.now_ns()
        staller(At.PIPELINE)
        staller(At.AFTER)
        spent.append((clock.now_ns() - before_ns) // MS)
        clock.sleep(0.02)
    assert spent[:2] == [0, 30]
    assert Counter(spent) == {0: 26, 30: 4}  # every 50 ms of 200


def test_estimates_are_spoilt_while_the_fault_lasts() -> None:
    def truth(frame: Frame, motion: Motion) -> LaneEstimate:
        return estimate(frame.t_ns)

    clock = VirtualClock(0)
    pipeline = FaultyPipeline(truth, None, hooks.lost, PLAN, Staller(None, PLAN, clock), VehicleConfig())
    motion = Motion(t_ns=0, speed_mps=1.0, yaw_rate_radps=0.0)
    statuses = {}
    for t_ms in (1999, 2000, 2199, 2200):
        frame = Frame(t_ns=t_ms * MS, index=0, image=np.zeros((4, 6), dtype=np.uint8))
        statuses[t_ms] = pipeline.step(frame, motion).status
    assert [t_ms for t_ms, status in statuses.items() if status is LaneStatus.LOST] == [2000, 2199]


@pytest.mark.parametrize(("bound_m", "knows"), [(0.02, True), (0.4, False), (math.inf, True)])
def test_a_run_counts_only_where_the_pipeline_was_sure_of_its_lane_before_the_fault(
    bound_m: float, knows: bool
) -> None:
    def step(frame: Frame, motion: Motion) -> LaneEstimate:
        return hooks.uncertain(bound_m if frame.t_ns < PLAN.start_ns else 9.0)(estimate(frame.t_ns))

    pipeline = FaultyPipeline(step, None, None, PLAN, Staller(None, PLAN, VirtualClock(0)), VehicleConfig())
    for t_ms in (1900, 1999, 2000, 2100):
        frame = Frame(t_ns=t_ms * MS, index=0, image=np.zeros((4, 6), dtype=np.uint8))
        pipeline.step(frame, Motion(t_ns=0, speed_mps=1.0, yaw_rate_radps=0.0))
    assert pipeline.knows is knows


def test_a_decoy_lies_beside_the_lane_and_a_crossing_across() -> None:
    right = estimate(0, offset_m=0.05)
    decoy = hooks.decoy(0.3)(right)
    assert decoy.pose is not None
    assert decoy.centerline is not None
    assert decoy.pose.offset_m == pytest.approx(-0.25)
    assert decoy.centerline.position(1.0) == pytest.approx((1.0, 0.3))
    crossing = hooks.crossing(1.2)(right)
    assert crossing.pose is not None
    assert crossing.centerline is not None
    assert crossing.pose.heading_rad == -1.2
    assert crossing.centerline.position(1.0) == pytest.approx((math.cos(1.2), math.sin(1.2)))
    pose = hooks.with_pose(width_m=math.nan)(right).pose
    assert pose is not None
    assert math.isnan(pose.width_m)


def test_bytes_on_the_wire() -> None:
    data = bytes(range(1, 15))
    assert list(hooks.silent(data, 5)) == []
    assert list(hooks.held_back(90)(data, 5)) == [(90, data)]
    assert list(hooks.delayed(7)(data, 5)) == [(12, data)]
    assert list(hooks.falling_behind(100, 2.0)(data, 130)) == [(190, data)]
    assert list(hooks.doubled(data, 5)) == [(5, data + data)]
    ((_, noisy),) = hooks.noise_before(Random(1), 60)(data, 5)
    assert noisy.endswith(data)
    assert 1 <= len(noisy) - len(data) <= 60
    ((_, other),) = hooks.random_bytes(Random(1))(data, 5)
    assert len(other) == len(data)
    assert other != data
    ((_, short),) = hooks.cut(Random(1))(data, 5)
    assert data.startswith(short)
    assert 1 <= len(short) <= len(data) - 2
    swapped = hooks.swapped()
    assert [list(swapped(piece, 5)) for piece in (b"a", b"b", b"c", b"d")] == [[], [(5, b"ba")], [], [(5, b"dc")]]


def test_wrong_bits_and_bytes() -> None:
    data = bytes(14)
    for seed in range(30):
        ((_, spoilt),) = hooks.corrupt(Random(seed))(data, 0)
        assert 1 <= sum(byte.bit_count() for byte in spoilt) <= 5
        once = hooks.one_byte(Random(seed))
        assert list(once(b"", 0)) == [(0, b"")]  # nothing was sent: it waits
        ((_, first),) = once(data, 0)
        assert sum(a != b for a, b in zip(first, data, strict=True)) == 1
        assert list(once(data, 0)) == [(0, data)]


def test_sensors() -> None:
    good = BoardSensors(ranges_m=(1.0, 2.0, 3.0), wheel_ticks=5, battery_v=7.4, yaw_rate_radps=0.1)
    assert hooks.battery(5.0)(good).battery_v == 5.0
    assert hooks.stuck_echo(0.1)(good).ranges_m == (0.1, 0.1, 0.1)
    spikes = hooks.spikes(Random(3), 4)
    near = [(spikes(good).ranges_m[1] or 0.0) < 0.31 for _ in range(12)]
    assert sum(near) == 3
    assert not any(near[i] and any(near[i + 1 : i + 4]) for i in range(12))
    missing = hooks.dropouts(Random(3), 0.5)
    assert {missing(good).ranges_m[1] for _ in range(50)} == {None, 2.0}


class Plant:
    def __init__(self) -> None:
        self.given: list[tuple[int, float, float]] = []

    def set_pulses(self, t_ns: int, servo_us: float, motor_us: float) -> None:
        self.given.append((t_ns // MS, servo_us, motor_us))

    def read_sensors(self, t_ns: int) -> BoardSensors:
        return BoardSensors(ranges_m=(None, None, None), wheel_ticks=0, battery_v=7.4, yaw_rate_radps=None)


def test_a_stuck_servo_stays_though_its_pin_goes_on() -> None:
    plant = Plant()
    pins = FaultyPeripherals(plant, Hooks(servo_stuck=True, sensors=hooks.battery(5.0)), PLAN)
    for t_ms, servo_us in ((1980, 1400.0), (2000, 1450.0), (2180, 1500.0), (2200, 1550.0)):
        pins.set_pulses(t_ms * MS, servo_us, 1600.0)
    assert [servo for _, servo, _ in plant.given] == [1400.0, 1400.0, 1400.0, 1550.0]
    assert [servo for _, servo, _ in pins.pins] == [1400.0, 1450.0, 1500.0, 1550.0]
    assert [pins.read_sensors(t_ms * MS).battery_v for t_ms in (1999, 2000, 2200)] == [7.4, 5.0, 7.4]


def test_hooks_of_the_lane_change_what_they_say_and_nothing_else() -> None:
    right = estimate(5)
    assert right.pose is not None
    assert hooks.one_line(right).status is LaneStatus.ONE_LINE
    assert hooks.one_line(hooks.lost(right)).status is LaneStatus.LOST
    wide = hooks.times_width(15.0)(right)
    assert wide.pose is not None
    assert wide.pose.width_m == 15.0 * right.pose.width_m
    spoil = hooks.after(2, hooks.coasting, hooks.lost)
    assert [spoil(right).status for _ in range(3)] == [LaneStatus.COASTING, LaneStatus.COASTING, LaneStatus.LOST]


def test_a_board_whose_time_is_stuck_says_the_rest_as_it_is() -> None:
    hook, decoder = hooks.time_stuck(), messages.decoder(on_board=False)
    for time_us, faults in ((7_000, 0), (27_000, 4)):
        status = messages.Status(
            time_us=time_us, servo_us=1500.0, motor_us=1500.0, faults=faults, nonce=3, command_counter=1, flags=1
        )
        ((_, data),) = hook(messages.encode(status, 9), 5)
        (frame,) = decoder.feed(data)
        assert (frame.counter, messages.decode(frame)) == (9, dataclasses.replace(status, time_us=7_000))


class TickingPair(Ticking):
    """Two of them."""

    def read(self, timeout_s: float) -> StereoFrame | None:  # type: ignore[override]
        frame = super().read(timeout_s)
        if frame is None:
            return None
        return StereoFrame(t_ns=frame.t_ns, index=frame.index, left=frame.image, right=frame.image)


@pytest.mark.parametrize("both", [False, True])
def test_of_a_pair_the_left_image_is_spoilt_and_the_right_one_where_it_has_a_hook(both: bool) -> None:
    clock = VirtualClock(1900 * MS)
    hook = hooks.at_once(hooks.blank(255.0, 0.0, Random(1)))
    spoilt = Hooks(camera=hook, right_camera=hook if both else None)
    source = FaultySource(TickingPair(clock), spoilt, PLAN, clock, Staller(None, PLAN, clock))
    white = {}
    while clock.now_ns() < 2300 * MS:
        frame = source.read(0.015)
        if isinstance(frame, StereoFrame):
            white[frame.t_ns // MS] = (bool((frame.left == 255).all()), bool((frame.right == 255).all()))
    assert {t for t, (left, _) in white.items() if left} == set(range(2000, 2200, PERIOD_MS))
    assert {t for t, (_, right) in white.items() if right} == (set(range(2000, 2200, PERIOD_MS)) if both else set())


def test_a_frame_of_a_pair_is_lost_where_either_camera_loses_its_own() -> None:
    for camera, right in ((hooks.drop, hooks.frozen()), (hooks.frozen(), hooks.drop)):
        clock = VirtualClock(1900 * MS)
        spoilt = Hooks(camera=hooks.at_once(camera), right_camera=hooks.at_once(right))
        source = FaultySource(TickingPair(clock), spoilt, PLAN, clock, Staller(None, PLAN, clock))
        came = set()
        while clock.now_ns() < 2300 * MS:
            frame = source.read(0.015)
            came |= {frame.t_ns} if frame is not None else set()
        assert not any(2000 * MS <= t_ns < 2200 * MS for t_ns in came)
        assert came


def test_a_fault_of_both_eyes_is_built_twice_alike() -> None:
    gone, white = chosen(("camera-gone", "camera-white"))
    both = white.built(lambda: Random(3), 0)
    assert both.camera is not None
    assert both.right_camera is not None
    frame = Frame(t_ns=0, index=0, image=np.zeros((8, 8), np.uint8))
    one, other = both.camera(frame), both.right_camera(frame)
    assert one is not None
    assert other is not None
    assert np.array_equal(one[1].image, other[1].image)
    assert gone.built(lambda: Random(3), 0).right_camera is None


def delivered_pairs(pair: PairHook) -> tuple[FaultySource, list[tuple[int, Frame | StereoFrame, str]]]:
    """When [ms] which frame came, from 1.9 s to 2.3 s, and what the source then said of its cameras."""
    clock = VirtualClock(1900 * MS)
    source = FaultySource(TickingPair(clock), Hooks(pair=pair), PLAN, clock, Staller(None, PLAN, clock))
    came = []
    while clock.now_ns() < 2300 * MS:
        frame = source.read(0.015)
        if frame is not None:
            came.append((clock.now_ns() // MS, frame, source.trouble))
    return source, came


@pytest.mark.parametrize("eye", [0, 1])
def test_of_a_pair_either_eye_is_spoilt_and_its_time_stays(eye: int) -> None:
    _, came = delivered_pairs(hooks.of_eye(eye, hooks.blank(255.0, 0.0, Random(1))))
    for t_ms, frame, trouble in came:
        assert isinstance(frame, StereoFrame)
        assert (frame.t_ns // MS, frame.right_late_ns, trouble) == (t_ms, 0, "")
        spoilt, other = (frame.left, frame.right)[eye], (frame.left, frame.right)[1 - eye]
        assert bool((spoilt == 255).all()) is (2000 <= t_ms < 2200)
        assert not (other == 255).any()
    assert hooks.of_eye(eye, hooks.drop)(came[0][1]) is None  # type: ignore[arg-type]


@pytest.mark.parametrize("eye", [0, 1])
def test_an_eye_alone_goes_on_after_two_and_a_half_periods(eye: int) -> None:
    _, came = delivered_pairs(hooks.alone(eye, PERIOD_MS * MS, 2 * MS))
    alone = [(t_ms, frame, trouble) for t_ms, frame, trouble in came if isinstance(frame, Frame)]
    assert [t_ms for t_ms, _, _ in alone] == [2032, *range(2040, 2200, PERIOD_MS)]
    assert [frame.t_ns // MS for _, frame, _ in alone] == list(range(2020, 2200, PERIOD_MS))
    assert {frame.eye for _, frame, _ in alone} == {eye}
    assert {trouble for _, _, trouble in alone} == {f"{('right', 'left')[eye]} camera: no frame comes"}
    pairs = [(t_ms, trouble) for t_ms, frame, trouble in came if isinstance(frame, StereoFrame)]
    assert {trouble for _, trouble in pairs} == {""}
    assert min(t_ms for t_ms, _ in pairs if t_ms >= 2000) == 2200


def test_pairs_fall_apart_to_so_many_frames_and_say_so() -> None:
    _, came = delivered_pairs(hooks.falling_apart(3))
    late = [frame.right_late_ns // MS for t_ms, frame, _ in came if isinstance(frame, StereoFrame) and t_ms >= 2000]
    assert late[:11] == [0, -20, -40, *[-60] * 7, 0]
    for t_ms, frame, _ in came:
        assert isinstance(frame, StereoFrame)
        assert frame.t_ns // MS == t_ms
        assert (int(frame.left[0, 0]) - int(frame.right[0, 0])) * -PERIOD_MS == frame.right_late_ns // MS


def test_eyes_are_exchanged() -> None:
    left, right = np.zeros((4, 6), np.uint8), np.ones((4, 6), np.uint8)
    due_ns, pair = hooks.exchanged(StereoFrame(t_ns=5, index=3, left=left, right=right))
    assert (due_ns, pair.t_ns, pair.index, pair.left.max(), pair.right.min()) == (0, 5, 3, 1, 0)


@pytest.mark.parametrize("angle_deg", [-4.0, 3.0])
def test_what_a_camera_turned_counterclockwise_sees_is_turned_clockwise(angle_deg: float) -> None:
    image = np.zeros((101, 201), np.uint8)
    image[50] = 200
    out = hooks.turned(math.radians(angle_deg))(Frame(t_ns=5, index=3, image=image))
    assert out is not None
    columns = np.arange(40, 161)
    rows = (np.arange(101)[:, None] * out.image.astype(float)).sum(0) / out.image.sum(0)
    slope, middle = np.polyfit(columns - 100.0, rows[columns], 1)  # rows count downwards: clockwise is positive
    assert math.degrees(math.atan(slope)) == pytest.approx(angle_deg, abs=0.1)
    assert middle == pytest.approx(50.0, abs=0.1)


def test_a_frame_whose_time_a_fault_set_back_is_not_before_the_fault() -> None:
    def lost_later(frame: Frame, motion: Motion) -> LaneEstimate:
        return estimate(frame.t_ns) if frame.index == 0 else LaneEstimate(t_ns=frame.t_ns, status=LaneStatus.LOST)

    staller, image = Staller(None, PLAN, VirtualClock(0)), np.zeros((4, 6), dtype=np.uint8)
    pipeline = FaultyPipeline(lost_later, None, None, PLAN, staller, VehicleConfig())
    for index, before_ns in enumerate((10, 500, 5)):
        t_ns = PLAN.start_ns - before_ns
        still = Motion(t_ns=t_ns, speed_mps=0.0, yaw_rate_radps=0.0)
        pipeline.step(Frame(t_ns=t_ns, index=index, image=image), still)
    assert pipeline.knows


class TwoEyed(FakePipeline):
    """A pipeline of two cameras."""

    cameras = 2


@pytest.mark.parametrize(("seen", "kind"), [(TwoEyed(), StereoFrame), (FakePipeline(), Frame)])
def test_a_pipeline_gets_as_many_images_as_it_needs(seen: FakePipeline, kind: type) -> None:
    """In a loop the pipeline with the fault built in stands for the one inside."""

    def truth(frame: Frame, motion: Motion) -> LaneEstimate:
        return estimate(frame.t_ns)

    clock, image = VirtualClock(0), np.zeros((4, 6), dtype=np.uint8)
    pipeline = FaultyPipeline(truth, seen, None, PLAN, Staller(None, PLAN, clock), VehicleConfig())
    loop = Loop(pipeline, FakeController(), FakeLimits(), validity_s=0.1)
    pair = StereoFrame(t_ns=PLAN.start_ns, index=0, left=image, right=image)
    loop.tick(pair, Motion(t_ns=PLAN.start_ns, speed_mps=1.0, yaw_rate_radps=0.0), None, PLAN.start_ns)
    assert [type(frame) for frame in seen.seen] == [kind]


def test_a_mask_slides_by_so_many_pixels_and_time_and_index_stay() -> None:
    image = np.zeros((40, 60), np.uint8)
    image[:, 20:24] = 200
    spoil = hooks.sliding(lambda t_ns: t_ns * 1e-9)
    slid = spoil(Frame(t_ns=7_000_000_000, index=3, image=image))
    assert slid is not None
    assert (slid.t_ns, slid.index) == (7_000_000_000, 3)
    assert np.array_equal(slid.image[:, 27:31], image[:, 20:24])
    assert not slid.image[:, :27].any()


def test_lines_are_added_where_none_are_and_stay_where_they_are() -> None:
    image = np.full((90, 160), 40, np.uint8)
    image[:, 80:84] = 200
    spoil = hooks.with_lines(Random(3), 3)
    first, second = (spoil(Frame(t_ns=t, index=t, image=image)) for t in (1, 2))
    assert first is not None
    assert second is not None
    assert np.array_equal(first.image, second.image)
    added = first.image != image
    assert 100 < added.sum() < 3000
    assert int(first.image[added].max()) >= 190
    assert not added[: round(0.4 * 90) - 2].any()
    assert int(image.max()) == 200  # the camera's own image is not touched


@pytest.mark.parametrize("angle", ["yaw_rad", "pitch_rad", "roll_rad"])
def test_a_camera_of_a_rig_is_turned(angle: str) -> None:
    eyes = CameraConfig(right=SecondCamera()).eyes
    for eye in (0, 1):
        found = hooks.eye_turned(eye, angle, 0.1)(eyes)
        before, after = eyes[eye].extrinsics, found[eye].extrinsics
        assert found[1 - eye] == eyes[1 - eye]
        assert after == dataclasses.replace(before, **{angle: getattr(before, angle) + 0.1})
