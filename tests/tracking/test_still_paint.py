"""Lines that stand still, and lines that do not."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import pytest

from automodel.config import CarConfig
from automodel.geometry.se2 import SE2
from automodel.signals import EXCEEDED
from automodel.tracking.belief import RoadModel
from automodel.tracking.frame_motion import FrameMotion
from automodel.tracking.integrity import ANGLE_RAD, chi_square
from automodel.tracking.still_paint import Slip, StillPaint
from automodel.types import FloatArray

WIDTH_M, STEP_M, NEAR_M, FAR_M, UP_M = 0.4, 0.02, 0.45, 1.4, 0.2
ROAD = RoadModel(
    lane_width_m=WIDTH_M,
    marking_width_m=0.02,
    eye_m=(0.2, UP_M),
    pitch_rad=ANGLE_RAD,
    pixel_rad=0.33 / CarConfig().camera.intrinsics.fx_px,
)
CONTRADICTS = chi_square(EXCEEDED)
STILL = SE2()
BENDS = (0.0, 1.0, -1.0)  # [1/m], of a radius of 1 m the tightest that students drive


class Car:
    """Drives in the middle of a road of one curvature, and sees both its lines; `odd`: what the camera does besides."""

    def __init__(self, bend_per_m: float, noise_m: float = 0.0, seed: int = 0) -> None:
        self._bend, self._noise_m, self._rng = bend_per_m, noise_m, np.random.default_rng(seed)
        self.paint = StillPaint(WIDTH_M)
        self._driven_m = 0.0

    def step(
        self, sees: SE2 = STILL, *, turns_rad: float = 0.0, nod_rad: float = 0.0, sides: str = "lr"
    ) -> Slip | None:
        """A step ahead; by the odometry it turned by `turns_rad` more. What is seen is moved by `sees`."""
        turn_rad = self._bend * STEP_M
        self.paint.move(FrameMotion(distance_m=STEP_M, turn_rad=turn_rad + turns_rad, dt_s=0.02, known=True))
        self._driven_m += STEP_M
        lines = [
            self._line(side, nod_rad) if name in sides else np.empty((0, 2)) for name, side in (("l", 1), ("r", -1))
        ]
        return self.paint.look([sees.apply(line) if len(line) else line for line in lines], ROAD, CONTRADICTS)

    def _line(self, side: int, nod_rad: float) -> FloatArray:
        """Points at the same places along the road in each frame, of those that are in view: paint."""
        spacing_m = 0.12
        first = math.ceil((self._driven_m + NEAR_M) / spacing_m)
        s = np.arange(first, (self._driven_m + FAR_M) / spacing_m) * spacing_m - self._driven_m
        angle = self._bend * s
        x = s * np.sinc(angle / math.pi)
        y = 0.5 * self._bend * s**2 * np.sinc(0.5 * angle / math.pi) ** 2
        left = 0.5 * side * WIDTH_M
        points = np.stack((x - left * np.sin(angle), y + left * np.cos(angle)), axis=1)
        ahead, aside = points[:, 0] - ROAD.eye_m[0], points[:, 1]
        points += nod_rad / UP_M * np.stack((ahead**2 + UP_M**2, ahead * aside), axis=1)
        return points + self._rng.normal(0.0, self._noise_m, points.shape)


def squares(slips: Sequence[Slip | None]) -> FloatArray:
    return np.array([slip.square for slip in slips if slip is not None])


@pytest.mark.parametrize("bend_per_m", BENDS)
def test_paint_stands_still_however_the_road_bends(bend_per_m: float) -> None:
    car = Car(bend_per_m)
    seen = squares([car.step() for _ in range(80)])
    assert len(seen) == 79
    assert seen.max() < 0.1


@pytest.mark.parametrize("bend_per_m", BENDS)
def test_noise_contradicts_the_odometry_no_oftener_than_a_bound_is_exceeded(bend_per_m: float) -> None:
    sigma_m = ROAD.point_markings * ROAD.marking_width_m  # twice what was measured
    seen = np.concatenate(
        [squares([car.step() for _ in range(60)]) for car in (Car(bend_per_m, sigma_m, seed) for seed in range(40))]
    )
    assert (seen > CONTRADICTS).mean() <= EXCEEDED


@pytest.mark.parametrize("bend_per_m", BENDS)
@pytest.mark.parametrize("turn_rad", [0.15, -0.15])
def test_lines_that_turn_are_told_from_a_bend(bend_per_m: float, turn_rad: float) -> None:
    car = Car(bend_per_m)
    for _ in range(40):
        car.step()
    slip = car.step(SE2(0.0, 0.0, turn_rad))
    assert slip is not None
    assert slip.square > CONTRADICTS
    assert slip.turn_rad == pytest.approx(turn_rad, abs=0.02)


def test_a_car_that_turns_otherwise_than_its_odometry_says_sees_its_lines_turn() -> None:
    car = Car(0.0)
    slips = [car.step(turns_rad=0.01) for _ in range(20)]  # the other way than the lines then seem to
    last = slips[-1]
    assert last is not None
    assert last.square > CONTRADICTS
    assert last.turn_rad == pytest.approx(0.19, abs=0.03)


@pytest.mark.parametrize("sides", ["lr", "l", "r"])
@pytest.mark.parametrize("bend_per_m", BENDS)
def test_a_nod_is_no_turn(sides: str, bend_per_m: float) -> None:
    car = Car(bend_per_m)
    seen = squares([car.step(nod_rad=1.5 * ANGLE_RAD * math.sin(0.4 * k), sides=sides) for k in range(80)])
    assert seen.max() < CONTRADICTS


def test_what_was_seen_before_a_gap_is_not_forgotten() -> None:
    car = Car(0.0)
    for _ in range(40):
        car.step()
    assert [car.step(sides="") for _ in range(10)] == [None] * 10
    slip = car.step(SE2(0.0, 0.0, 0.2))
    assert slip is not None
    assert slip.turn_rad == pytest.approx(0.2, abs=0.03)


def test_lines_that_were_contradicted_are_compared_until_the_car_has_passed_them() -> None:
    car = Car(0.0)
    for _ in range(40):
        car.step()
    turned = [car.step(SE2(0.0, 0.0, 0.2)) for _ in range(25)]  # half a metre, more than a lane width
    assert squares(turned).min() > CONTRADICTS
    back = car.step()
    assert back is not None
    assert back.square < 0.1


def test_a_camera_that_is_turned_sees_its_lines_slide_aside() -> None:
    car = Car(0.0)
    for _ in range(60):
        slip = car.step(SE2(0.0, 0.0, 0.2))
    assert slip is not None
    assert slip.square > CONTRADICTS
    assert slip.turn_rad == pytest.approx(0.0, abs=0.02)


def test_other_lines_that_do_not_touch_the_old_ones_say_nothing() -> None:
    car = Car(0.0)
    for _ in range(40):
        car.step(sides="l")
    assert car.step(sides="r") is None


def test_an_unknown_motion_forgets_all_lines() -> None:
    car = Car(0.0)
    for _ in range(40):
        car.step()
    car.paint.move(FrameMotion(distance_m=0.0, turn_rad=0.0, dt_s=0.02, known=False))
    assert car.step(SE2(0.0, 0.0, 0.5)) is None


def test_two_points_tell_nothing() -> None:
    paint = StillPaint(WIDTH_M)
    line = np.array(((0.5, 0.2), (1.0, 0.2)))
    for _ in range(3):
        paint.move(FrameMotion(distance_m=STEP_M, turn_rad=0.0, dt_s=0.02, known=True))
        assert paint.look([line, np.empty((0, 2))], ROAD, CONTRADICTS) is None


def test_a_smaller_error_of_the_odometry_makes_a_smaller_turn_a_contradiction() -> None:
    told = []
    for turn_rad in (ROAD.turn_rad, 0.1):
        car, road = Car(0.0), dataclasses.replace(ROAD, turn_rad=turn_rad)
        for _ in range(40):
            car.step()
        line = np.stack((np.linspace(0.45, 1.4, 9), np.full(9, 0.2)), axis=1)
        moved = SE2(0.0, 0.0, 0.1).apply(line)
        slip = car.paint.look([moved, np.empty((0, 2))], road, CONTRADICTS)
        assert slip is not None
        told.append(slip.square)
    assert told[0] > 2.0 * told[1]
