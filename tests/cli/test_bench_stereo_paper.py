"""`automodel bench stereo-paper`: the highway sequence, shortened, beside the paper's figures."""

from __future__ import annotations

from pathlib import Path

import pytest

from automodel.bench.stereo_paper import Ride

QUICK = ("bench", "stereo-paper", "--light", "day", "--seconds", "2", "--jobs", "1")


def test_stereo_beside_the_paper_and_a_monocular_pipeline(cli, tmp_path: Path) -> None:
    from automodel.bench.stereo_paper import COLUMNS

    csv = tmp_path / "rows.csv"
    said = cli(*QUICK, "--pipeline", "stereo", "--pipeline", "windows", "--bounce", "1", "--csv", csv, "--json")
    assert said.code == 0
    paper, stereo, windows = said.rows
    assert all(list(row) == list(COLUMNS) for row in said.rows)
    assert (paper["ride"], paper["width_sd_m"], paper["lane_reach_m"]) == ("the paper", 0.2, 54.0)
    assert (stereo["pipeline"], windows["pipeline"]) == ("stereo", "windows")
    assert stereo["ride"] == windows["ride"] == "day, pitch +-1 deg"
    assert stereo["frames"] == 30  # 20 a second but for the run-in
    assert abs(stereo["width_m"] - 3.5) < 0.05
    assert stereo["width_sd_m"] < 0.05
    assert stereo["pitch_mae_deg"] < 0.15
    assert stereo["offset_mae_m"] < 0.05
    assert (stereo["misled_pct"], stereo["changes"]) == (0.0, 0)
    assert stereo["heading_mae_deg"] < 0.5 * windows["heading_mae_deg"]  # which takes the ground to be level
    assert windows["pitch_mae_deg"] is None
    assert len(csv.read_text().splitlines()) == 4


def test_hills_and_traffic(cli) -> None:
    ride = ("--pipeline", "stereo", "--bounce", "0", "--sway", "1", "--hills", "--traffic")
    said = cli(*QUICK, *ride, "--json")
    assert said.code == 0
    stereo = said.rows[1]
    assert stereo["ride"] == "day, roll +-1 deg, hills, traffic"
    assert abs(stereo["width_m"] - 3.5) < 0.1
    assert stereo["offset_mae_m"] < 0.05
    assert (stereo["misled_pct"], stereo["changes"]) == (0.0, 0)


def test_hills_and_traffic_have_a_ride_of_their_own(cli, monkeypatch: pytest.MonkeyPatch) -> None:
    rides: list[str] = []

    def measure(given: list[Ride], sweep: object) -> list[object]:
        rides.extend(ride.words for ride in given)
        return []

    monkeypatch.setattr("automodel.bench.stereo_paper.measure", measure)
    assert cli("bench", "stereo-paper", "--json").code == 0
    assert rides[-2:] == ["day, hills", "day, traffic"]
    assert len(rides) == 6
    rides.clear()
    assert cli("bench", "stereo-paper", "--light", "day", "--flat", "--json").code == 0
    assert rides == ["day", "day, pitch +-1 deg"]


@pytest.mark.parametrize(
    ("option", "value", "why"),
    [
        ("--csv", "/nowhere/a.csv", "no folder"),
        ("--seconds", "nan", "finite"),
        ("--bounce", "3", "0.0<=x<=2.0"),
        ("--bounce", "nan", "finite"),
        ("--sway", "2.5", "0.0<=x<=2.0"),
    ],
)
def test_bad_input_is_one_line(cli, option: str, value: str, why: str) -> None:
    said = cli(*QUICK, option, value)
    assert (said.code, said.out) == (2, "")
    assert why in said.err
    assert "Traceback" not in said.err
