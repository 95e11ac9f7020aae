"""`automodel bench stereo-paper`: the highway sequence, shortened, beside the paper's figures."""

from __future__ import annotations

from pathlib import Path

import pytest

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


@pytest.mark.parametrize(
    ("option", "value", "why"),
    [
        ("--csv", "/nowhere/a.csv", "no folder"),
        ("--seconds", "nan", "finite"),
        ("--bounce", "3", "0.0<=x<=2.0"),
        ("--bounce", "nan", "finite"),
    ],
)
def test_bad_input_is_one_line(cli, option: str, value: str, why: str) -> None:
    said = cli(*QUICK, option, value)
    assert (said.code, said.out) == (2, "")
    assert why in said.err
    assert "Traceback" not in said.err
