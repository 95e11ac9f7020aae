"""Paint stays where it is on the ground, a reflection goes with the car."""

from __future__ import annotations

import math

import numpy as np
import pytest

from automodel.config import CarConfig
from automodel.geometry import SE2, BirdsEye, GroundCamera, View
from automodel.perception.markings.binary_views import TemporalPaintCheck
from tests.support.drawn_views import binary, disc, line_at, seen_from

LANE_M, MARKING_M = 0.4, 0.03
VIEW = View(x_near_m=0.36, x_far_m=1.56, half_width_m=0.64, m_per_px=0.01)
MASK = BirdsEye(GroundCamera.from_config(CarConfig().camera), VIEW).mask
EVERYWHERE = np.full_like(MASK, 255)
STEP_M = 0.025
PAINT = (line_at(0.2), line_at(-0.2))
MIRRORED = disc(1.0, 0.02, 0.05)


def drive(
    check: TemporalPaintCheck, way_m: float, curvature_per_m: float = 0.0, mirrored: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """The last view, as it was filtered and as it was checked."""
    car, before_from_after = SE2(), SE2.arc(STEP_M, curvature_per_m * STEP_M)
    lines = checked = EVERYWHERE
    for _ in range(round(way_m / STEP_M)):
        car = car @ before_from_after
        check.move(before_from_after, STEP_M)
        shapes = [seen_from(shape, car) for shape in PAINT]
        lines = binary(VIEW, *shapes, *([MIRRORED] if mirrored else []), samples=2) & MASK
        checked = check.step(lines)
        check.remember(lines)
    return lines, checked


@pytest.mark.parametrize("curvature_per_m", [0.0, 0.5, -0.5])
def test_what_goes_with_the_car_is_removed_and_paint_stays(curvature_per_m: float) -> None:
    check = TemporalPaintCheck(VIEW, MASK, LANE_M, MARKING_M)
    lines, checked = drive(check, 0.8, curvature_per_m)
    blob = binary(VIEW, MIRRORED) > 0
    paint = (lines > 0) & ~blob
    assert (checked[blob] > 0).mean() < 0.1
    assert (checked[paint] > 0).mean() > 0.98
    assert not (checked & ~lines).any()  # nothing is added


def test_before_enough_way_everything_passes() -> None:
    check = TemporalPaintCheck(VIEW, MASK, LANE_M, MARKING_M)
    lines, checked = drive(check, 0.25)
    np.testing.assert_array_equal(checked, lines)


def test_standing_still_removes_nothing() -> None:
    check = TemporalPaintCheck(VIEW, MASK, LANE_M, MARKING_M)
    lines = binary(VIEW, *PAINT, MIRRORED)
    for _ in range(50):
        check.move(SE2(), 0.0)
        np.testing.assert_array_equal(check.step(lines), lines)
        check.remember(lines)


def test_forgetting_begins_anew() -> None:
    check = TemporalPaintCheck(VIEW, MASK, LANE_M, MARKING_M)
    drive(check, 0.8)
    check.forget()
    lines = binary(VIEW, *PAINT, MIRRORED)
    np.testing.assert_array_equal(check.step(lines), lines)
    lines, checked = drive(check, 0.25)
    np.testing.assert_array_equal(checked, lines)


def test_what_was_out_of_sight_passes() -> None:
    check = TemporalPaintCheck(VIEW, MASK, LANE_M, MARKING_M)
    drive(check, 0.8, mirrored=False)
    # the car sees 0.4 m further than it did a lane width earlier: a mark there may be new
    far = binary(VIEW, disc(1.5, 0.0, 0.03))
    assert far.any()
    np.testing.assert_array_equal(check.step(far) > 0, far > 0)
    near = binary(VIEW, disc(0.8, 0.0, 0.03)) & MASK
    assert not check.step(near).any()  # the same mark on ground that was bare


def test_a_turn_on_the_spot_turns_the_views() -> None:
    check = TemporalPaintCheck(VIEW, EVERYWHERE, LANE_M, MARKING_M)
    check.remember(binary(VIEW, *PAINT))
    motion = SE2(0.0, 0.0, math.radians(12.0))
    check.move(motion, 1.1 * LANE_M)  # wheels that slip: the distance counts, the place stays
    here = binary(VIEW, *(seen_from(shape, motion) for shape in PAINT))
    assert (check.step(here)[here > 0] > 0).mean() > 0.98
    wrong = binary(VIEW, *(seen_from(shape, motion.inverse()) for shape in PAINT))
    assert (check.step(wrong)[wrong > 0] > 0).mean() < 0.7
