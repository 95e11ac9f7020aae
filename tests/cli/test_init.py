"""`init`: every kit is a car.toml that loads, is explained, and differs from the defaults only where it means to."""

from __future__ import annotations

import dataclasses
import os
import re
from pathlib import Path
from typing import Any

import pytest

from automodel.cli import init
from automodel.cli.init import KITS, SIMULATED, kit_text
from automodel.config import CarConfig, Extrinsics, SecondCamera, load_car, parse_car
from automodel.config.toml_reader import parse_toml

BOARD = {
    "link.port": "/dev/ttyUSB0",
    "control.speed_mps": 0.5,
    "safety.speed_max_mps": 1.0,
}
CAMERA_AND_BOARD = {**BOARD, "camera.source": "csi", "camera.sensor_mode": 4}
RIGHT_CAMERA = SecondCamera(device=1, extrinsics=Extrinsics(y_m=-0.125))
DIFFERENCES = {
    "nano-arduino": CAMERA_AND_BOARD,
    "orin-nano-arduino": CAMERA_AND_BOARD,
    "usb-camera": {**BOARD, "camera.source": "usb", "camera.rate_hz": 30.0, "safety.frame_timeout_s": 0.08},
    "pi5": {
        **BOARD,
        "camera.source": "picamera2",
        "camera.sensor_mode": 1,
        "camera.rate_hz": 50.0,
        "pipeline.centerline.providers": ("cpu",),
    },
    "jetracer": {
        **CAMERA_AND_BOARD,
        "vehicle.wheelbase_m": 0.257,
        "vehicle.reference_x_m": 0.128,
        "vehicle.width_m": 0.19,
    },
    "full-size": {
        "vehicle.wheelbase_m": 2.65,
        "vehicle.reference_x_m": 1.25,
        "vehicle.width_m": 1.80,
        "vehicle.front_overhang_m": 0.90,
        "vehicle.rear_overhang_m": 0.80,
        "vehicle.ticks_per_m": 50.0,
        "camera.width_px": 672,
        "camera.height_px": 376,
        "camera.rate_hz": 50.0,
        "camera.intrinsics.fx_px": 350.0,
        "camera.intrinsics.fy_px": 350.0,
        "camera.intrinsics.cx_px": 335.5,
        "camera.intrinsics.cy_px": 187.5,
        "camera.extrinsics.x_m": 1.65,
        "camera.extrinsics.z_m": 1.35,
        "camera.extrinsics.pitch_rad": 0.08,
        "lane.width_m": 3.5,
        "lane.marking_width_m": 0.15,
        "control.speed_mps": 15.0,
        "control.lateral_accel_mps2": 1.8,
        "control.decel_mps2": 2.5,
        "control.lookahead_s": 0.8,
        "control.lookahead_min_m": 5.0,
        "control.actuator_delay_s": 0.13,
        "control.speed_delay_s": 0.65,
        "pipeline.contour.radius_lanes": 40.0,
        "link.kind": "can",
        "safety.steering_rate_max_radps": 0.5,
        "safety.speed_max_mps": 15.0,
        "safety.lateral_accel_max_mps2": 2.4,
        "safety.lateral_jerk_max_mps3": 5.0,
    },
    "sim": {},
    "sim-stereo": {"camera.extrinsics.y_m": 0.125, "camera.right": RIGHT_CAMERA, "pipeline.name": "stereo"},
}
UNITS = {  # the ending of a key -> how its comment begins
    "_m": "[m]", "_mps": "[m/s]", "_mps2": "[m/s2]", "_mps3": "[m/s3]", "_px": "[px]", "_hz": "[1/s]", "_rad": "[rad]",
    "_radps": "[rad/s]", "_s": "[s]", "_us": "[us]", "_v": "[V]", "_per_m": "[1/m]",
}  # fmt: skip
WITHOUT_A_UNIT = {"source", "device", "colour", "name", "markings", "providers", "controller", "kind", "port"} | {
    "directory", "image", "left", "right", "flip", "pixel_format", "network"
}  # fmt: skip


def flat(section: Any, place: str = "") -> dict[str, Any]:
    """Every key of a configuration by its place in the file."""
    values: dict[str, Any] = {}
    for field in dataclasses.fields(section):
        value = getattr(section, field.name)
        values |= (
            flat(value, f"{place}{field.name}.") if dataclasses.is_dataclass(value) else {place + field.name: value}
        )
    return values


def given(table: dict[str, Any], place: str = "") -> set[str]:
    """The keys that a file gives."""
    found: set[str] = set()
    for key, value in table.items():
        found |= given(value, f"{place}{key}.") if isinstance(value, dict) else {place + key}
    return found


def test_the_kits_are_the_files() -> None:
    folder = Path(init.__file__).parent / "kits"
    assert {path.stem for path in folder.glob("*.toml")} == set(KITS) == set(DIFFERENCES)


@pytest.mark.parametrize("kit", KITS)
def test_a_kit_loads_and_differs_where_it_means_to(kit: str) -> None:
    car, usual = flat(parse_car(kit_text(kit), f"{kit}.toml")), flat(CarConfig())
    car["camera.right"] = parse_car(kit_text(kit), f"{kit}.toml").camera.right
    usual["camera.right"] = None
    assert {key: value for key, value in car.items() if key in usual and value != usual[key]} == DIFFERENCES[kit]


@pytest.mark.parametrize("kit", KITS)
def test_every_key_has_a_comment_and_its_unit(kit: str) -> None:
    lines = [line for line in kit_text(kit).splitlines() if line and not line.startswith("#")]
    assert len(lines) > 50
    for line in lines:
        match = re.fullmatch(r"(\[[\w.]+\]|(?P<key>\w+) = .*?)  +# (?P<comment>.+)", line)
        assert match is not None, line
        assert len(line) <= 120
        key, comment = match["key"], match["comment"].removeprefix("* ").removeprefix("+ ")
        if key is None or key in WITHOUT_A_UNIT:
            continue
        endings = [ending for ending in UNITS if key.endswith(ending)]
        wanted = UNITS[max(endings, key=len)] if endings else "["
        assert comment.startswith(wanted), line


@pytest.mark.parametrize("kit", KITS)
def test_a_kit_says_all_that_people_set(kit: str) -> None:
    """All sections in full; of the pipelines' own keys only some: their place is the README.

    What only a camera has is not in the kits of simulated cars.
    """
    keys = given(parse_toml(kit_text(kit), kit))
    left_out = {key for key in flat(CarConfig()) if key not in keys}
    own: tuple[str, ...] = (
        "pipeline.",
        "calibration.",
        "camera.right",
        "link.autonomos.",
        "link.can.",
        "control.",
        "lane.dark_markings",
    )
    if kit in SIMULATED:
        own += tuple(
            f"camera.{key}"
            for key in ("latency_s", "sensor_mode", "flip", "pixel_format", "exposure_s", "gain", "flicker_hz")
        )
    assert {key for key in left_out if not key.startswith(own)} == set()
    assert {"control.speed_mps", "control.controller", "pipeline.name"} <= keys


def test_it_is_written_where_it_was_asked_for(cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for kit in KITS:
        said = cli("init", kit, "--out", f"{kit}.toml")
        assert (said.code, said.out) == (0, "")
        assert said.err.startswith(f"{kit}.toml: written for {kit}\nnext: ")
        assert (tmp_path / f"{kit}.toml").read_text() == kit_text(kit)
        load_car(tmp_path / f"{kit}.toml")
    assert cli("init", "sim").code == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*(f"{kit}.toml" for kit in KITS), "car.toml"])


def test_the_simulated_kit_drives(cli, tmp_path: Path) -> None:
    assert cli("init", "sim", "--out", tmp_path / "car.toml").code == 0
    said = cli("run", "--car", tmp_path / "car.toml", "--pipeline", "windows", "--duration", "0.5", "--json")
    assert (said.code, said.rows[0]["stops"]) == (0, 0)


def test_the_list(cli) -> None:
    said = cli("init", "--list")
    assert (said.code, said.err) == (0, "")
    assert [line.split()[0] for line in said.out.splitlines()] == list(KITS)


def test_nothing_is_overwritten_unasked(cli, tmp_path: Path) -> None:
    file = tmp_path / "car.toml"
    file.write_text("mine")
    said = cli("init", "sim", "--out", file)
    assert (said.code, file.read_text()) == (2, "mine")
    assert said.line() == f"automodel: {file}: exists already; choose another name with --out, or give --force"
    for backup in ("car.toml.bak", "car.toml.bak.2"):
        said = cli("init", "sim", "--out", file, "--force")
        assert (said.code, f"the old one is {tmp_path / backup}" in said.err) == (0, True)
    assert (tmp_path / "car.toml.bak").read_text() == "mine"
    assert file.read_text() == (tmp_path / "car.toml.bak.2").read_text() == kit_text("sim")


@pytest.mark.parametrize(
    ("arguments", "said_so"),
    [
        (
            "",
            "automodel init: KIT is missing: one of nano-arduino, orin-nano-arduino, usb-camera, pi5, jetracer, "
            "full-size, sim, sim-stereo "
            "(see automodel init --help)",
        ),
        ("sim --out no/car.toml", "automodel: no/car.toml: cannot be written: No such file or directory"),
        ("sim --out .", "automodel: .: is a folder; give the name of a file"),
    ],
)
def test_what_is_wrong_is_one_line(arguments: str, said_so: str, cli, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    said = cli("init", *arguments.split())
    assert (said.code, said.out, said.line()) == (2, "", said_so)
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_leaves_the_old_file(cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "car.toml"
    file.write_text("mine")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    said = cli("init", "sim", "--out", file, "--force")
    assert (said.code, file.read_text()) == (2, "mine")
    assert said.line() == f"automodel: {file}: cannot be written: No space left on device"
    assert {path.name for path in tmp_path.iterdir()} == {"car.toml"}
