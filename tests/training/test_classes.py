"""Drawn images of one class each, and `automodel bench network`."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from automodel.perception.markings.unet import BIRDSEYE, SIZES
from automodel.training import classes
from automodel.training.classes import CLASSES, COLUMNS, class_sample, measure
from automodel.training.scenes import Sample
from automodel.training.shapes import UNKNOWN
from tests.support.command_line import Cli, cli

__all__ = ["cli"]


def samples(name: str, count: int = 8) -> list[Sample]:
    return [class_sample(name, seed) for seed in range(count)]


def widths_px(name: str) -> float:
    """The median over images of the largest half width of what is labelled."""
    found = [cv2.distanceTransform((s.mask >= 128).astype(np.uint8), cv2.DIST_L2, 5).max() for s in samples(name)]
    return float(np.median(found))


def test_a_sample_follows_from_class_and_seed() -> None:
    first, again = class_sample("blur", 4), class_sample("blur", 4)
    assert np.array_equal(first.image, again.image)
    assert np.array_equal(first.mask, again.mask)
    assert not np.array_equal(first.image, class_sample("blur", 5).image)
    with pytest.raises(ValueError, match="tuple"):
        class_sample("unknown", 0)


def test_thin_lines_are_thin_and_wide_ones_wide() -> None:
    assert 3.0 * widths_px("thin") < widths_px("ordinary") < 0.7 * widths_px("wide")


def test_horizontal_lines_are_level() -> None:
    level = []
    for sample in samples("horizontal", 12):
        rows, columns = np.nonzero(sample.mask > UNKNOWN)
        if len(rows) > 300:
            level.append(np.ptp(np.percentile(columns, (5, 95))) > 2.0 * np.ptp(np.percentile(rows, (5, 95))))
    assert len(level) > 4
    assert np.mean(level) > 0.7


def test_the_image_of_dark_tape_is_the_negative_that_the_network_gets() -> None:
    brighter = []
    for sample in samples("dark tape"):
        core, beside = sample.mask > 250, cv2.dilate(sample.mask, np.ones((15, 15), np.uint8)) == 0
        if core.sum() > 200:
            near = cv2.dilate(core.astype(np.uint8), np.ones((31, 31), np.uint8)) > 0
            brighter.append(sample.image[core].mean() > sample.image[beside & near].mean())
    assert len(brighter) > 4
    assert np.mean(brighter) > 0.8


def test_a_perfect_network_gets_all(monkeypatch: pytest.MonkeyPatch) -> None:
    truth = np.zeros((256, 512), np.uint8)
    truth[:, 100:110] = 255
    monkeypatch.setattr(classes, "class_sample", lambda name, seed, above: SimpleNamespace(image=truth, mask=truth))
    network = SimpleNamespace(size="512x256", from_above=False, width_px=512, height_px=256, step=lambda grey: grey)
    rows = measure(network, 2, 0)  # type: ignore[arg-type]
    assert [row["class"] for row in rows] == list(CLASSES)
    assert all(set(row) == set(COLUMNS) and row["f1"] == 1.0 for row in rows)


def test_a_class_can_be_seen_from_above() -> None:
    sample = class_sample("ordinary", 1, above=True)
    assert sample.image.shape == sample.mask.shape == SIZES[BIRDSEYE][::-1]
    assert (sample.mask >= 128).sum() > 100


def test_the_command_measures_the_network_that_ships(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(classes, "CLASSES", ("ordinary", "blur"))
    for size in ("256x128", BIRDSEYE):
        said = cli("bench", "network", "--size", size, "--images", 2, "--json")
        assert said.code == 0, said.err
        assert [(row["size"], row["class"], row["images"]) for row in said.rows] == [
            (size, "ordinary", 2),
            (size, "blur", 2),
        ]


def test_a_model_that_is_missing_is_reported(cli: Cli, tmp_path: Path) -> None:
    found = cli("bench", "network", "--model", tmp_path / "none.onnx")
    assert found.code == 2
    assert "no such file" in found.line()
