"""The TuSimple lane benchmark: its labels, its metric, and what it hides: the error of the lane's middle.

The metric is that of the benchmark's own `evaluate/lane.py`: on the rows of a label a predicted point is right that
lies within 20 px / cos(angle of the lane) of the label's, at 1280 pixels of width; where a label has no point, no point
is right. A lane's accuracy is the share of right rows; a label is matched by a prediction of accuracy 0.85. Of more
than four lanes the worst is forgiven. Pictures of another width have the tolerance scaled with it.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from automodel.curves.base import Curve
from automodel.geometry import GroundCamera
from automodel.reading import ConfigError
from automodel.signals import LaneEstimate
from automodel.types import FloatArray

NONE = -2  # stands in the files where a lane has no point
TOLERANCE_PX, MISSING_PX, OF_WIDTH_PX = 20.0, -100.0, 1280.0  # a missing point is taken for one at -100 px
MATCHED = 0.85
MOST_LANES = 4
FARTHEST_LANES = 20.0  # lane widths ahead: a few pixels under the horizon, where labels end
_STEPS = 400


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Label:
    """One labelled picture: `lanes` (k, n) of u [px] on the `rows` (n,) [px], NaN where a lane has no point."""

    raw_file: str
    lanes: FloatArray
    rows: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """Of one picture: `accuracy` 0..1, share of wrong predictions `fp`, share of missed labels `fn`.

    `accuracies` are those of the labels, one each, of the prediction that fits best.
    """

    accuracy: float
    fp: float
    fn: float
    accuracies: tuple[float, ...]


def parse_labels(text: str, file: str) -> list[Label]:
    """The labels in the lines of a label_data.json; raises ConfigError with file and line.

    Lanes without any point are left out. All labels must have the same number of rows as their lanes.
    """
    labels = []
    for number, line in enumerate(text.splitlines(), 1):
        if line.strip():
            labels.append(_label(line, f"{file}:{number}"))
    if not labels:
        raise ConfigError(f"{file}: no labels in it; a JSON object a line is wanted")
    names = [label.raw_file for label in labels]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ConfigError(f"{file}: {twice} is labelled twice; keep one line of it")
    return labels


def _label(line: str, where: str) -> Label:
    try:
        entry: Any = json.loads(line)
    except json.JSONDecodeError as error:
        raise ConfigError(f"{where}: not JSON: {error.msg}; is the line cut?") from None
    if not isinstance(entry, dict):
        raise ConfigError(f"{where}: a JSON object is wanted")
    for key, kind in (("raw_file", str), ("lanes", list), ("h_samples", list)):
        if not isinstance(entry.get(key), kind):
            raise ConfigError(f"{where}: {key}: {'missing' if key not in entry else 'of the wrong kind'}")
    rows = entry["h_samples"]
    if len(rows) < 2 or not all(map(_is_number, rows)) or any(b <= a for a, b in itertools.pairwise(rows)):
        raise ConfigError(f"{where}: h_samples: rising numbers are wanted")
    for number, lane in enumerate(entry["lanes"], 1):
        if not isinstance(lane, list) or not all(map(_is_number, lane)):
            raise ConfigError(f"{where}: lanes: lane {number} is no list of numbers")
        if len(lane) != len(rows):
            raise ConfigError(f"{where}: lanes: lane {number} has {len(lane)} points for {len(rows)} h_samples")
    lanes = np.array([lane for lane in entry["lanes"] if any(u >= 0 for u in lane)], dtype=np.float64)
    lanes = np.where(lanes < 0.0, np.nan, lanes).reshape(-1, len(rows))
    return Label(raw_file=entry["raw_file"], lanes=lanes, rows=np.array(rows, dtype=np.float64))


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and bool(np.isfinite(value))


def score(predicted: FloatArray, label: FloatArray, rows: FloatArray, width_px: int) -> Score:
    """The metric of lanes (j, n) against labelled ones (k, n) on the same rows (n,), NaN where there is no point."""
    tolerance = TOLERANCE_PX * width_px / OF_WIDTH_PX
    accuracies = []
    for lane in label:
        limit = tolerance / np.cos(_angle(lane, rows))
        away = np.abs(_with_none(predicted, width_px) - _with_none(lane, width_px))
        accuracies.append(float(np.mean(away < limit, axis=1).max(initial=0.0)))
    matched = sum(accuracy >= MATCHED for accuracy in accuracies)
    total, missed = sum(accuracies), len(accuracies) - matched
    if len(accuracies) > MOST_LANES:
        total -= min(accuracies)
        missed = max(missed - 1, 0)
    count = max(min(len(accuracies), MOST_LANES), 1)
    fp = (len(predicted) - matched) / len(predicted) if len(predicted) else 0.0
    return Score(accuracy=total / count, fp=fp, fn=missed / count, accuracies=tuple(accuracies))


def _with_none(lanes: FloatArray, width_px: int) -> FloatArray:
    """Lanes whose missing points lie where the benchmark puts them."""
    return np.where(np.isnan(lanes), MISSING_PX * width_px / OF_WIDTH_PX, lanes)


def _angle(lane: FloatArray, rows: FloatArray) -> float:
    """The lane's angle to the vertical [rad], of a straight line through its points."""
    known = ~np.isnan(lane)
    if np.count_nonzero(known) < 2:
        return 0.0
    down, u = rows[known] - rows[known].mean(), lane[known]
    return float(np.arctan(down @ u / (down @ down)))


def ego_lines(lanes: FloatArray, rows: FloatArray, middle_px: float) -> tuple[FloatArray | None, FloatArray | None]:
    """The lanes (n,) next to the left and right of `middle_px` on the lowest row; None where there is none.

    Lanes that end before it are carried on straight, by the lower half of their points.
    """
    left: tuple[float, FloatArray | None] = (-np.inf, None)
    right: tuple[float, FloatArray | None] = (np.inf, None)
    for lane in lanes:
        known = np.flatnonzero(~np.isnan(lane))
        if len(known) < 2:
            continue
        lower = known[min(len(known) // 2, len(known) - 2) :]
        start = float(np.polyfit(rows[lower] - rows[-1], lane[lower], 1)[1])
        if left[0] < start < middle_px:
            left = start, lane
        if middle_px <= start < right[0]:
            right = start, lane
    return left[1], right[1]


def centre_error_pct(predicted: Sequence[FloatArray], label: Sequence[FloatArray]) -> float | None:
    """How far the middle of two predicted lines (n,) lies from that of two labelled ones, in % of the lane's width.

    Each row is measured in the width that the label has on it; the median over the rows that all four lines have.
    """
    if len(predicted) != 2 or len(label) != 2:
        return None
    width = label[1] - label[0]
    error = 50.0 * np.abs(predicted[0] + predicted[1] - label[0] - label[1]) / np.where(width > 0.0, width, np.nan)
    known = error[~np.isnan(error)]
    return float(np.median(known)) if len(known) else None


def lines_px(estimate: LaneEstimate, camera: GroundCamera, rows: FloatArray, unit_m: float) -> FloatArray:
    """The estimate's two lines (2, n) as u [px] on `rows` (n,), left first; (0, n) where it has none.

    NaN is outside the picture. Beyond its ends each line is carried on as its curve is, until `FARTHEST_LANES` lane
    widths `unit_m` ahead.
    """
    if estimate.left is None or estimate.right is None:
        return np.empty((0, len(rows)))
    return np.stack([_on_rows(line.curve, camera, rows, unit_m) for line in (estimate.left, estimate.right)])


def _on_rows(curve: Curve, camera: GroundCamera, rows: FloatArray, unit_m: float) -> FloatArray:
    far = FARTHEST_LANES * unit_m
    s = np.concatenate(
        (np.linspace(-2.0 * unit_m, 0.0, _STEPS // 4, endpoint=False), np.geomspace(0.1 * unit_m, far, _STEPS))
    )
    pixels = camera.ground_to_px(curve.position(s))
    known = np.isfinite(pixels).all(axis=1)
    u, v = pixels[known].T
    rising = np.concatenate(([True], v[1:] < np.minimum.accumulate(v)[:-1])) if len(v) else np.empty(0, np.bool_)
    u, v = u[rising][::-1], v[rising][::-1]
    if len(v) < 2:
        return np.full(len(rows), np.nan)
    on_rows = np.interp(rows, v, u, left=np.nan, right=np.nan)
    inside = (on_rows >= 0.0) & (on_rows <= camera.camera.width_px - 1.0)
    return np.where(inside, on_rows, np.nan)
