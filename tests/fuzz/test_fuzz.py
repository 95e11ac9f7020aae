"""A few damaged files at every parser; `python -m tests.fuzz` tries more."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from random import Random

import pytest

from tests.fuzz.damage import damaged
from tests.fuzz.runner import trials
from tests.fuzz.targets import TARGETS, Target

COUNT = 6  # of each target: half a minute in all


# python-can leaves a file open whose header it cannot read, until it is collected
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("target", TARGETS, ids=[target.name for target in TARGETS])
def test_damaged_files_are_one_line_and_leave_nothing(target: Target, tmp_path: Path) -> None:
    assert [text for _, text in trials(target, COUNT, 1, tmp_path) if text] == []


@pytest.mark.parametrize("target", TARGETS, ids=[target.name for target in TARGETS])
def test_good_files_are_taken(target: Target, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.fuzz.runner.damaged", lambda data, random: data)
    monkeypatch.setattr("tests.fuzz.runner.CODES", (0, 1))  # 1: a bus without good messages, a car that did not drive
    assert [text for _, text in trials(target, 1, 1, tmp_path)] == [""]


def test_a_parser_that_raises_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def raising(path: object) -> None:
        raise KeyError("speed")

    (motion,) = (target for target in TARGETS if target.name == "motion")
    monkeypatch.setattr("automodel.assembly.replay.read_motion_csv", raising)
    assert [text for _, text in trials(motion, 1, 1, tmp_path)] == ["traceback: KeyError: 'speed'"]


def test_a_file_that_is_left_behind_is_found(tmp_path: Path) -> None:
    (car,) = (target for target in TARGETS if target.name == "car")
    other = dataclasses.replace(car, out=("another.csv",))
    texts = [text for _, text in trials(other, 40, 2, tmp_path)]
    assert "half written: {'out.csv'}" in texts


def test_an_older_result_that_is_lost_is_found(tmp_path: Path) -> None:
    def destroying(arguments: list[str]) -> int:
        (Path(arguments[0]).parent / "out.csv").write_text("")
        sys.stderr.write("a line\n")
        return 2

    (car,) = (target for target in TARGETS if target.name == "car")
    other = dataclasses.replace(car, arguments=("{}/car.toml",), call=destroying)
    texts = [text for _, text in trials(other, 4, 2, tmp_path)]
    assert texts == ["left behind: {'out.csv'}", "an older one is lost: {'out.csv'}"] * 2


def test_damage_is_the_same_for_the_same_seed() -> None:
    for seed in range(50):
        assert damaged(b"a = 1\nb = 2\n", Random(seed)) == damaged(b"a = 1\nb = 2\n", Random(seed))
    assert len({damaged(b"a = 1\nb = 2\n", Random(seed)) for seed in range(50)}) > 20
