"""Training samples on disk.

Drawing a sample takes longer than learning from it, so samples are stored: in shards, .npy files of `SHARD` samples,
which are memory-mapped. The version in a folder's `data.json` is that of the code that drew them.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from automodel.config.toml_reader import ConfigError
from automodel.output_files import output_path, output_text
from automodel.training.scenes import make_sample
from automodel.types import Image

WIDTH_PX, HEIGHT_PX = 512, 256  # of the stored pictures; they are resized for a smaller network
SHARD = 128
INDEX = "data.json"
FIRST_TRAINING_SEED = 1_000_000  # seeds below are for validation


class Drawn(Protocol):
    """An image and its mask, both uint8 (h, w)."""

    @property
    def image(self) -> Image:
        """Image."""
        ...

    @property
    def mask(self) -> Image:
        """How much of each pixel is lane marking, 0..255."""
        ...


Maker = Callable[[int], Drawn]


@dataclass(frozen=True, slots=True, kw_only=True)
class Shard:
    """One file with the samples of `count` seeds from `first_seed` on, of `width_px` and `height_px`."""

    path: Path
    first_seed: int
    count: int
    width_px: int = WIDTH_PX
    height_px: int = HEIGHT_PX

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of its samples."""
        return self.count, 2, self.height_px, self.width_px


def data_version(make: Maker = make_sample) -> str:
    """Twelve digits that change when the drawing program draws otherwise."""
    digest = hashlib.sha256()
    for seed in range(4):
        sample = make(seed)
        digest.update(sample.image.tobytes() + sample.mask.tobytes())
    return digest.hexdigest()[:12]


def shards(
    folder: Path, first_seed: int, count: int, width_px: int = WIDTH_PX, height_px: int = HEIGHT_PX
) -> list[Shard]:
    """The shards with the samples of `count` seeds from `first_seed` on."""
    return [
        Shard(
            path=folder / f"{first_seed + at:09d}.npy",
            first_seed=first_seed + at,
            count=min(SHARD, count - at),
            width_px=width_px,
            height_px=height_px,
        )
        for at in range(0, count, SHARD)
    ]


def missing(selected: list[Shard]) -> list[Shard]:
    """The shards that are not on disk or have another number of samples."""
    return [shard for shard in selected if not _is_whole(shard)]


def write_shard(shard: Shard, make: Maker = make_sample, tick: Callable[[float], None] = lambda share: None) -> None:
    """Draw the samples of a shard and write its file.

    `tick` gets the share of the shard that each sample is.
    """
    samples = np.empty(shard.shape, np.uint8)
    for row, seed in zip(samples, range(shard.first_seed, shard.first_seed + shard.count), strict=True):
        sample = make(seed)
        row[0], row[1] = sample.image, sample.mask
        tick(1.0 / shard.count)
    with output_path(shard.path) as part:
        np.save(part, samples)


def claim_folder(folder: Path, version: str) -> None:
    """Create the folder for samples of this version; raises ConfigError if it has samples of another one."""
    index = folder / INDEX
    folder.mkdir(parents=True, exist_ok=True)
    try:
        found = json.loads(index.read_text(encoding="utf-8"))["version"]
    except FileNotFoundError:
        with output_text(index) as file:
            file.write(json.dumps({"version": version}) + "\n")
        return
    except (ValueError, KeyError, TypeError):
        raise ConfigError(f"{index}: cannot be read; delete the folder's files, they are drawn again") from None
    if found != version:
        raise ConfigError(
            f"{folder}: has samples of data version {found}, not {version}; delete them or choose another folder"
        )


class Samples:
    """The samples of several shards by index, each (2, h, w) uint8: grey image and mask. Raises ConfigError."""

    def __init__(self, selected: list[Shard]) -> None:
        self.parts = [_opened(shard) for shard in selected]
        self._starts = np.cumsum([0, *(len(part) for part in self.parts)])

    def __len__(self) -> int:
        return int(self._starts[-1])

    def __getitem__(self, index: int) -> Image:
        if not 0 <= index < len(self):
            raise IndexError(index)
        at = int(np.searchsorted(self._starts, index, side="right")) - 1
        return np.asarray(self.parts[at][index - self._starts[at]])


def resized(sample: Image, width_px: int, height_px: int) -> Image:
    """A sample (2, h, w) at another size."""
    if sample.shape[1:] == (height_px, width_px):
        return sample
    method = cv2.INTER_AREA if sample.shape[2] >= width_px else cv2.INTER_LINEAR
    layers = [cv2.resize(layer, (width_px, height_px), interpolation=method) for layer in sample]
    return np.asarray(layers, dtype=np.uint8)


def _opened(shard: Shard) -> Image:
    try:
        samples = np.load(shard.path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{shard.path}: cannot be read: {error}; delete it, it is drawn again") from None
    if samples.shape != shard.shape or samples.dtype != np.uint8:
        raise ConfigError(f"{shard.path}: holds {samples.shape} {samples.dtype}; delete it, it is drawn again")
    return samples


def _is_whole(shard: Shard) -> bool:
    try:
        _opened(shard)
    except ConfigError:
        return False
    return True
