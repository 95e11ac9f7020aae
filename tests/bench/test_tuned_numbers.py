"""Tuned numbers are found in the sources, moved for a while, and put back."""

from __future__ import annotations

import importlib
import sys

import pytest

from automodel.bench.tuned_numbers import NOT_TUNED, TunedNumber, moved, pipelines_of, tuned_numbers, users

ALL = {number.path: number for number in tuned_numbers()}


def one(path: str) -> TunedNumber:
    return ALL[path]


def test_fields_attributes_and_parts_of_tuples_are_found() -> None:
    assert one("tracking.belief.RoadModel.width_sigma").value == 0.12
    assert one("perception.markings.binary_views.WhiteAreas.NARROW").value == 0.45  # NARROW, WIDE = 0.45, 2.4
    assert one("estimation.road.MAX_GAP_S").value == 0.5
    assert one("perception.line_scan.ScanConfig.bar_lanes[1]").value == 0.4


def test_a_number_says_what_it_is() -> None:
    beside = one("perception.markings.binary_views.FeaturePoints.KERNEL").meaning
    assert beside == "side of the kernel that opens and closes, in marking widths"
    described = one("perception.windows.window_tracker.FollowConfig.turn_rad").meaning
    assert described.startswith("turn_rad: largest direction of a piece")


@pytest.mark.parametrize(
    "what",
    [
        "onnx_check",
        "brightness",
        "Part.",
        "PoseState.",
        "hypotheses.LEFT",
        "NO_POINTS",
        "log_odds",
        "road_profile.SAME",
    ],
)
def test_what_is_no_tuned_number_is_left_out(what: str) -> None:
    assert not [path for path in ALL if what in path]


def test_every_exemption_is_of_something() -> None:
    for name in NOT_TUNED:
        module = "automodel." + name.split("*")[0].rstrip("._")
        while module not in sys.modules:
            try:
                importlib.import_module(module)
            except ModuleNotFoundError:
                module = module.rpartition(".")[0]
        assert module.count(".") >= 1


def test_patterns_choose() -> None:
    assert {number.path for number in tuned_numbers(["lane_motion", "clothoid*width_walk"])} == {
        path for path in ALL if "lane_motion" in path or ("clothoid" in path and path.endswith("width_walk"))
    }
    assert not tuned_numbers(["no such number"])


def test_whole_numbers_stay_whole() -> None:
    count = one("perception.line_scan.ScanConfig.bars")
    assert [count.moved(share) for share in (-0.5, -0.1, 0.2, 0.5)] == [2, None, 4, 4]
    assert one("estimation.road.MAX_GAP_S").moved(0.5) == 0.75


def test_users_are_those_that_import_a_module_through_others_too() -> None:
    assert users("automodel.tracking.frame_motion") >= {
        "automodel.tracking.lane_tracking",
        "automodel.pipelines.contour",
    }
    assert pipelines_of(one("perception.windows.line_windows.LineWindows.ALONG")) == ("centerline",)
    assert not users("automodel.perception.windows.line_windows") & {"automodel.tracking.belief"}


def test_a_number_is_moved_and_put_back() -> None:
    name, user = "automodel.perception.markings.binary_views", "automodel.pipelines.windows"
    before, pipeline = importlib.import_module(name), importlib.import_module(user)
    with moved(one("perception.markings.binary_views.WhiteAreas.WIDE"), 3.0):
        anew = importlib.import_module(name)
        assert (anew.WhiteAreas.NARROW, anew.WhiteAreas.WIDE) == (0.45, 3.0)
        assert importlib.import_module(user).WhiteAreas is anew.WhiteAreas
        assert before.WhiteAreas.WIDE == 2.4
    assert importlib.import_module(name) is before
    assert importlib.import_module(user) is pipeline
    assert sys.modules["automodel.perception.markings"].binary_views is before


def test_what_is_derived_follows() -> None:
    with moved(one("perception.rows.row_ridges.PER_MARKING"), 9):
        assert importlib.import_module("automodel.perception.rows.row_ridges").MARGIN == 9 + 4


def test_a_number_is_put_back_after_an_error() -> None:
    name, number = "automodel.estimation.road", one("estimation.road.MAX_GAP_S")
    before = importlib.import_module(name)

    def fail() -> None:
        with moved(number, 9.0):
            raise RuntimeError(str(importlib.import_module(name).MAX_GAP_S))

    with pytest.raises(RuntimeError, match=r"9\.0"):
        fail()
    assert importlib.import_module(name) is before
    assert before.MAX_GAP_S == 0.5
