"""The comparison of two machines that `.ci/aarch64` makes, on one machine."""

from __future__ import annotations

import copy
import json
from pathlib import Path

import pytest

from automodel.config.parts import PIPELINES
from tests.support.one_pose import compare, draw, main, poses


@pytest.mark.slow
def test_the_same_machine_gives_the_same_poses_and_another_is_found(tmp_path: Path, capsys) -> None:
    draw(tmp_path / "frames.npz")
    found = {"machine": "x", "poses": poses(tmp_path / "frames.npz")}
    assert set(found["poses"]) == set(PIPELINES.names)
    assert all(pose["status"] == "TRACKING" for pose in found["poses"].values())  # type: ignore[attr-defined]
    assert compare(found, copy.deepcopy(found)) == []
    other = copy.deepcopy(found)
    other["poses"]["windows"]["offset_m"] += 2e-6  # type: ignore[index]
    other["poses"]["contour"] = {"status": "LOST"}  # type: ignore[index]
    assert compare(found, other) == ["windows", "contour"]
    for name, value in (("here", found), ("there", other)):
        (tmp_path / name).write_text(json.dumps(value))
    assert main(["compare", str(tmp_path / "here"), str(tmp_path / "there")]) == 1
    assert main(["compare", str(tmp_path / "here"), str(tmp_path / "here")]) == 0
    assert "windows: TRACKING, x and x 2.0e-06 apart" in capsys.readouterr().out
