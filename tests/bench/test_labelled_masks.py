"""`bench network --root`: masks against labels that are known exactly."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from automodel.bench.labelled_masks import COLUMNS, measure
from automodel.config.toml_reader import ConfigError
from tests.support.command_line import Cli, cli

__all__ = ["cli"]

ROWS = list(range(100, 256, 10))


def folder(root: Path) -> Path:
    """One image with two labelled lanes, straight down at columns 100 and 300."""
    (root / "clips").mkdir()
    assert cv2.imwrite(str(root / "clips/1.png"), np.zeros((256, 512), np.uint8))
    lanes = [[100] * len(ROWS), [300] * len(ROWS)]
    label = {"raw_file": "clips/1.png", "lanes": lanes, "h_samples": ROWS}
    (root / "label_data.json").write_text(json.dumps(label) + "\n")
    return root


def marks(*columns: int, rows: slice = slice(None)) -> SimpleNamespace:
    mask = np.zeros((256, 512), np.uint8)
    for column in columns:
        mask[rows, column] = 255
    return SimpleNamespace(size="512x256", from_above=False, step=lambda _: mask)


@pytest.mark.parametrize(
    ("network", "figures"),
    [
        (marks(100, 300), (0.0, 100.0, 100.0)),
        (marks(100), (0.0, 50.0, 50.0)),
        (marks(105, 305), (0.0, 100.0, 100.0)),
        (marks(112, 312), (100.0, 0.0, 0.0)),
        (marks(100, 200), (50.0, 50.0, 50.0)),
        (marks(100, rows=slice(0, 90)), (0.0, 0.0, 0.0)),  # above all labels
        (marks(100, 300, rows=slice(240, None)), (0.0, 100.0 * 16 / 151, 0.0)),  # on less than a fifth
        (marks(), (0.0, 0.0, 0.0)),
    ],
    ids=["all", "one", "5 px off", "12 px off", "one false", "above", "short", "none"],
)
def test_the_shares_of_known_masks(tmp_path: Path, network: SimpleNamespace, figures: tuple[float, ...]) -> None:
    row = measure(folder(tmp_path), network)  # type: ignore[arg-type]
    assert set(row) == set(COLUMNS)
    assert (row["images"], row["lanes"]) == (1, 2)
    assert (row["far_pct"], row["points_pct"], row["lanes_pct"]) == pytest.approx(figures, abs=2.0)


def test_a_folder_without_labels_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="label_data"):
        measure(tmp_path, marks())  # type: ignore[arg-type]


def test_a_network_that_looks_from_above_needs_a_camera(tmp_path: Path, cli: Cli) -> None:
    said = cli("bench", "network", "--size", "birdseye", "--root", tmp_path)
    assert said.code == 2
    assert "no camera is given" in said.line()
