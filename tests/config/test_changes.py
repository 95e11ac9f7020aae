"""Single keys of a configuration by their place."""

from __future__ import annotations

import dataclasses

import pytest

from automodel.config import CarConfig, ConfigError
from automodel.config.changes import keys_of, with_value

CAR = CarConfig()


def test_every_key_has_its_place_and_value() -> None:
    keys = dict(keys_of(CAR))
    assert keys["lane.width_m"] == CAR.lane.width_m
    assert keys["camera.intrinsics.fx_px"] == CAR.camera.intrinsics.fx_px
    assert keys["pipeline.contour.nodes"] == CAR.pipeline.contour.nodes
    assert not any(dataclasses.is_dataclass(value) for value in keys.values())


def test_a_value_replaces_one_key_and_nothing_else() -> None:
    changed = with_value(CAR, "camera.extrinsics.pitch_rad", " 0.5 ")
    before, after = dict(keys_of(CAR)), dict(keys_of(changed))
    assert {key for key in before if before[key] != after[key]} == {"camera.extrinsics.pitch_rad"}
    assert after["camera.extrinsics.pitch_rad"] == 0.5
    assert with_value(CAR, "control.feed_forward", "false").control.feed_forward is False
    assert with_value(CAR, "pipeline.contour.nodes", "12").pipeline.contour.nodes == 12
    assert with_value(CAR, "lane.markings", "dark").lane.markings == "dark"


@pytest.mark.parametrize(
    ("key", "text", "said"),
    [
        ("lane.width_m", "wide", "lane.width_m: expected a finite number"),
        ("lane.width_m", "inf", "lane.width_m: expected a finite number"),
        ("lane.width_m", "900", "lane.width_m: expected at most 20"),
        ("lane.marking_width_m", "0.3", "marking_width_m: 0.3 is more than half the lane's width"),
        ("pipeline.contour.nodes", "1.5", "pipeline.contour.nodes: expected a whole number"),
        ("control.feed_forward", "yes", "control.feed_forward: expected true or false"),
        ("lane.markings", "green", "markings: expected one of light, dark, both, got 'green'"),
        ("camera.intrinsics.distortion", "0", "camera.intrinsics.distortion: is no single number or word"),
    ],
)
def test_a_value_that_cannot_be_is_said_in_a_line(key: str, text: str, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        with_value(CAR, key, text)
    assert str(caught.value).startswith(said)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("key", ["", "lane", "lane.width", "lane.width_m.real", "x.y", "__class__.__name__", "lane."])
def test_a_key_that_there_is_not_is_refused(key: str) -> None:
    with pytest.raises(KeyError):
        with_value(CAR, key, "1")
