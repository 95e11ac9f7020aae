"""`contour` on roads whose lane is known: errors, missing lines, blindness, and motion that is reported wrongly."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
import pytest

from automodel.config import CarConfig, LaneConfig, VehicleConfig
from automodel.geometry import SE2
from automodel.pipelines.contour import Contour
from automodel.signals import FALSE_LANE, LaneStatus, MotionSource
from automodel.sim.appearance import Appearance
from automodel.sim.track import Track
from tests.support.masked_drives import arc, gap, line, road
from tests.support.rendered_drives import CAR, RenderedDrive, Seen, camera, check_sound, with_camera

OFFSET_MAE_M, HEADING_MAE_RAD = 0.007, math.radians(0.8)
ROADS = {
    "straight": (line(8.0),),
    "tight_left": (line(1.5), arc(0.6, 3.0), line(3.0)),
    "tight_right": (line(1.5), arc(0.6, -3.0), line(3.0)),
    "bend": (line(1.5), arc(1.5, 2.5), line(3.0)),
    "s": (line(1.0), arc(1.0, 1.2), arc(1.0, -2.4), line(3.0)),
}
CAMERAS = {
    "askew": with_camera(camera(y_m=0.03, yaw_rad=0.08, roll_rad=0.05)),
    "barrel": with_camera(camera(focal_px=420.0, distortion=-0.3)),
    "320x240": with_camera(camera(320, 240, 240.0, pitch_rad=0.3)),
}
LONG_GAP_FROM_M, LONG_GAP_TO_M = 1.5, 6.0


def checked(seen: list[Seen]) -> list[Seen]:
    """What is reported is sound, and no lane is a false one."""
    for one in seen[::4]:
        check_sound(one.estimate, one.frame.t_ns)
    for one in seen:
        if one.estimate.valid:
            assert abs(one.offset_error_m) < FALSE_LANE * one.truth.width_m, one.frame.index
    return seen


def drive(track: Track, from_m: float, to_m: float, car: CarConfig = CAR, **options) -> list[Seen]:
    return checked(RenderedDrive(track=track, car=car, pipeline=Contour(car), **options).run(from_m, to_m))


@lru_cache(maxsize=2)
def driven(name: str) -> list[Seen]:
    return drive(road(*ROADS[name]), 0.3, 5.0)


def driven_again(name: str, car: CarConfig = CAR, **motion) -> list[Seen]:
    """The same images, where something else is said of the car's motion."""
    pipeline = Contour(car)
    return checked([replace(s, estimate=pipeline.step(s.frame, replace(s.motion, **motion))) for s in driven(name)])


def mean_errors(seen: Sequence[Seen]) -> tuple[float, float]:
    """Mean absolute errors of offset [m] and heading [rad]."""
    reported = [s for s in seen if s.estimate.valid]
    assert reported, "no estimate at all"
    offset = float(np.mean([abs(s.offset_error_m) for s in reported]))
    return offset, float(np.mean([abs(s.heading_error_rad) for s in reported]))


def check_errors(seen: Sequence[Seen], scale: float = 1.0) -> None:
    offset, heading = mean_errors(seen)
    assert offset <= OFFSET_MAE_M * scale
    assert heading <= HEADING_MAE_RAD


def runs(seen: Sequence[Seen]) -> list[LaneStatus]:
    """The statuses in their order, each as often as it came anew."""
    every = [s.estimate.status for s in seen]
    return [status for i, status in enumerate(every) if i == 0 or every[i - 1] is not status]


def count(seen: Sequence[Seen], status: LaneStatus) -> int:
    return sum(s.estimate.status is status for s in seen)


@pytest.mark.parametrize("name", ROADS)
def test_a_lane_is_followed(name: str) -> None:
    seen = driven(name)
    later = seen[6:]  # where the first frames show a bend's two lines, they may be those of the lane beside it too
    assert all(s.estimate.status in (LaneStatus.TRACKING, LaneStatus.ONE_LINE) for s in later)
    assert len(seen) == 141
    check_errors(seen)
    if name == "straight":
        assert count(seen, LaneStatus.TRACKING) == len(seen)
    widths = [s.estimate.pose.width_m for s in seen[10:] if s.estimate.pose]
    assert np.abs(np.array(widths) - 0.4).max() < 0.02


@pytest.mark.parametrize("update", ["gauss_newton", "gradient_descent"])
def test_the_curvature_is_that_of_the_road(update: str) -> None:
    options = replace(CAR.pipeline, contour=replace(CAR.pipeline.contour, update=update))
    seen = driven_again("bend", replace(CAR, pipeline=options))
    check_errors(seen)
    inside = [s for s in seen if s.truth.curvature_per_m > 0.0][15:]
    reported = [s.estimate.pose.curvature_per_m for s in inside if s.estimate.pose]
    assert len(reported) == len(inside) > 40
    assert np.abs(np.array(reported) - 1.0 / 1.5).mean() < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("name", CAMERAS)
def test_other_cameras(name: str) -> None:
    seen = drive(road(*ROADS["s"]), 0.3, 3.5, CAMERAS[name], rate_hz=20.0)
    assert all(s.estimate.valid for s in seen)
    check_errors(seen)


def test_dark_markings_on_a_bright_floor() -> None:
    car = replace(CAR, lane=replace(CAR.lane, markings="dark"))
    look = Appearance(floor_grey=200.0, marking_grey=40.0)
    track = road(*ROADS["bend"])
    seen = drive(track, 0.3, 3.0, car, look=look)
    assert all(s.estimate.valid for s in seen)
    check_errors(seen)
    wrong_polarity = drive(track, 0.3, 1.0, look=look)
    assert not any(s.estimate.valid for s in wrong_polarity)


@pytest.mark.parametrize("side", ["left", "right"])
def test_one_line_is_enough(side: str) -> None:
    for pieces in ((line(9.0),), (line(1.0), arc(4.0, 1.5), line(3.0))):
        seen = drive(road(*pieces, gap(1.5, 4.0, side)), 0.3, 5.0, rate_hz=20.0)
        assert all(s.estimate.valid for s in seen)
        assert count(seen, LaneStatus.COASTING) == 0
        check_errors(seen)
        within = [s for s in seen if s.estimate.status is LaneStatus.ONE_LINE]
        assert len(within) > 25
        check_errors(within)
        line_there = [s.estimate.right if side == "left" else s.estimate.left for s in within]
        assert all(one is not None and one.seen for one in line_there)
        assert seen[-1].estimate.status is LaneStatus.TRACKING


@pytest.mark.parametrize("pieces", [(line(9.0),), (line(1.0), arc(3.0, 1.8), line(3.0))], ids=["straight", "bend"])
def test_half_a_second_without_lines_is_coasted(pieces: tuple[str, ...]) -> None:
    seen = drive(road(*pieces, gap(2.5, 3.8, "left", "right")), 0.3, 5.0)
    blind = [s for s in seen if s.estimate.status is LaneStatus.COASTING]
    assert len(blind) >= 10
    assert all(s.estimate.valid for s in seen)
    check_errors(blind)
    check_errors(seen)
    assert seen[-1].estimate.status is LaneStatus.TRACKING


def test_a_long_blindness_loses_the_lane_and_it_is_found_again() -> None:
    seen = drive(road(line(12.0), gap(LONG_GAP_FROM_M, LONG_GAP_TO_M, "left", "right")), 0.3, 7.5)
    assert LaneStatus.LOST in runs(seen)
    lost = next(i for i, s in enumerate(seen) if s.estimate.status is LaneStatus.LOST)
    found = next(i for i in range(lost, len(seen)) if seen[i].estimate.valid)
    options = CAR.pipeline.contour
    bound_s = min(options.coast_s, options.coast_lanes * CAR.lane.width_m / 1.0)
    assert 0.5 <= count(seen[:lost], LaneStatus.COASTING) / 30.0 <= bound_s + 0.1
    assert not any(s.estimate.valid for s in seen[lost:found])
    assert LONG_GAP_TO_M - 1.2 < seen[found].truth.s_m < LONG_GAP_TO_M  # as soon as lines come into view
    ages = [s.estimate.frame_age_ns for s in seen[lost:found]]
    assert all(after > before for before, after in pairwise(ages))
    again = seen[found:]
    assert len(again) > 30
    assert all(s.estimate.valid for s in again)
    check_errors(again[10:])
    assert again[-1].estimate.status is LaneStatus.TRACKING


@pytest.mark.parametrize("factor", [0.8, 1.2])
def test_a_wrong_speed_loses_nothing(factor: float) -> None:
    seen = driven_again("s", speed_mps=factor)  # the true one is 1 m/s
    assert all(s.motion.speed_mps == pytest.approx(1.0, rel=0.15) for s in seen)
    assert all(s.estimate.valid for s in seen)
    offset, heading = mean_errors(seen)
    assert offset <= 0.013
    assert heading <= math.radians(2.6)


@pytest.mark.parametrize("name", ["bend", "s"])
def test_without_odometry(name: str) -> None:
    seen = driven_again(name, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)
    assert all(s.estimate.valid for s in seen)
    offset, heading = mean_errors(seen)
    assert offset <= 0.02
    assert heading <= math.radians(6.0)


def test_a_width_that_changes_is_followed() -> None:
    for width in (0.34, 0.46):
        seen = drive(
            road(line(20.0), widths=((0.0, 0.4), (1.0, 0.4), (4.5, width), (12.0, width))), 0.3, 6.0, rate_hz=20.0
        )
        assert all(s.estimate.valid for s in seen)
        check_errors(seen)
        reported = [s.estimate.pose.width_m for s in seen if s.estimate.pose]
        assert max(abs(w - s.truth.width_m) for w, s in zip(reported[5:], seen[5:], strict=True)) < 0.02
        assert reported[-1] == pytest.approx(width, abs=0.005)


def test_points_and_curves_lie_on_the_lines() -> None:
    drive = RenderedDrive(track=road(*ROADS["s"]), rate_hz=15.0, pipeline=Contour(CAR))
    seen = drive.run(0.5, 4.5)
    for one in seen[2::6]:
        estimate, pose = one.estimate, drive.pose(0.5 + one.frame.index / drive.rate_hz)
        assert estimate.left is not None
        assert estimate.right is not None
        assert estimate.centerline is not None
        for reported, true in ((estimate.left, drive.lane.left), (estimate.right, drive.lane.right)):
            if reported.seen:
                away = [abs(true.project(p)[1]) for p in pose.apply(reported.points_m)]
                assert np.quantile(away, 0.8) < 0.01
        along = estimate.centerline.position(np.linspace(0.0, estimate.centerline.length_m, 60))
        near = [(x, y) for x, y in along if 0.13 < x < 0.7]
        assert len(near) > 8
        aside = [abs(drive.lane.centerline.project(p)[1]) for p in pose.apply(near)]
        assert np.mean(aside) < 0.01
        assert max(aside) < 0.05  # where the bend turns about


@pytest.mark.slow
def test_competition_light() -> None:
    seen = drive(road(*ROADS["bend"]), 0.3, 4.0, look=Appearance.random(4, "competition"), rate_hz=20.0)
    settled = seen[10:]
    assert sum(s.estimate.valid for s in settled) >= 0.99 * len(settled)
    check_errors(settled)


class Leaving(RenderedDrive):
    """Along the middle until 3.0 m, then out of the lane to the left."""

    def pose(self, s_m: float) -> SE2:
        out = max(s_m - 3.0, 0.0)
        return self.lane.pose(s_m, 0.25 * out, math.atan(0.25) if out > 0.0 else 0.0)


def test_a_lane_that_was_followed_is_kept_when_the_car_leaves_it() -> None:
    seen = Leaving(track=road(line(9.0)), pipeline=Contour(CAR)).run(2.0, 4.15)
    outside = [s for s in seen if 0.57 < s.truth.offset_m / s.truth.width_m < 0.7]
    assert len(outside) >= 5
    for one in outside:
        assert one.estimate.valid
        assert abs(one.offset_error_m) < FALSE_LANE * one.truth.width_m


def test_a_full_size_lane() -> None:
    car = replace(
        with_camera(camera(focal_px=500.0, x_m=1.5, z_m=1.2, pitch_rad=0.12)),
        lane=LaneConfig(width_m=3.7, marking_width_m=0.15),
        vehicle=VehicleConfig(wheelbase_m=2.7, reference_x_m=1.3, width_m=1.8),
    )
    track = road(line(40.0), arc(150.0, 0.8), arc(150.0, -0.6), width_m=3.7, marking_m=0.15)
    seen = drive(track, 5.0, 130.0, car, speed_mps=25.0, rate_hz=20.0)
    assert all(s.estimate.valid for s in seen)
    check_errors(seen, 3.7 / 0.4)
