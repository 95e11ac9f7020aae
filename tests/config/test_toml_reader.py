from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from automodel.config.toml_reader import ConfigError, parse_toml, read_section, read_text


@dataclass(frozen=True, slots=True, kw_only=True)
class Inner:
    depth_m: float = 1.0
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.depth_m <= 0:
            raise ValueError(f"depth_m: expected a positive number, got {self.depth_m}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Outer:
    title: str
    count: int = 3
    on: bool = False
    inner: Inner = field(default_factory=Inner)
    other: Inner | None = None

    def __post_init__(self) -> None:
        if self.count > 5 and self.on:
            raise ValueError("too many while on")


def read(text: str) -> Outer:
    return read_section(Outer, parse_toml(text, "f.toml"), text, "f.toml")


def refusal(text: str) -> str:
    with pytest.raises(ConfigError) as caught:
        read(text)
    return str(caught.value)


def test_defaults_nesting_and_types() -> None:
    assert read('title = "a"') == Outer(title="a")
    text = 'title = "a"\ncount = 4\n[inner]\ndepth_m = 2\nnames = ["x", "y"]\n[other]\n'
    wanted = Outer(title="a", count=4, inner=Inner(depth_m=2.0, names=("x", "y")), other=Inner())
    assert read(text) == wanted
    assert isinstance(read(text).inner.depth_m, float)  # 2 was written


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("", "f.toml: title is missing"),
        ("title = 3", "f.toml:1: title: expected a string, got 3"),
        ('title = "a"\ntile = 3', "f.toml:2: tile: unknown key; did you mean title?"),
        ('title = "a"\nzzz = 3', "f.toml:2: zzz: unknown key; known here: title, count, on, inner, other"),
        ('title = "a"\ninner.depth_m = -1', "f.toml:2: [inner] depth_m: expected a positive number, got -1.0"),
        ('title = "a"\ninner = {depth_m = -1}', "f.toml:2: [inner] depth_m: expected a positive number, got -1.0"),
        ('title = "a"\n[inner]\n# no\n\ndepth_m = nan', "f.toml:5: [inner] depth_m: expected a finite number, got nan"),
        ('title = "a"\n[ inner ]\nnames = [1]', "f.toml:3: [inner] names: expected a string, got 1"),
        ('title = "a"\n[other]\ndepth_m = 0', "f.toml:3: [other] depth_m: expected a positive number, got 0.0"),
        ('title = "a"\n[inner]\n[other]\nnames = 1', "f.toml:4: [other] names: expected a list, got 1"),
        ('count = 6\non = true\ntitle = "a"', "f.toml: too many while on"),
    ],
)  # fmt: skip
def test_errors_say_where_and_what(text: str, error: str) -> None:
    assert refusal(text) == error


@pytest.mark.parametrize(
    ("text", "line"),
    [("a = \n", 1), ("a = 1\na = 2\n", 2), ("[x\n", 1), ("a = 1\nb = 'c", 2), ("a = [1,\n2,\n", 2), ("x = 1\n[y\n", 2)],
)
def test_broken_toml_names_a_line(text: str, line: int) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_toml(text, "f.toml")
    assert str(caught.value).startswith(f"f.toml:{line}: not TOML: ")
    assert "\n" not in str(caught.value)
    assert "at line" not in str(caught.value)


@given(st.text(max_size=60))
def test_any_text_is_a_table_or_one_line(text: str) -> None:
    try:
        assert isinstance(parse_toml(text, "f"), dict)
    except ConfigError as error:
        assert str(error).startswith("f:")  # noqa: PT017 - both outcomes are right


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "binary").write_bytes(b"\xff\xfe")
    for path, why in (
        (tmp_path / "missing", "no such file"),
        (tmp_path, "cannot be read: Is a directory"),
        (tmp_path / "binary", "cannot be read: not a text file in UTF-8"),
    ):
        with pytest.raises(ConfigError) as caught:
            read_text(path)
        assert str(caught.value) == f"{path}: {why}"
