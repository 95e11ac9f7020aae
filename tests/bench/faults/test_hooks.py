"""What the faulty parts do, alone."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from random import Random

import numpy as np
import pytest

from automodel.bench.faults import hooks
from automodel.bench.faults.fault import At, CameraHook, Hooks, Stall
from automodel.bench.faults.faulty_parts import FaultyPeripherals, FaultyPipeline, FaultySource, Staller
from automodel.bench.faults.judge import Plan
from automodel.config import CameraConfig, SecondCamera, VehicleConfig
from automodel.runtime.clocks import VirtualClock
from automodel.signals import BoardSensors, Frame, LaneEstimate, LaneStatus, Motion, StereoFrame
from automodel.sources.errors import SourceError
from firmware_link import messages
from tests.support.runner_fakes import MS, estimate

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


def test_of_a_pair_the_left_image_is_spoilt() -> None:
    clock = VirtualClock(1900 * MS)
    hook = hooks.at_once(hooks.blank(255.0, 0.0, Random(1)))
    source = FaultySource(TickingPair(clock), Hooks(camera=hook), PLAN, clock, Staller(None, PLAN, clock))
    white = {}
    while clock.now_ns() < 2300 * MS:
        frame = source.read(0.015)
        if isinstance(frame, StereoFrame):
            white[frame.t_ns // MS] = (bool((frame.left == 255).all()), bool((frame.right == 255).all()))
    assert {t for t, (left, _) in white.items() if left} == set(range(2000, 2200, PERIOD_MS))
    assert not any(right for _, right in white.values())


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


def pairs(count: int) -> list[StereoFrame]:
    images = [np.full((4, 6), 10 * k, np.uint8) for k in range(count)]
    return [
        StereoFrame(t_ns=k * PERIOD_MS * MS, index=k, left=image, right=image + 1, right_late_ns=k * MS)
        for k, image in enumerate(images)
    ]


def test_the_other_eye_goes_on_alone_with_its_own_time() -> None:
    for k, pair in enumerate(pairs(3)):
        left = hooks.without_eye(1)(pair)
        right = hooks.without_eye(0)(pair)
        assert isinstance(left, Frame)
        assert isinstance(right, Frame)
        assert (left.eye, left.t_ns, left.image[0, 0]) == (0, pair.t_ns, 10 * k)
        assert (right.eye, right.t_ns, right.image[0, 0]) == (1, pair.t_ns + k * MS, 10 * k + 1)


@pytest.mark.parametrize("eye", [0, 1])
def test_one_eye_is_spoilt_and_the_other_one_is_not(eye: int) -> None:
    hook = hooks.of_eye(eye, hooks.frozen())
    for k, pair in enumerate(pairs(3)):
        out = hook(pair)
        assert isinstance(out, StereoFrame)
        assert (out.t_ns, out.right_late_ns) == (pair.t_ns, pair.right_late_ns)
        spoilt, well = (out.left, out.right) if eye == 0 else (out.right, out.left)
        assert (spoilt[0, 0], well[0, 0]) == (eye, 10 * k + 1 - eye)


def test_the_right_image_lags_by_its_own_time() -> None:
    hook, found = hooks.lagging(2), []
    for pair in pairs(5):
        out = hook(pair)
        assert isinstance(out, StereoFrame)
        found.append((int(out.right[0, 0]), out.right_late_ns // MS))
    assert found == [(1, 0), (1, -20), (1, -40), (11, -39), (21, -38)]


def test_cameras_are_exchanged_and_turned() -> None:
    left, right = CameraConfig(right=SecondCamera()).eyes
    right = dataclasses.replace(right, extrinsics=dataclasses.replace(right.extrinsics, y_m=-0.2))
    assert hooks.exchanged((left, right)) == (right, left)
    one, other = hooks.turned(1, 0.1, 0.0, -0.2)((left, right))
    assert one == left
    assert other.extrinsics == dataclasses.replace(
        right.extrinsics, yaw_rad=right.extrinsics.yaw_rad + 0.1, roll_rad=right.extrinsics.roll_rad - 0.2
    )
    assert hooks.turned(0, 0.0, 0.1, 0.0)((left, right))[0].extrinsics.pitch_rad == left.extrinsics.pitch_rad + 0.1
