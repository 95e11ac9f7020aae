from __future__ import annotations

from pathlib import Path

import pytest

KEYS = [
    "law", "rate_hz", "speed", "frames", "iterations", "iterations_p95", "losses", "losses_per_1000", "lost",
    "searched", "false", "coasting", "heading_mae_deg", "offset_mae_m",
]  # fmt: skip
QUICK = ("bench", "contour-paper", "--law", "gauss_newton", "--seconds", "1.5", "--jobs", "1")


def test_the_speed_pays_in_bends(cli, tmp_path: Path) -> None:
    said = cli(*QUICK, "--json", "--figure", tmp_path / "claim.png")
    assert said.code == 0
    assert all(list(row) == KEYS for row in said.rows)
    rows = {(row["rate_hz"], row["speed"]): row for row in said.rows}
    assert list(rows) == [(rate, told) for rate in (5, 10, 20, 30, 60) for told in ("told", "+20 %", "-20 %", "none")]
    told, none = rows[60, "told"], rows[60, "none"]
    assert told["frames"] > 20
    assert all(rows[rate, "told"]["frames"] == rows[rate, "none"]["frames"] for rate in (5, 10, 20, 30, 60))
    assert (told["losses"], told["false"]) == (0, 0)
    assert told["heading_mae_deg"] < 1.0
    assert 1.0 <= told["iterations"] < none["iterations"]
    assert (tmp_path / "claim.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("option", "value", "why"), [("--figure", "/nowhere/a.png", "no folder"), ("--seconds", "nan", "finite")]
)
def test_bad_input_is_one_line(cli, option: str, value: str, why: str) -> None:
    said = cli(*QUICK, option, value)
    assert (said.code, said.out) == (2, "")
    assert why in said.err
    assert "Traceback" not in said.err
