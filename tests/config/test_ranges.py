"""The ranges of numbers in files: every key has one, and what ships lies well inside."""

from __future__ import annotations

import dataclasses

import pytest

from automodel.config import CarConfig, ConfigError, SafetyConfig, parse_car
from automodel.config.ranges import BY_KEY, out_of_range, range_of


def test_every_key_with_a_range_exists() -> None:
    for key in BY_KEY:
        section: object = CarConfig()
        for name in key.split("."):
            section = getattr(section, name)


def test_every_number_of_safety_has_bounds_of_its_own() -> None:
    assert {f"safety.{field.name}" for field in dataclasses.fields(SafetyConfig)} <= BY_KEY.keys()


@pytest.mark.parametrize(
    ("key", "most_s"), [("frame_timeout_s", 2.0), ("command_validity_s", 0.5), ("hold_s", 2.0), ("rearm_s", 60.0)]
)
def test_the_times_of_safety_end_where_a_car_would_drive_off_by_itself(key: str, most_s: float) -> None:
    assert parse_car(f"[safety]\n{key} = {most_s}\n", "car.toml")
    with pytest.raises(ConfigError, match="at most"):
        parse_car(f"[safety]\n{key} = {most_s * 1.01}\n", "car.toml")


@pytest.mark.parametrize("key", BY_KEY)
def test_a_value_beyond_its_range_is_refused_with_its_line(key: str) -> None:
    *path, name = key.split(".")
    least, most = range_of(tuple(key.split(".")))
    for value, expected in ((1e-300, f"at least {least:g}"), (1e300, f"at most {most:g}")):
        whole = isinstance(getattr(_section(path), name), int)
        number = f"[{value}, 0, 0, 0, 0]" if name == "distortion" else str(10**300 if whole else value)
        if whole and value < 1:
            continue
        with pytest.raises(ConfigError) as refused:
            parse_car(f"[{'.'.join(path)}]\n{name} = {number}\n", "car.toml")
        assert str(refused.value).startswith(f"car.toml:2: [{'.'.join(path)}] {name}: expected {expected}, got ")


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("camera.rate_hz", 1e-300, "at least 0.1"),
        ("control.lookahead_s", -1e4, "at most 3600"),
        ("camera.right.intrinsics.fx_px", 0.5, "at least 1"),
        ("pieces.length_m", 1e300, "at most 100000"),
        ("control.speed_mps", 0.0, None),
        ("camera.intrinsics.fx_px", 480.0, None),
        ("lanes.count", 2, None),
    ],
)
def test_the_end_of_a_key_says_the_range(key: str, value: float, expected: str | None) -> None:
    assert out_of_range(tuple(key.split(".")), value) == expected


def _section(path: list[str]) -> object:
    section: object = CarConfig()
    for name in path:
        section = getattr(section, name)
    return section
