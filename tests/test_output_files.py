"""Output files appear whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from automodel.config import ConfigError
from automodel.output_files import output_path, output_text


def test_the_file_appears_when_the_block_ends(tmp_path: Path) -> None:
    target = tmp_path / "table.csv"
    with output_text(target) as file:
        file.write("a,b\n")
        assert not target.exists()
    assert target.read_bytes() == b"a,b\n"
    assert os.listdir(tmp_path) == ["table.csv"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit, BrokenPipeError])
def test_an_error_leaves_what_was_there(tmp_path: Path, error: type[BaseException]) -> None:
    (tmp_path / "old.csv").write_text("old")
    for name in ("old.csv", "new.csv"):
        with pytest.raises(error), output_text(tmp_path / name) as file:  # noqa: PT012
            file.write("half")
            raise error
    assert os.listdir(tmp_path) == ["old.csv"]
    assert (tmp_path / "old.csv").read_text() == "old"


def test_the_temporary_name_lies_beside_and_keeps_the_suffix(tmp_path: Path) -> None:
    with output_path(tmp_path / "run.mp4") as part:
        assert part.parent == tmp_path
        assert part.suffix == ".mp4"
    assert os.listdir(tmp_path) == []  # nothing was written


def test_a_link_keeps_its_place(tmp_path: Path) -> None:
    (tmp_path / "real.csv").write_text("old")
    (tmp_path / "link.csv").symlink_to("real.csv")
    with output_text(tmp_path / "link.csv") as file:
        file.write("new")
    assert (tmp_path / "link.csv").is_symlink()
    assert (tmp_path / "real.csv").read_text() == "new"


def test_a_device_is_written_directly() -> None:
    with output_text("/dev/null") as file:
        file.write("gone")
    assert not Path("/dev/null").is_file()


@pytest.mark.parametrize("name", ["no/table.csv", "file.txt/table.csv", "folder"])
def test_a_file_that_cannot_be_made_is_named(tmp_path: Path, name: str) -> None:
    (tmp_path / "file.txt").write_text("")
    (tmp_path / "folder").mkdir()
    with pytest.raises(ConfigError, match=rf"{name}: cannot be written: "), output_text(tmp_path / name):
        pass
    assert sorted(os.listdir(tmp_path)) == ["file.txt", "folder"]


def test_a_full_disk_is_reported() -> None:
    full = pytest.raises(ConfigError, match="/dev/full: cannot be written: No space left")
    with full, output_text("/dev/full") as file:
        file.write("too much")


def test_an_error_of_another_file_stays_its_own(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), output_text(tmp_path / "table.csv"):
        (tmp_path / "another").read_text()
