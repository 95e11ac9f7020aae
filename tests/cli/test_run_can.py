"""`automodel run --link can`: a full-size car over emulated CAN frames."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import pytest

from automodel.recording.reader import Recording
from automodel.signals import Command, VehicleState
from tests.cli.test_realtime import LATE

TRIES = 5
BUSY = (*LATE, "can_timeout:", "it was given no speed")  # what a machine that does something else makes of a run
RUN = ("run", "--link", "can", "--pipeline", "contour")


def rows_of(truth: Path) -> list[dict[str, str]]:
    with open(truth, newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_it_drives_at_15_mps_through_a_bend(cli, tmp_path: Path) -> None:
    truth, recording = tmp_path / "truth.csv", tmp_path / "run.mcap"
    said = cli(*RUN, "--duration", "28", "--truth", truth, "--record", recording, "--json")
    assert said.code == 0
    (row,) = said.rows
    assert (row["left_lane"], row["stops"]) == (0, 0)
    assert row["max_abs_offset_m"] <= 0.5
    rows = rows_of(truth)
    assert max(abs(float(line["curvature_per_m"])) for line in rows) == pytest.approx(1 / 150, rel=0.02)
    values = [message.value for message in Recording(recording)]
    states = [value for value in values if isinstance(value, VehicleState)]
    assert max(state.speed_mps or 0.0 for state in states) == pytest.approx(15.0, abs=1.0)  # slower by its bound
    last = states[-1]
    assert (last.armed, last.engaged, last.driver_override, last.gear, last.faults) == (True, True, False, "D", ())
    angles = np.array([value.steering_rad for value in values if isinstance(value, Command)])
    assert np.max(np.abs(angles)) < math.radians(3)


HAIRPIN = """name = "hairpin"
closed = false
floor = { x0_m = -20.0, y0_m = -120.0, x1_m = 260.0, y1_m = 40.0 }
lanes = { count = 1, width_m = 3.5 }
start = { direction = "forward", s_m = 5.0 }
pieces = [
  { kind = "line", length_m = 160.0 },
  { kind = "arc", radius_m = 12.0, turn_rad = -1.5707963267948966 },
  { kind = "line", length_m = 90.0 },
]
[markings]
left = { style = "solid", width_m = 0.15 }
right = { style = "solid", width_m = 0.15 }
"""


@pytest.mark.parametrize("pipeline", ["contour", pytest.param("windows", marks=pytest.mark.slow)])
def test_it_is_slow_enough_for_a_tight_bend_that_comes_into_view_late(cli, tmp_path: Path, pipeline: str) -> None:
    car, track, truth = tmp_path / "car.toml", tmp_path / "hairpin.toml", tmp_path / "truth.csv"
    track.write_text(HAIRPIN)
    assert cli("init", "full-size", "--out", car).code == 0
    text = car.read_text()
    assert "radius_lanes = 40.0" in text
    car.write_text(text.replace("radius_lanes = 40.0", "radius_lanes = 3.0"))  # 10.5 m
    options = ("--track", track, "--pipeline", pipeline, "--duration", "36", "--truth", truth, "--json")
    said = cli("run", "--car", car, *options)
    assert said.code == 0, said.err
    (row,) = said.rows
    assert (row["left_lane"], row["stops"]) == (0, 0)
    assert row["max_abs_offset_m"] <= 0.3
    rows = rows_of(truth)
    assert max(abs(float(line["curvature_per_m"])) for line in rows) == pytest.approx(1 / 12, rel=0.02)
    assert float(rows[-1]["y_m"]) < -20.0  # through the bend
    moved = np.diff([(float(line["x_m"]), float(line["y_m"])) for line in rows], axis=0)
    assert np.hypot(*moved.T).max() * 50.0 > 7.0  # the straight is not driven as the bend is


def test_a_lane_of_another_width_than_car_toml_says_is_told(cli, tmp_path: Path) -> None:
    track = tmp_path / "wide.toml"
    track.write_text(HAIRPIN.replace("width_m = 3.5", "width_m = 7.0"))
    said = cli(*RUN, "--track", track, "--duration", "0.1")
    assert f"{track}: its lane is 7 m wide, [lane] width_m of car.toml 3.5: correct it" in said.err


def test_its_kit_drives(cli, tmp_path: Path) -> None:
    car = tmp_path / "car.toml"
    assert cli("init", "full-size", "--out", car).code == 0
    said = cli("run", "--car", car, "--track", "ring", "--pipeline", "contour", "--duration", "3", "--json")
    assert (said.code, said.rows[0]["stops"]) == (0, 0)


@pytest.mark.realtime
def test_it_drives_in_real_time_on_a_bus_of_another_process(cli, tmp_path: Path) -> None:
    """The loop may be held up by whatever else this machine does: a stop is then right, and tried again."""
    for _ in range(TRIES):
        truth = tmp_path / "truth.csv"
        said = cli(*RUN, "--realtime", "--style", "clean", "--duration", "8", "--truth", truth, "--json")
        (row,) = said.rows
        if said.code == 0:
            break
        assert any(text in said.err for text in BUSY), said.err
    else:
        pytest.skip("this machine was too busy")
    rows = rows_of(truth)
    moved_m = math.hypot(*(float(rows[-1][key]) - float(rows[0][key]) for key in ("x_m", "y_m")))
    assert moved_m > 5.0
    assert 0.0 <= row["jitter_p50_ms"] <= row["jitter_p99_ms"]
    assert 0.0 < row["frame_to_bus_p50_ms"] <= row["frame_to_bus_p99_ms"]
    assert row["frame_to_bus_p50_ms"] < 100.0, "no older command may be obeyed"


def test_a_bus_that_is_not_there_is_one_line(cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from tests.support.fake_cars import StillCamera, road

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("automodel.assembly.drive.make_camera", lambda car: StillCamera(road()))
    car = tmp_path / "car.toml"
    car.write_text(
        '[camera]\nsource = "usb"\n[link]\nkind = "can"\nport = "can0"\n[link.can]\ninterface = "nonsense"\n'
    )
    said = cli("run", "--car", car)
    assert said.code in (1, 2)
    assert "the CAN bus cannot be opened" in said.err
    assert "Traceback" not in said.err
