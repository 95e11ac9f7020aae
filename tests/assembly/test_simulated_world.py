"""The simulated world: prediction, virtual time in lock-step, and the process of its own."""

from __future__ import annotations

import itertools
import time

import numpy as np
import pytest

from automodel.runtime.clocks import VirtualClock
from automodel.signals import Frame, StereoFrame
from automodel.sim.sources import LockStepSource, RealTimeWorld
from automodel.sim.world import EyePair, Scene, World
from automodel.sources.errors import SourceError
from tests.support import spawned_worlds
from tests.support.spawned_worlds import SHAPE, CountingRenderer, small_world

MS = 1_000_000
RIGHT_US, FORWARD_US = 1800.0, 1700.0


def settled_clock(world: World, start_ns: int = 0) -> VirtualClock:
    return VirtualClock(start_ns, world.settle)


def lock_step(rate_hz: float = 50.0, latency_ns: int = 3 * MS) -> tuple[LockStepSource, VirtualClock, list[Scene]]:
    world = small_world()
    world.settle(0)
    scenes: list[Scene] = []
    clock = settled_clock(world)
    return LockStepSource(world, clock, rate_hz, latency_ns, scenes.append), clock, scenes


def pulses(source: LockStepSource, t_ns: int, servo_us: float, motor_us: float) -> None:
    assert isinstance(source.world, World)
    source.world.set_pulses(t_ns, servo_us, motor_us)


class TestWorld:
    def test_a_picture_ahead_of_its_time_is_the_picture_of_that_time(self) -> None:
        ahead, at_time = small_world(), small_world()
        lead = ahead.plant.config.dead_time_ns
        assert lead > 5 * MS
        for world in (ahead, at_time):
            world.set_pulses(0, RIGHT_US, FORWARD_US)
            world.settle(500 * MS)
        image, scene = ahead.capture(500 * MS + lead, 7)
        for world in (ahead, at_time):
            world.set_pulses(500 * MS, 1200.0, 1500.0)  # takes hold after the dead time
        at_time.settle(500 * MS + lead)
        image_then, scene_then = at_time.capture(500 * MS + lead, 7)
        np.testing.assert_array_equal(image, image_then)
        assert scene == scene_then

    def test_a_scene_tells_pose_truth_and_reach(self) -> None:
        world = small_world()
        world.set_pulses(0, 1500.0, FORWARD_US)
        world.settle(1000 * MS)
        scene = world.capture(1000 * MS, 4)[1]
        assert (scene.t_ns, scene.index, scene.reach_m) == (1000 * MS, 4, 0.1)
        assert scene.car == world.plant.predicted(1000 * MS)
        assert scene.car.speed_mps > 0.5
        assert scene.truth.offset_m == pytest.approx(0.0, abs=0.02)  # straight on along a straight
        assert scene.truth.s_m == pytest.approx(0.5 + scene.car.distance_m + 0.13, abs=0.01)
        assert scene.truth.width_m == pytest.approx(0.4)

    def test_the_boards_pins_and_sensors_are_the_plants(self) -> None:
        world = small_world()
        world.set_pulses(0, 1500.0, FORWARD_US)
        ticks = world.read_sensors(1000 * MS).wheel_ticks
        assert ticks > 50
        assert world.read_sensors(2000 * MS).wheel_ticks > ticks

    def test_settling_lets_time_pass(self) -> None:
        world = small_world()
        world.settle(3 * MS)
        assert world.plant.now_ns == 3 * MS
        world.settle(2 * MS)  # never back
        assert world.plant.now_ns == 3 * MS


class TestLockStep:
    def test_frames_come_at_the_cameras_rate(self) -> None:
        source, clock, scenes = lock_step(rate_hz=60.0)
        frames = []
        for _ in range(120):
            frame = source.read(0.1)
            assert isinstance(frame, Frame)
            frames.append(frame)
            assert clock.now_ns() == frame.t_ns + 3 * MS  # the loop's own time
        assert [f.index for f in frames] == list(range(1, 121))
        assert [f.t_ns for f in frames] == [round(k * 1e9 / 60.0) for k in range(1, 121)]  # no drift
        assert [(s.t_ns, s.index) for s in scenes] == [(f.t_ns, f.index) for f in frames]
        assert frames[9].image[0, 0] == 10
        assert frames[9].image.shape == SHAPE

    def test_a_timeout_passes_in_virtual_time(self) -> None:
        source, clock, scenes = lock_step(rate_hz=50.0)
        assert source.read(0.008) is None
        assert clock.now_ns() == 8 * MS
        assert source.read(0.0) is None
        assert clock.now_ns() == 8 * MS
        assert not scenes
        frame = source.read(0.05)
        assert frame is not None
        assert (frame.t_ns, frame.index) == (20 * MS, 1)

    def test_frames_that_nobody_took_are_lost(self) -> None:
        source, clock, _ = lock_step(rate_hz=50.0)
        assert source.read(1.0) is not None
        clock.advance_to(115 * MS)  # frames 2 .. 4 are gone
        frame = source.read(1.0)
        assert frame is not None
        assert (frame.t_ns, frame.index, clock.now_ns()) == (100 * MS, 5, 118 * MS)
        again = source.read(1.0)
        assert again is not None
        assert (again.t_ns, again.index, clock.now_ns()) == (120 * MS, 6, 123 * MS)

    def test_a_loop_that_is_slower_than_the_camera_skips(self) -> None:
        source, clock, _ = lock_step(rate_hz=50.0, latency_ns=25 * MS)
        frames = [source.read(1.0) for _ in range(5)]  # taken up at 20, 45, 70, 95 and 120 ms
        assert [f.t_ns // MS for f in frames if f is not None] == [20, 40, 60, 80, 120]
        assert clock.now_ns() == 145 * MS

    def test_time_begins_where_the_clock_stands(self) -> None:
        world = small_world()
        world.settle(7_000 * MS)
        source = LockStepSource(world, settled_clock(world, 7_000 * MS), 50.0, 0, lambda scene: None)
        frame = source.read(1.0)
        assert frame is not None
        assert (frame.t_ns, frame.index) == (7_020 * MS, 1)

    def test_pulses_move_the_car_in_the_pictures(self) -> None:
        source, _, scenes = lock_step()
        pulses(source, 0, RIGHT_US, FORWARD_US)
        for _ in range(50):
            assert source.read(1.0) is not None
        ways = [scene.car.distance_m for scene in scenes]
        assert all(b >= a for a, b in itertools.pairwise(ways))
        assert ways[-1] > 0.5
        assert scenes[-1].car.yaw_rad < -0.2

    def test_two_runs_are_bit_same(self) -> None:
        told = []
        for _ in range(2):
            source, _, scenes = lock_step()
            pulses(source, 0, RIGHT_US, FORWARD_US)
            pictures = []
            for _ in range(30):
                frame = source.read(0.1)
                assert isinstance(frame, Frame)
                pictures.append(frame.image.tobytes())
            told.append((pictures, scenes))
        assert told[0] == told[1]
        source.close()
        source.close()

    def test_two_cameras_look_at_the_same_time(self) -> None:
        world = small_world(EyePair(CountingRenderer(), CountingRenderer(first=100)))
        source = LockStepSource(world, settled_clock(world), 50.0, 0, lambda scene: None)
        for index in (1, 2):
            frame = source.read(0.1)
            assert isinstance(frame, StereoFrame)
            assert (frame.t_ns, frame.index) == (index * 20 * MS, index)
            assert (frame.left[0, 0], frame.right[0, 0]) == (index, 100 + index)
            assert frame.left.shape == frame.right.shape == SHAPE


@pytest.mark.realtime
class TestRealTime:
    def test_frames_come_with_their_times_and_truth(self) -> None:
        scenes: list[Scene] = []
        world = RealTimeWorld(spawned_worlds.living, (), SHAPE, 50.0, scenes.append)
        try:
            assert world.port == "/dev/nowhere"
            frames: list[Frame] = []
            while len(frames) < 15:
                frame = world.read(10.0)
                assert isinstance(frame, Frame)
                assert frame.t_ns <= time.monotonic_ns()
                frames.append(frame)
        finally:
            world.close()
        times, indices = np.array([f.t_ns for f in frames]), np.array([f.index for f in frames])
        assert (np.diff(indices) >= 1).all()
        np.testing.assert_allclose(np.diff(times), np.diff(indices) * 20.0 * MS, atol=2)
        for frame, scene in zip(frames, scenes, strict=True):
            assert frame.image.shape == SHAPE
            assert frame.image[0, 0] == frame.index % 256
            assert (scene.t_ns, scene.index) == (frame.t_ns, frame.index)

    def test_a_pair_comes_whole(self) -> None:
        world = RealTimeWorld(spawned_worlds.seeing_double, (), (2, *SHAPE), 50.0, lambda scene: None, pair=True)
        try:
            frame = world.read(10.0)
        finally:
            world.close()
        assert isinstance(frame, StereoFrame)
        assert (frame.left[0, 0], frame.right[0, 0]) == (frame.index, 100 + frame.index)

    def test_nothing_in_time_is_none(self) -> None:
        world = RealTimeWorld(spawned_worlds.living, (), SHAPE, 0.05, lambda scene: None)
        try:
            assert world.read(0.0) is None
        finally:
            world.close()
            world.close()

    def test_a_process_that_dies_is_a_source_error(self) -> None:
        world = RealTimeWorld(spawned_worlds.dying, (), SHAPE, 100.0, lambda scene: None)
        try:
            with pytest.raises(SourceError, match="ended"):
                list(itertools.takewhile(lambda frame: frame is not None, iter(lambda: world.read(10.0), "never")))
        finally:
            world.close()

    def test_reading_after_the_end_is_a_source_error(self) -> None:
        world = RealTimeWorld(spawned_worlds.living, (), SHAPE, 50.0, lambda scene: None)
        world.close()
        with pytest.raises(SourceError):
            world.read(0.1)

    @pytest.mark.parametrize("factory", [spawned_worlds.stillborn, spawned_worlds.portless])
    def test_a_world_that_does_not_start_is_a_source_error(self, factory: object) -> None:
        with pytest.raises(SourceError, match="did not start"):
            RealTimeWorld(factory, (), SHAPE, 50.0, lambda scene: None)  # type: ignore[arg-type]
