"""`bench network --root`: the network's mask on labelled highway images (TuSimple's form), without a pipeline.

Labels run on through the gaps of dashed lines, and only the lanes around the car are labelled: other lines count as
far from a label, and no network reaches every labelled point.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from automodel.bench.accuracy import Row
from automodel.bench.tusimple import Label, read_labels
from automodel.config.toml_reader import ConfigError
from automodel.perception.markings.binary_views import adaptive_threshold
from automodel.perception.markings.unet import MarkingNetwork
from automodel.sources.images import read_image
from automodel.types import Bools, Floats

COLUMNS = ("size", "images", "lanes", "far_pct", "points_pct", "lanes_pct")
NEAR_SHARE, FAR_SHARE = 5.0 / 512.0, 8.0 / 512.0  # of the image's width: near a label, and far from all
SUPPORT = 0.2  # of a lane's rows from which it counts as seen
MARKED = 128  # of 255


def measure(root: Path, network: MarkingNetwork) -> Row:
    """A row of `COLUMNS`, after `adaptive_threshold`: shares of marked pixels, labelled rows and lanes [%].

    `far_pct`: marked pixels far from every label, from the highest labelled row down; `points_pct`: labelled rows with
    a marked pixel near; `lanes_pct`: lanes with such a pixel on at least a fifth of their rows. Raises ConfigError.
    """
    if network.from_above:
        raise ConfigError(f"--size {network.size}: no camera is given to see --root from above; choose another size")
    counts, shares = np.zeros(4), list[float]()
    labels = read_labels(root)
    for label in labels:
        grey = read_image(root / label.raw_file, False)
        height, width = grey.shape[:2]
        mask = cv2.resize(adaptive_threshold(network.step(grey)), (width, height), interpolation=cv2.INTER_LINEAR)
        marked = np.asarray(mask >= MARKED)
        lanes = [_rows(lane, label, width, height) for lane in label.lanes]
        drawn = np.zeros((height, width), dtype=np.bool_)
        for v, u in lanes:
            drawn[v, u] = True
        first = min(int(v[0]) for v, _ in lanes)
        below, far = marked[first:], _away(drawn)[first:] > FAR_SHARE * width
        counts[:2] += np.array((np.count_nonzero(below & far), np.count_nonzero(below)))
        away = _away(marked)
        for v, u in lanes:
            near = away[v, u] <= NEAR_SHARE * width
            counts[2:] += np.array((np.count_nonzero(near), len(near)))
            shares.append(float(near.mean()))
    far_marks, marks, near_rows, rows = counts.tolist()
    return {
        "size": network.size,
        "images": len(labels),
        "lanes": len(shares),
        "far_pct": 100.0 * far_marks / max(marks, 1.0),
        "points_pct": 100.0 * near_rows / max(rows, 1.0),
        "lanes_pct": 100.0 * float(np.mean(np.array(shares) >= SUPPORT)),
    }


def _rows(lane: Floats, label: Label, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """The pixels (v, u) of a labelled lane on each row from its first to its last point."""
    known = ~np.isnan(lane)
    v = np.arange(label.rows[known].min(), label.rows[known].max() + 1.0)
    u = np.interp(v, label.rows[known], lane[known])
    return v.astype(np.intp).clip(0, height - 1), np.rint(u).astype(np.intp).clip(0, width - 1)


def _away(pixels: Bools) -> Floats:
    """The distance [px] of each pixel from the nearest of those given."""
    return np.asarray(cv2.distanceTransform((~pixels).astype(np.uint8), cv2.DIST_L2, 5))
