"""`automodel bench lane-changes` as a user runs it."""

from __future__ import annotations

from automodel.bench import lane_changes


def test_the_command_fails_where_a_change_is_missed(cli, monkeypatch) -> None:
    row = {"kind": "changes", "drives": 1, "minutes": 0.4, "changes": 3, "taken": 2, "missed": 1, "false": 0}
    for missed, code in ((1, 1), (0, 0)):
        total = row | {"missed": missed, "change_at_pct": 76.0, "lost_frames": 0}
        monkeypatch.setattr(
            lane_changes, "measure", lambda cases, sweep, total=total: {"drives": [total], "all": [total]}
        )
        said = cli("bench", "lane-changes", "--changes", "1", "--minutes", "0", "--json")
        assert said.code == code
        assert said.rows[-1]["missed"] == missed
