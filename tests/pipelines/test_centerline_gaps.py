"""`centerline` behind a perfect mask where lines are missing, and over intersections."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from automodel.bench.accuracy import AccuracyMeter
from automodel.config import CarConfig
from automodel.signals import LaneStatus
from automodel.sim.track_files import load_track
from automodel.types import Image
from tests.support.masked_drives import MaskedDrive, arc, clothoid, errors, gap, line, road
from tests.support.rendered_drives import CAR, Seen, camera, with_camera
from tests.support.slow_lane import rest_slow

WIDE = with_camera(camera(focal_px=240.0))  # sees the other line also in a bend
STRAIGHT = line(14.0)
BENT = line(3.0) + clothoid(0.0, 0.5, 0.5) + arc(2.0, 1.5) + line(3.0)
TIGHT = line(3.0) + clothoid(0.0, 1.0, 0.4) + arc(1.0, 2.2) + line(3.0)


def meter(seen: list[Seen]) -> dict[str, float | None]:
    """The metrics of `bench accuracy`."""
    metrics = AccuracyMeter()
    for one in seen:
        metrics.add(one.frame.t_ns * 1e-9, one.estimate, one.truth)
    return metrics.row()


@pytest.mark.parametrize("side", rest_slow(("left", "right"), "left"))
@pytest.mark.parametrize(
    ("ahead", "car"), [(STRAIGHT, CAR), (BENT, WIDE), (TIGHT, WIDE)], ids=["straight", "2 m", "1 m"]
)
def test_one_line_missing_for_three_seconds(side: str, ahead: str, car: CarConfig) -> None:
    """At 1 m/s; the image ends some lanes ahead, so that more than 3 m have to be missing."""
    seen = MaskedDrive(track=road(ahead, gap(2.0, 5.8, side)), car=car).run(0.5, 6.8)
    missing = [i for i, s in enumerate(seen) if s.estimate.status is LaneStatus.ONE_LINE]
    assert len(missing) > 70
    for i in missing[5:-5]:
        estimate = seen[i].estimate
        assert estimate.left is not None
        assert estimate.right is not None
        assert (estimate.right if side == "left" else estimate.left).seen
        assert len((estimate.left if side == "left" else estimate.right).points_m) == 0
    found = errors(seen, skip=10)
    assert found.available == 1.0
    assert found.offset_max_m < 0.01  # 0.03 is asked for
    assert found.heading_max_deg < 5.0
    assert seen[-1].estimate.status is LaneStatus.TRACKING


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_line_that_is_missing_is_half_a_width_beside_the_middle(side: str) -> None:
    seen = MaskedDrive(track=road(STRAIGHT, gap(1.0, 9.0, side))).run(0.5, 3.0)
    for one in seen[30:]:
        estimate = one.estimate
        assert estimate.status is LaneStatus.ONE_LINE
        assert estimate.left is not None
        assert estimate.right is not None
        drawn = (estimate.left if side == "left" else estimate.right).curve.position(np.linspace(0.0, 1.0, 5))
        middle = np.array([0.2 if side == "left" else -0.2])
        y_m = one.truth.offset_m + (drawn[:, 0] - CAR.vehicle.reference_x_m) * np.sin(one.truth.heading_rad)
        assert drawn[:, 1] * np.cos(one.truth.heading_rad) + y_m == pytest.approx(np.repeat(middle, 5), abs=0.02)


def blanked(drive: MaskedDrive, from_m: float, to_m: float) -> Callable[[Image], Image]:
    """A mask that is empty while the car is on a stretch."""

    def change(mask: Image) -> Image:
        ahead = drive.lane.centerline.project((drive.oracle.pose.x_m, drive.oracle.pose.y_m))[0]
        return np.zeros_like(mask) if from_m <= ahead < to_m else mask

    return change


BENDS = {
    "straight": STRAIGHT,
    "left": line(3.0) + arc(1.0, 3.0),
    "tight left": line(3.0) + arc(0.8, 3.0),
    "tight right": line(3.0) + arc(0.8, -3.0),
}


@pytest.mark.parametrize("ahead", BENDS)
@pytest.mark.parametrize("from_m", rest_slow((1.9, 2.5, 3.5), 2.5))
def test_both_lines_hidden_for_half_a_second(ahead: str, from_m: float) -> None:
    """Before a bend, on its way in, and within it: at 1 m/s, a cloth over the camera."""
    drive = MaskedDrive(track=road(BENDS[ahead]))
    drive.oracle.change = blanked(drive, from_m, from_m + 0.5)
    seen = drive.run(from_m - 1.0, from_m + 1.8)
    found = errors(seen, skip=10)
    hidden = seen[31:44]
    assert {s.estimate.status for s in hidden} == {LaneStatus.COASTING}
    assert found.available == 1.0
    assert found.offset_max_m < 0.03  # 0.04 is asked for
    assert [s.estimate.frame_age_ns for s in hidden] == sorted(s.estimate.frame_age_ns for s in hidden)
    assert seen[48].estimate.frame_age_ns == 0


@pytest.mark.parametrize("ahead", [name for name in BENDS if name != "tight left"])  # there it is lost
@pytest.mark.parametrize("from_m", rest_slow((2.8, 3.4), 3.4))
def test_both_lines_gone_on_half_a_metre(ahead: str, from_m: float) -> None:
    """Half a second at 1 m/s over which nothing is painted."""
    drive = MaskedDrive(track=road(BENDS[ahead], gap(from_m, from_m + 0.5, "left", "right")))
    found = errors(drive.run(1.0, 5.2), skip=10)
    assert found.available == 1.0
    assert found.offset_max_m < 0.08


CROSSINGS = {  # where on the contest's floor a lane passes them [m]
    "forward": [(5.9, 7.7), (36.9, 38.9), (45.0, 48.6)],
    "reverse": [(12.1, 14.1), (46.5, 48.6), (55.9, 60.8)],  # the last over the end of the lap
}


@pytest.mark.parametrize("direction", CROSSINGS)
@pytest.mark.parametrize("which", rest_slow((0, 1, 2), 0))
def test_over_the_intersections_of_the_contest_floor(direction: str, which: int) -> None:
    """Two of them are passed one after the other; the lines stop, and zebra bars lie in the lane."""
    begin_m, end_m = CROSSINGS[direction][which]
    drive = MaskedDrive(track=load_track("tmr"), direction=direction, speed_mps=1.5)
    row = meter(drive.run(begin_m - 2.0, end_m)[15:])
    assert row["false_lane_pct"] == 0.0
    assert row["availability_pct"] == 100.0
    assert row["offset_mae_m"] is not None
    assert row["offset_mae_m"] < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("direction", ["forward", "reverse"])
def test_a_lap_of_the_contest_floor(direction: str) -> None:
    drive = MaskedDrive(track=load_track("tmr"), direction=direction, speed_mps=1.5)
    begin_m = 23.0
    seen = drive.run(begin_m, begin_m + drive.lane.centerline.length_m)
    row = meter(seen[10:])
    assert row["false_lane_pct"] == 0.0
    assert row["availability_pct"] == 100.0
    for key, most in (("offset_mae_m", 0.004), ("offset_p99_m", 0.05), ("heading_mae_deg", 0.6)):
        value = row[key]
        assert value is not None
        assert value <= most
    assert errors(seen, skip=10).offset_max_m < 0.1  # a crossing road is farther away
