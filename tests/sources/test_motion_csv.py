from __future__ import annotations

from pathlib import Path

import pytest

from automodel.config import ConfigError
from automodel.signals import MotionSource
from automodel.sources.files import read_motion_csv


def write_motion(folder: Path, text: str) -> Path:
    path = folder / "motion.csv"
    path.write_text(text)
    return path


def test_motion_is_linear_between_rows(tmp_path: Path) -> None:
    table = read_motion_csv(write_motion(tmp_path, "t_s,speed_mps,yaw_rate_radps\n0,1.0,0.0\n0.5,2.0,-0.4\n"))
    motion = table.at(125_000_000)
    assert (motion.t_ns, motion.source, motion.known) == (125_000_000, MotionSource.RECORDED, True)
    assert motion.speed_mps == pytest.approx(1.25)
    assert motion.yaw_rate_radps == pytest.approx(-0.1)
    assert table.at(0).speed_mps == 1.0
    assert table.at(500_000_000).speed_mps == 2.0


def test_outside_the_table_nothing_is_known(tmp_path: Path) -> None:
    table = read_motion_csv(write_motion(tmp_path, "t_s,speed_mps,yaw_rate_radps\n0.1,1.0,0.3\n0.5,2.0,0.3\n\n"))
    for t_ns in (0, 99_000_000, 501_000_000):
        assert (table.at(t_ns).known, table.at(t_ns).speed_mps) == (False, 0.0)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", r"motion\.csv:1: the first line must be t_s,speed_mps,yaw_rate_radps"),
        ("t,v,w\n0,1,2\n", r"motion\.csv:1: the first line"),
        ("t_s,speed_mps,yaw_rate_radps\n", r"motion\.csv: no rows"),
        ("t_s,speed_mps,yaw_rate_radps\n0,1,2\n1,2\n", r"motion\.csv:3: expected 3 values, got 2"),
        (
            "t_s,speed_mps,yaw_rate_radps\n0,1,2\n1,x,3\n",
            r"motion\.csv:3: speed_mps: expected a finite number, got 'x'",
        ),
        (
            "t_s,speed_mps,yaw_rate_radps\n0,1,nan\n",
            r"motion\.csv:2: yaw_rate_radps: expected a finite number, got 'nan'",
        ),
        ("t_s,speed_mps,yaw_rate_radps\n0,1,2\n0,1,2\n", r"motion\.csv:3: t_s must increase"),
    ],
)
def test_bad_motion_files_are_named_with_line(tmp_path: Path, text: str, match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        read_motion_csv(write_motion(tmp_path, text))


def test_a_motion_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file"):
        read_motion_csv(tmp_path / "motion.csv")
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="cannot be read"):
        read_motion_csv(tmp_path / "binary.csv")
