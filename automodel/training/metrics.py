"""How good masks are, against drawn truth: counted in pixels over many pictures.

The model card: what a shipped network is, what it learned from, and how good it is.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from automodel.training.shapes import UNKNOWN
from automodel.types import Image

HALF = 128  # probability and coverage of one half
FAINT = 26  # coverage of a tenth: near a pixel like this a mark is not false
NEAR_PX = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Figures:
    """Shares of pixels, 0..1; 0 where there was nothing to count."""

    precision: float  # of marked pixels, those that are labelled
    recall: float  # of labelled pixels, those that are marked
    iou: float
    near_precision: float  # of marked pixels, those with a label (even a faint one) within NEAR_PX
    near_recall: float  # of labelled pixels, those with a mark within NEAR_PX

    @property
    def score(self) -> float:
        """One number to compare networks by: the harmonic mean of `near_precision` and `near_recall`."""
        return _share(2.0 * self.near_precision * self.near_recall, self.near_precision + self.near_recall)


def measured(network: Callable[[Image], Image], pictures: Iterable[Image]) -> Figures:
    """The figures of a network (grey picture to mask) on pictures (2, h, w), grey and truth."""
    counts = np.zeros(6)
    for grey, truth in pictures:
        marked, labelled = (network(grey) >= HALF) & (truth != UNKNOWN), truth >= HALF
        near_label = _widened(truth >= FAINT)
        counts += (
            np.count_nonzero(marked & labelled),
            np.count_nonzero(marked),
            np.count_nonzero(labelled),
            np.count_nonzero(marked | labelled),
            np.count_nonzero(marked & near_label),
            np.count_nonzero(labelled & _widened(marked)),
        )
    both, marks, labels, either, near_marks, near_labels = counts.tolist()
    return Figures(
        precision=_share(both, marks),
        recall=_share(both, labels),
        iou=_share(both, either),
        near_precision=_share(near_marks, marks),
        near_recall=_share(near_labels, labels),
    )


def _widened(pixels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The pixels within NEAR_PX (Euclidean) of those given."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * NEAR_PX + 1, 2 * NEAR_PX + 1))
    return np.asarray(cv2.dilate(pixels.view(np.uint8), disc)) > 0


def _share(part: float, whole: float) -> float:
    return part / whole if whole else 0.0


HEADER = f"""\
# The marking networks

They find lane markings in grey pictures. Input `image`, uint8 (1, 1, height, width); output `marking`, uint8 of the
same shape: the probability of "lane marking" of each pixel times 255.

- **Made by** `automodel train`: a U-Net of two levels on the picture packed to half size
  (`automodel/training/unet.py`), after P. Cudrano et al. 2020.
- **Data**: drawn pictures only, none of them real (`automodel/training/scenes.py`).
- **For** lane markings on the ground, seen by a car's camera that looks ahead. Not for anything else.

Precision, recall and IoU count pixels of held-out drawn pictures, at a probability of one half. The "near" figures
allow {NEAR_PX} px between a mark and a label.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Origin:
    """How a network came to be; kept inside its ONNX file too."""

    size: str
    seed: int
    steps: int
    batch: int
    samples: int
    validation: int
    data_version: str
    parameters: int
    resumed: bool
    command: str


def write_figures(path: Path, origin: Origin, figures: Figures) -> None:
    """What `write_card` reads, beside the network's ONNX file."""
    text = json.dumps({"origin": asdict(origin), "figures": asdict(figures)}, indent=1)
    path.write_text(text + "\n", encoding="utf-8")


def write_card(folder: Path) -> None:
    """MODEL_CARD.md of all the networks in a folder, from the files of `write_figures` there."""
    parts = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("marking_*.json"))]
    (folder / "MODEL_CARD.md").write_text("\n".join([HEADER, *map(_section, parts)]), encoding="utf-8")


def _section(part: Mapping[str, Mapping[str, object]]) -> str:
    origin, figures = part["origin"], part["figures"]
    rows = [(key.replace("_", " "), str(value)) for key, value in origin.items() if key not in ("size", "command")]
    rows += [(key.replace("_", " "), f"{value:.3f}") for key, value in figures.items()]
    lines = [f"## marking_{origin['size']}.onnx", "", f"`{origin['command']}`", "", "| | |", "|---|---|"]
    return "\n".join([*lines, *(f"| {name} | {value} |" for name, value in rows), ""])
