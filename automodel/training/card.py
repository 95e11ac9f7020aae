"""The model card: what a shipped network is, what it learned from, and how good it is."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from automodel.training.metrics import NEAR_PX, Figures

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
