"""The checks of a car with two cameras: swapped ones are refused before the car is armed; when they are looked at."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from automodel.assembly import pair_checks
from automodel.assembly.pair_checks import SWAPPED, PairChecks
from automodel.assembly.parts import make_checks
from automodel.assembly.simulated_car import appearance, renderers
from automodel.cli.init import kit_path
from automodel.config import load_car
from automodel.perception.stereo.points import RigCheck
from automodel.pipelines.stereo import Stereo
from automodel.runtime.input_checks import InputChecks
from automodel.signals import Frame, LaneEstimate, LaneStatus, Motion, StereoFrame, VehicleState
from automodel.sim.track_files import load_track
from automodel.types import Image

PERIOD_NS = 100_000_000
CAR = load_car(kit_path("sim-stereo"))
BLANK = np.full((CAR.camera.height_px, CAR.camera.width_px), 90, np.uint8)
LOST = LaneEstimate(t_ns=0, status=LaneStatus.LOST)
STILL = Motion(t_ns=0, speed_mps=0.0, yaw_rate_radps=0.0)
UNARMED, ARMED = (VehicleState(t_ns=0, armed=armed) for armed in (False, True))


def checks_of_pairs() -> PairChecks:
    checks = make_checks(CAR)
    assert isinstance(checks, PairChecks)
    return checks


def said(checks: InputChecks, index: int, images: tuple[Image, Image], state: VehicleState | None) -> tuple[str, ...]:
    """What is wrong with the estimate of a pair."""
    pair = StereoFrame(t_ns=index * PERIOD_NS, index=index, left=images[0], right=images[1])
    checks.of_frame(pair, pair)
    return checks.of_estimate(LOST, STILL, state)


@pytest.fixture(scope="module")
def eyes() -> tuple[Image, Image]:
    """What both cameras see on tmr."""
    track = load_track("tmr")
    lane = track.lane()
    start = lane.pose(0.2 * lane.centerline.length_m, 0.0)
    left, right = (
        eye.render(start.x_m, start.y_m, start.yaw_rad, 0.0, 0.0, 1)
        for eye in renderers(track, CAR, appearance("competition", 3))
    )
    return left, right


def test_swapped_cameras_are_refused_with_the_first_pair_until_the_car_is_armed(eyes: tuple[Image, Image]) -> None:
    assert said(checks_of_pairs(), 0, eyes, None) == ()
    checks = checks_of_pairs()
    assert said(checks, 0, eyes[::-1], ARMED) == ()
    assert said(checks, 1, eyes[::-1], UNARMED) == (SWAPPED,)
    assert said(checks, 2, eyes[::-1], None) == (SWAPPED,)
    assert said(checks, 3, eyes[::-1], ARMED) == ()


class Looks:
    """Looks with these sigmas, one after another."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *sigmas: float) -> None:
        self.left = list(sigmas)
        monkeypatch.setattr(pair_checks, "check_rig", self._check)

    def _check(self, *args: object) -> RigCheck:
        sigmas = self.left.pop(0)
        as_given, exchanged = (round(50 + sign * 5 * sigmas) for sign in (1, -1))  # (a - b) / sqrt(a + b)
        return RigCheck(matched=100, rigid=0, error_px=0.0, as_given=as_given, exchanged=exchanged)


def test_the_mean_of_a_look_a_second_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    looks, checks = Looks(monkeypatch, -2.8, -4.0, -3.0, 2.0, 0.0), checks_of_pairs()
    refused = [said(checks, index, (BLANK, BLANK), UNARMED) == (SWAPPED,) for index in range(41)]
    assert refused == [False] * 10 + [True] * 20 + [False] * 11
    assert looks.left == []


def test_a_pair_that_is_the_right_one_is_not_looked_at_again(monkeypatch: pytest.MonkeyPatch) -> None:
    looks, checks = Looks(monkeypatch, 3.2, -9.0), checks_of_pairs()
    assert all(said(checks, index, (BLANK, BLANK), UNARMED) == () for index in range(30))
    assert looks.left == [-9.0]


def test_a_car_that_is_armed_is_not_looked_at_nor_is_a_single_image(monkeypatch: pytest.MonkeyPatch) -> None:
    looks, checks = Looks(monkeypatch, -9.0), checks_of_pairs()
    assert all(said(checks, index, (BLANK, BLANK), ARMED) == () for index in range(30))
    alone = Frame(t_ns=30 * PERIOD_NS, index=30, image=BLANK)
    checks.of_frame(StereoFrame(t_ns=alone.t_ns, index=30, left=BLANK, right=BLANK), alone)
    assert checks.of_estimate(LOST, STILL, UNARMED) == ()
    assert looks.left == [-9.0]


def test_cameras_that_are_no_calibrated_pair_have_the_checks_of_any_car() -> None:
    second = CAR.camera.right
    assert second is not None
    place = dataclasses.replace(second, extrinsics=CAR.camera.extrinsics)
    for right in (place, None):
        car = dataclasses.replace(CAR, camera=dataclasses.replace(CAR.camera, right=right))
        with pytest.raises(ValueError, match=r"same place|needs two"):
            Stereo.rig(car)
        assert type(make_checks(car)) is InputChecks
