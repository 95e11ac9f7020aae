"""A car's two cameras before it is armed: the right pair, swapped ones, one that was turned; when it is looked at."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from automodel.assembly import pair_check
from automodel.assembly.pair_check import SWAPPED, PairCheck
from automodel.assembly.parts import make_checks
from automodel.assembly.simulated_car import appearance, renderers
from automodel.bench.faults.hooks import eye_turned
from automodel.cli.init import kit_path
from automodel.config import CarConfig, load_car
from automodel.perception.stereo.pair_evidence import PairEvidence
from automodel.signals import LaneEstimate, LaneStatus, Motion, StereoFrame, VehicleState
from automodel.sim.track_files import load_track
from automodel.types import Image

PERIOD_NS = 16_666_667
CAR = load_car(kit_path("sim-stereo"))
BLANK = np.full((CAR.camera.height_px, CAR.camera.width_px), 90, np.uint8)


def view(car: CarConfig) -> tuple[Image, Image]:
    """What both cameras of a car see on tmr."""
    track = load_track("tmr")
    lane = track.lane()
    start = lane.pose(0.13 * lane.centerline.length_m, 0.0)
    eyes = renderers(track, car, appearance("competition", 3))
    left, right = (eye.render(start.x_m, start.y_m, start.yaw_rad, 0.0, 0.0, 1) for eye in eyes)
    return left, right


def with_turned_right(pitch_rad: float) -> CarConfig:
    left, right = CAR.camera.eyes
    place = eye_turned(1, 0.0, pitch_rad, 0.0)((left, right))[1].extrinsics
    assert CAR.camera.right is not None
    second = dataclasses.replace(CAR.camera.right, extrinsics=place)
    return dataclasses.replace(CAR, camera=dataclasses.replace(CAR.camera, right=second))


@pytest.fixture(scope="module")
def eyes() -> tuple[Image, Image]:
    return view(CAR)


def pair(index: int, images: tuple[Image, Image]) -> StereoFrame:
    return StereoFrame(t_ns=index * PERIOD_NS, index=index, left=images[0], right=images[1])


def test_the_pair_of_car_toml_is_not_refused(eyes: tuple[Image, Image]) -> None:
    check = PairCheck(CAR)
    assert [check.step(pair(index, eyes), armed=False) for index in range(4)] == [None] * 4


def test_swapped_cameras_are_refused_with_the_first_pair(eyes: tuple[Image, Image]) -> None:
    assert PairCheck(CAR).step(pair(0, eyes[::-1]), armed=False) == SWAPPED


@pytest.mark.parametrize("deg", [-2.0, 2.0])
def test_a_turned_camera_is_refused(deg: float) -> None:
    text = PairCheck(CAR).step(pair(0, view(with_turned_right(math.radians(deg)))), armed=False)
    assert text is not None
    assert text.startswith("a camera of the pair is turned by about 2 deg against car.toml")


def test_a_car_that_is_armed_is_not_looked_at(eyes: tuple[Image, Image]) -> None:
    check = PairCheck(CAR)
    assert [check.step(pair(index, eyes[::-1]), armed=True) for index in range(40)] == [None] * 40


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """How often each part of a look was done."""
    counts = {"find_corners": 0, "weigh": 0}
    for name in counts:
        part = getattr(pair_check, name)

        def counting(*args: object, name: str = name, part: object = part) -> object:
            counts[name] += 1
            return part(*args)  # type: ignore[operator]

        monkeypatch.setattr(pair_check, name, counting)
    return counts


def test_later_looks_are_spread_and_there_are_two_while_arming_takes(
    eyes: tuple[Image, Image], counted: dict[str, int]
) -> None:
    check = PairCheck(CAR)
    steps = []
    for index in range(31):  # half a second
        before = sum(counted.values())
        check.step(pair(index, eyes), armed=False)
        steps.append(sum(counted.values()) - before)
    assert steps[0] == 3
    assert max(steps[1:]) == 1
    assert counted["weigh"] == 2
    check.step(pair(32, eyes), armed=False)
    check.step(pair(33, eyes), armed=False)
    assert check.step(pair(34, eyes), armed=False) is None
    assert counted["weigh"] == 3


def looks(monkeypatch: pytest.MonkeyPatch, *found: tuple[float, float]) -> list[str | None]:
    """What is said after each look with this evidence, of exchanged cameras and of turned ones."""
    left = list(found)

    def weigh(*args: object) -> PairEvidence:
        exchanged, other = left.pop(0)
        return PairEvidence(matched=9, fitting=5.0, exchanged=exchanged, turned=other, turned_rad=(0.0, 0.0, -0.05))

    monkeypatch.setattr(pair_check, "weigh", weigh)
    check, images = PairCheck(CAR), (BLANK, BLANK)
    said = [check.step(pair(0, images), armed=False)]
    for index in range(1, 20 * len(found)):
        if not left:
            break
        before = len(left)
        text = check.step(pair(index, images), armed=False)
        if len(left) < before:
            said.append(text)
    return said


def test_a_look_that_says_little_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    assert looks(monkeypatch, (13.0, 13.0), (14.0, 0.0), (0.0, 0.0), (-4.0, -4.0), (-5.0, -5.0)) == [
        None, SWAPPED, SWAPPED, SWAPPED, None,
    ]  # fmt: skip


def test_the_text_of_a_turned_camera_stays_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    said = looks(monkeypatch, (0.0, 14.0), (-9.0, 30.0), (-9.0, -3.0))
    assert said[0] is not None
    assert "turned by about 3 deg" in said[0]
    assert len(set(said)) == 1


def test_the_checks_of_a_run_refuse_a_pair_until_it_is_armed(eyes: tuple[Image, Image]) -> None:
    checks, lost = make_checks(CAR), LaneEstimate(t_ns=0, status=LaneStatus.LOST)
    motion = Motion(t_ns=0, speed_mps=0.0, yaw_rate_radps=0.0)
    first = pair(0, eyes[::-1])
    assert checks.of_frame(first) == ()
    assert checks.of_estimate(lost, motion, VehicleState(t_ns=0, armed=True)) == ()
    assert checks.of_estimate(lost, motion, VehicleState(t_ns=0, armed=False)) == (SWAPPED,)
    anew = make_checks(CAR)
    assert anew.of_estimate(lost, motion, None) == ()  # without a pair there is nothing to look at


def test_a_car_whose_cameras_are_no_pair_has_no_such_check() -> None:
    place = dataclasses.replace(CAR.camera.right, extrinsics=CAR.camera.extrinsics)  # type: ignore[type-var]
    car = dataclasses.replace(CAR, camera=dataclasses.replace(CAR.camera, right=place))
    with pytest.raises(ValueError, match="same place"):
        PairCheck(car)
    assert pair_check.pair_check(car) is None
    single = dataclasses.replace(CAR, camera=dataclasses.replace(CAR.camera, right=None))
    assert pair_check.pair_check(single) is None
    checks = make_checks(single)
    checks.of_frame(pair(0, view(CAR)[::-1]))
    motion = Motion(t_ns=0, speed_mps=0.0, yaw_rate_radps=0.0)
    assert checks.of_estimate(LaneEstimate(t_ns=0, status=LaneStatus.LOST), motion, None) == ()
