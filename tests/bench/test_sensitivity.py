"""What a number matters: a short run in which one does and another does not."""

from __future__ import annotations

from pathlib import Path

import pytest

from automodel.bench.sensitivity import METRICS, SensitivityChoice, measure, measure_number
from automodel.bench.tuned_numbers import tuned_numbers
from automodel.config import CarConfig, ConfigError
from automodel.console.workers import Sweep


@pytest.fixture(autouse=True)
def no_real_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AUTOMODEL_DATA", str(tmp_path))


def choice_of(*only: str) -> SensitivityChoice:
    return SensitivityChoice(only=only, pipelines=("windows",), seeds=range(4, 5), frames=25)


def test_one_number_matters_and_another_does_not() -> None:
    rows = measure(CarConfig(), choice_of("SlidingWindows.WIDTH", "road.MAX_GAP_S"), Sweep(jobs=1))
    width, gap = rows  # what matters most comes first
    assert (width["number"].split(".")[-1], gap["number"].split(".")[-1]) == ("WIDTH", "MAX_GAP_S")
    assert width["changed_pct"] > 0.0
    assert width["effect"] == max(width[step] for step in ("minus_50", "minus_20", "plus_20", "plus_50"))
    assert width["minus_50"] == sum(abs(width[f"minus_50_{metric}"]) for metric in METRICS)
    assert (gap["changed_pct"], gap["effect"], gap["error"]) == (0.0, 0.0, "")
    assert (gap["plus_50"], gap["plus_20"]) == (0.0, None)  # what does not matter is not looked at more closely


def test_a_number_that_cannot_be_so_is_no_end() -> None:
    choice = choice_of("SlidingWindows.COUNT")
    (number,) = tuned_numbers(choice.only)
    broken = type(number)(**{name: getattr(number, name) for name in number.__slots__} | {"value": -12})
    row = measure_number(CarConfig(), choice, (broken, "windows"), lambda _: None)
    assert row["error"]
    assert row["changed_pct"] == 100.0


def test_nothing_chosen_is_refused() -> None:
    with pytest.raises(ConfigError, match="no tuned number of windows"):
        measure(CarConfig(), choice_of("no such number"), Sweep(jobs=1))
