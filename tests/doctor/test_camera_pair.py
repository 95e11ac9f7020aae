"""What the doctor makes of two cameras: every limit from both sides."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from automodel.assembly.simulated_car import Simulation, build_world
from automodel.cli.init import kit_path
from automodel.config import load_car
from automodel.doctor import examination
from automodel.doctor.camera_pair import judge_order, judge_rig, judge_times, rig_findings
from automodel.doctor.findings import Verdict
from automodel.perception.stereo.points import RigCheck
from automodel.signals import StereoFrame
from automodel.sources.cameras import CameraStatus
from automodel.sources.pairs import PairStatus

OK, WARN, FAIL, SKIP = Verdict.OK, Verdict.WARN, Verdict.FAIL, Verdict.SKIP
EYE = CameraStatus(rate_hz=60.0, frames=100, dropped=0, lost=0, restarts=0)
WELL = PairStatus(
    eyes=(EYE, EYE), pairs=100, alone=0, unpaired=0, repeated=(0, 0), apart_s=0.0012, apart_max_s=0.003, missed_s=None
)
SEEN = RigCheck(matched=500, rigid=400, error_px=0.5, as_given=300, exchanged=10)


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        ({}, OK),
        ({"unpaired": 10}, OK),  # 200 of 210
        ({"unpaired": 11}, WARN),
        ({"pairs": 50, "unpaired": 100}, WARN),
        ({"pairs": 50, "unpaired": 101}, FAIL),
        ({"pairs": 30, "alone": 61}, FAIL),
        ({"pairs": 0, "unpaired": 200, "apart_s": None, "apart_max_s": None, "missed_s": 0.008}, FAIL),
        ({"repeated": (0, 50)}, OK),
        ({"repeated": (0, 51)}, FAIL),
        ({"repeated": (51, 0)}, FAIL),
        ({"eyes": (EYE, dataclasses.replace(EYE, frames=0, rate_hz=None))}, FAIL),
    ],
)
def test_frames_of_both_cameras_go_together(changes: dict[str, object], verdict: Verdict) -> None:
    assert judge_times(None, dataclasses.replace(WELL, **changes), 0.004).verdict is verdict  # type: ignore[arg-type]


def test_what_is_said_of_the_times() -> None:
    assert judge_times(None, WELL, 0.004).what == (
        "60.0 and 60.0 Hz; 100% of the frames have a partner within 4.0 ms, 1.2 ms apart, 3.0 at most"
    )
    turns = dataclasses.replace(WELL, pairs=0, unpaired=200, apart_s=None, apart_max_s=None, missed_s=0.0083)
    found = judge_times(None, turns, 0.004)
    assert found.what == "60.0 and 60.0 Hz; 0% of the frames have a partner within 4.0 ms; the others are 8.3 ms off"
    assert "trigger both cameras together" in found.do
    gone = dataclasses.replace(WELL, eyes=(EYE, dataclasses.replace(EYE, frames=0)))
    assert judge_times(None, gone, 0.004).what == "the right camera gives no frame"
    assert "[camera.right] device" in judge_times(None, gone, 0.004).do
    again = dataclasses.replace(WELL, repeated=(0, 90))
    assert judge_times(None, again, 0.004).what == "the right camera repeats its image: 90 of 100"


def test_what_came_before_both_gave_frames_does_not_count() -> None:
    """One camera starts a second before the other one."""
    begun = dataclasses.replace(WELL, pairs=1, unpaired=60, alone=20)
    now = dataclasses.replace(WELL, pairs=101, unpaired=60, alone=20)
    assert judge_times(begun, now, 0.004).verdict is OK
    assert judge_times(None, now, 0.004).verdict is WARN


@pytest.mark.parametrize(
    ("as_given", "exchanged", "verdict"), [(20, 5, OK), (19, 5, SKIP), (5, 20, SKIP), (5, 21, FAIL), (0, 0, SKIP)]
)
def test_which_camera_is_the_left_one(as_given: int, exchanged: int, verdict: Verdict) -> None:
    found = judge_order(dataclasses.replace(SEEN, as_given=as_given, exchanged=exchanged))
    assert found.verdict is verdict
    assert ("exchange" in found.do) == (verdict is FAIL)


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        ({}, OK),
        ({"error_px": 3.0}, OK),
        ({"error_px": 3.1}, WARN),
        ({"error_px": 10.0}, WARN),
        ({"error_px": 10.1}, FAIL),
        ({"rigid": 250, "error_px": 50.0}, FAIL),
        ({"rigid": 249, "error_px": 50.0}, SKIP),
        ({"rigid": 0, "matched": 0, "error_px": math.nan}, SKIP),
    ],
)
def test_whose_calibration_it_is(changes: dict[str, float], verdict: Verdict) -> None:
    assert judge_rig(dataclasses.replace(SEEN, **changes)).verdict is verdict  # type: ignore[arg-type]


@pytest.mark.parametrize("swapped", [False, True])
def test_a_simulated_car_whose_cameras_are_swapped(swapped: bool) -> None:
    car = load_car(kit_path("sim-stereo"))
    world = build_world(car, Simulation(track="chicane", seed=1))
    pairs = []
    for index in range(3):
        images = world.capture(index * 16_666_667, index)[0]
        left, right = images[::-1] if swapped else images
        pairs.append(StereoFrame(t_ns=index, index=index, left=left, right=right))
    order, _ = rig_findings(car, pairs)
    assert order.verdict is (FAIL if swapped else OK)


def test_a_right_camera_that_nobody_calibrated_is_a_warning() -> None:
    car = load_car(kit_path("sim-stereo"))
    car = dataclasses.replace(car, camera=dataclasses.replace(car.camera, source="usb"))
    image = np.zeros((360, 640), np.uint8)
    (found,) = rig_findings(car, [StereoFrame(t_ns=0, index=0, left=image, right=image)])
    assert (found.verdict, found.what) == (WARN, "[camera.right] has a device, and its lens or its place is not given")
    assert found.do.startswith("calibrate the right camera")


def test_a_pair_that_has_one_device_only_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    car = load_car(kit_path("sim-stereo"))
    assert car.camera.right is not None
    camera = dataclasses.replace(car.camera, source="usb", right=dataclasses.replace(car.camera.right, device=None))
    car = dataclasses.replace(car, camera=camera, link=dataclasses.replace(car.link, port="/dev/ttyMISSING"))
    first = next(iter(examination._device_findings(car, None, [])))
    assert (first.name, first.verdict) == ("car.toml", FAIL)
    assert first.do == "set [camera.right] device to the right one's number"
