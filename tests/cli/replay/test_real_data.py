"""Recordings of real cars, with cameras estimated from their own pictures (see tests/cars)."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.realdata
CARS = Path(__file__).resolve().parents[2] / "cars"


def poses(path: Path) -> list[dict[str, str]]:
    """The rows; every field is a status, empty or a finite number."""
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        for name, text in row.items():
            assert name == "status" or text == "" or math.isfinite(float(text)), (row["frame"], name, text)
    return rows


@pytest.mark.parametrize(
    ("source", "car", "frames", "valid_pct", "width_m"),
    [
        # The tub's camera is a guess (see its file), so its width is known roughly.
        ("donkeycar_tub", "donkeycar_tub.toml", 1000, 95.0, (0.50, 1.0)),
        ("udacity/solidWhiteRight.mp4", "solid_white_right.toml", 221, 100.0, (3.3, 4.1)),
    ],
)
def test_every_frame_is_looked_at(
    source: str, car: str, frames: int, valid_pct: float, width_m: tuple[float, float], data_root, tmp_path, cli
) -> None:
    table = tmp_path / "poses.csv"
    said = cli("replay", data_root / source, "--car", CARS / car, "--csv", table, "--json")
    assert (said.code, said.err) == (0, "")
    (row,) = said.rows
    rows = poses(table)
    assert row["frames"] == len(rows) == frames
    assert [int(line["frame"]) for line in rows] == list(range(frames))
    valid = [line for line in rows if line["status"] != "LOST"]
    assert row["availability_pct"] == pytest.approx(100.0 * len(valid) / frames)
    assert row["availability_pct"] >= valid_pct
    assert all(line["offset_m"] == "" for line in rows if line["status"] == "LOST")
    widths_m = np.array([float(line["width_m"]) for line in valid])
    least_m, most_m = width_m
    assert np.mean((least_m < widths_m) & (widths_m < most_m)) >= 0.95


def test_the_overlay_of_a_real_video(data_root: Path, tmp_path: Path, cli) -> None:
    """Inside the lane's triangle the overlay changes the picture, in the sky it does not."""
    import cv2

    video = tmp_path / "overlay.mp4"
    source = data_root / "udacity" / "solidWhiteRight.mp4"
    assert cli("replay", source, "--car", CARS / "solid_white_right.toml", "--video", video).code == 0
    drawn, plain = cv2.VideoCapture(str(video)), cv2.VideoCapture(str(source))
    count = 0
    while True:
        (there, a), (still, b) = drawn.read(), plain.read()
        if not (there and still):
            break
        count += 1
        grey = cv2.cvtColor(b, cv2.COLOR_BGR2GRAY)[:, :, None].astype(int)  # what the pipeline was given
        change = np.abs(a[:540] - grey).max(axis=2)  # below lies the strip with the figures
        assert (change[330:530] > 60).mean() > 0.005
        assert np.median(change[100:250]) < 25
    drawn.release()
    plain.release()
    assert count == 221
