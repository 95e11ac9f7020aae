"""The JSON of a bench as the tables of a report."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from automodel.assembly.bench_results import bench_tables
from automodel.config import ConfigError


def written(folder: Path, results: object) -> Path:
    path = folder / "bench.json"
    path.write_text(results if isinstance(results, str) else json.dumps(results))
    return path


def test_each_table_of_a_file_is_one_with_the_papers_figure_behind_ours(tmp_path: Path) -> None:
    rows = [
        {"table": "lines", "section": "straight", "mae_px": 0.5, "rmse_px": None, "frames": 3, "paper_mae_px": 2.0},
        {"table": "lines", "section": "curve", "mae_px": 1.0, "rmse_px": None, "frames": 4, "paper_mae_px": 1.5},
        {"table": "rates", "section": None, "mae_px": None, "rmse_px": None, "frames": 7, "paper_mae_px": None},
    ]
    results = {"version": "1", "command": "bench accuracy", "rows": rows, "machine": {"model": "A Board"}}
    lines, rates = bench_tables(written(tmp_path, results))
    assert lines.title == "bench.json: lines"
    assert lines.origin == "automodel bench accuracy, version 1, on A Board"
    assert lines.header == ("section", "mae [px]", "paper mae [px]", "frames")  # nothing is known of the RMSE
    assert lines.rows[0] == (("straight", 0.0), ("0.5", 0.25), ("2", 1.0), ("3", 0.0))  # bars of one scale
    assert (rates.header, rates.rows) == (("frames",), ((("7", 0.0),),))


def test_values_of_any_kind_are_shown(tmp_path: Path) -> None:
    huge = int("9" * 400)
    rows = [{"table": ["a"], "x_m": huge, "y": [1], "z": True}, {"table": ["a"], "x_m": 0.5, "y": None, "z": "word"}]
    (table,) = bench_tables(written(tmp_path, {"rows": rows}))
    assert table.title == "bench.json: ['a']"
    assert [[share for _, share in row] for row in table.rows] == [[0.0] * 3] * 2  # one number alone has no bar
    assert table.rows[0][0][0] == str(huge)


@pytest.mark.parametrize(
    ("results", "said"),
    [
        ("{", "not a JSON file"),
        ("[" * 100_000, "not a JSON file"),
        ([1, 2], "has no list of rows"),
        ({"rows": [1]}, "has no list of rows"),
        ({"rows": []}, "has no results"),
    ],
)
def test_what_is_no_result_of_a_bench_is_said_in_a_line(results: object, said: str, tmp_path: Path) -> None:
    path = written(tmp_path, results)
    with pytest.raises(ConfigError, match=f"bench.json: {said}") as caught:
        bench_tables(path)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there_is_said(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.json: cannot be read: No such file"):
        bench_tables(tmp_path / "none.json")
