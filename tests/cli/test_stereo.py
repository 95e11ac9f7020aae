"""Two cameras from the command line: driven, recorded, replayed."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from automodel.cli.init import kit_path
from automodel.recording.reader import Recording
from automodel.signals import StereoFrame


def test_a_drive_with_two_cameras_is_recorded_with_both_and_replays(cli, tmp_path: Path) -> None:
    run = tmp_path / "run.mcap"
    said = cli("run", "--car", kit_path("sim-stereo"), "--duration", "1", "--lossless", "--record", run, "--json")
    assert (said.code, said.rows[0]["left_lane"], said.rows[0]["stops"]) == (0, 0, 0)
    steps = list(Recording(run).steps())
    driven = [step.estimate.pose.offset_m for step in steps if step.estimate is not None and step.estimate.pose]
    assert len(steps) >= 58
    assert len(driven) >= 0.9 * len(steps)
    for step in steps:
        assert isinstance(step.frame, StereoFrame)
        assert np.abs(step.frame.left.astype(float) - step.frame.right).mean() > 1.0  # from two places

    said = cli("replay", run, "--csv", tmp_path / "poses.csv", "--json")
    assert said.code == 0
    row = said.rows[0]
    assert (row["pipeline"], row["frames"]) == ("stereo", len(steps))
    table = np.genfromtxt(tmp_path / "poses.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    replayed = table["offset_m"][np.isfinite(table["offset_m"])]
    np.testing.assert_allclose(replayed, driven, atol=1e-6)
    assert cli("replay", run, "--pipeline", "windows", "--json").rows[0]["frames"] == len(steps)  # sees the left one
