"""Output files appear whole or not at all."""

from __future__ import annotations

import ast
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

import automodel
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


PACKAGES = [Path(automodel.__file__).parent, Path(automodel.__file__).parents[1] / "calibration"]
ITS_OWN_WAY = {
    "output_files.py",
    "car_file.py",
    "run_file.py",
    "doctor/latency.py",
    "viewer/video.py",
}  # this; beside and renamed; a run grows and is recovered; the kernel's files of an LED; what ffmpeg will write
BESIDE = {"output_path", "output_text"}


def _called(node: ast.AST) -> str:
    function = node.func if isinstance(node, ast.Call) else None
    return function.id if isinstance(function, ast.Name) else getattr(function, "attr", "")


def _writes(call: ast.Call) -> bool:
    if isinstance(call.func, ast.Attribute) and call.func.attr in ("write_text", "write_bytes"):
        return True
    return _opens_for_writing(call)


def _opens_for_writing(call: ast.Call) -> bool:
    modes = [*call.args, *(keyword.value for keyword in call.keywords if keyword.arg == "mode")]
    texts = [mode.value for mode in modes if isinstance(mode, ast.Constant) and isinstance(mode.value, str)]
    return _called(call) == "open" and any(set(text) <= set("rwxabt+") and set(text) & set("wxa+") for text in texts)


def _direct_writes(node: ast.AST, beside: bool = False) -> Iterator[int]:
    """The lines that write to a file outside of a block of `output_path` or `output_text`."""
    if isinstance(node, ast.Call) and not beside and _writes(node):
        yield node.lineno
    if isinstance(node, ast.With):
        beside = beside or any(_called(item.context_expr) in BESIDE for item in node.items)
    for child in ast.iter_child_nodes(node):
        yield from _direct_writes(child, beside)


def test_nothing_writes_a_file_in_place() -> None:
    files = [
        file for package in PACKAGES for file in sorted(package.rglob("*.py")) if not any(map(file.match, ITS_OWN_WAY))
    ]
    found = [f"{file}:{line}" for file in files for line in _direct_writes(ast.parse(file.read_text(encoding="utf-8")))]
    assert not found, f"write with automodel.output_files: {found}"


@pytest.mark.parametrize(
    "line", ["path.write_text('')", "open(path, 'w')", "path.open('ab')", "open(path, mode='r+')", "p.write_bytes(b'')"]
)
def test_writing_in_place_is_seen(line: str) -> None:
    assert list(_direct_writes(ast.parse(line))) == [1]
    assert not list(_direct_writes(ast.parse(f"with output_path(target) as path:\n    {line}")))
