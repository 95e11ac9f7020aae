"""Training pictures on disk, and batches of them.

Pictures are drawn once and kept as shards, .npy files of `SHARD` pictures with their masks, read through the memory
map: drawing one takes longer than learning from it. A folder's `data.json` says which drawing program they are from.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from automodel.config.toml_reader import ConfigError
from automodel.output_files import output_path
from automodel.training.scenes import make_sample
from automodel.types import Image

WIDTH_PX, HEIGHT_PX = 512, 256  # of every picture kept; a smaller network learns from them made smaller
SHARD = 128
INDEX = "data.json"
FIRST_TRAINING_SEED = 1_000_000  # seeds below are for validation


class Drawn(Protocol):
    """A picture and its mask, uint8 (h, w) both."""

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
    """One file of pictures: those of the seeds `first_seed` and the next ones."""

    path: Path
    first_seed: int
    count: int


def data_version(make: Maker = make_sample) -> str:
    """Twelve digits that change when the drawing program draws otherwise."""
    digest = hashlib.sha256()
    for seed in range(4):
        sample = make(seed)
        digest.update(sample.image.tobytes() + sample.mask.tobytes())
    return digest.hexdigest()[:12]


def shards(folder: Path, first_seed: int, count: int) -> list[Shard]:
    """The files that hold the pictures of `count` seeds from `first_seed` on."""
    return [
        Shard(path=folder / f"{first_seed + at:09d}.npy", first_seed=first_seed + at, count=min(SHARD, count - at))
        for at in range(0, count, SHARD)
    ]


def missing(wanted: list[Shard]) -> list[Shard]:
    """Those that are not on disk, or hold another number of pictures."""
    return [shard for shard in wanted if not _is_whole(shard)]


def write_shard(shard: Shard, make: Maker = make_sample, tick: Callable[[float], None] = lambda share: None) -> None:
    """Draw a shard's pictures and write them; a file is there whole or not at all.

    `tick` gets the share of the shard that each picture is.
    """
    pictures = np.empty((shard.count, 2, HEIGHT_PX, WIDTH_PX), np.uint8)
    for row, seed in zip(pictures, range(shard.first_seed, shard.first_seed + shard.count), strict=True):
        sample = make(seed)
        row[0], row[1] = sample.image, sample.mask
        tick(1.0 / shard.count)
    with output_path(shard.path) as part:
        np.save(part, pictures)


def claim_folder(folder: Path, version: str) -> None:
    """Make the folder for pictures of this version; raises ConfigError when it holds those of another."""
    index = folder / INDEX
    folder.mkdir(parents=True, exist_ok=True)
    try:
        found = json.loads(index.read_text(encoding="utf-8"))["version"]
    except FileNotFoundError:
        index.write_text(json.dumps({"version": version}) + "\n", encoding="utf-8")
        return
    except (ValueError, KeyError, TypeError):
        raise ConfigError(f"{index}: cannot be read; delete the folder's files, they are drawn anew") from None
    if found != version:
        raise ConfigError(
            f"{folder}: holds pictures of data version {found}, now {version}; delete them or name another"
        )


class Pictures:
    """The pictures of some shards, by index; each is (2, h, w) uint8: grey and mask. Raises ConfigError."""

    def __init__(self, wanted: list[Shard]) -> None:
        self._parts = [_opened(shard) for shard in wanted]
        self._starts = np.cumsum([0, *(len(part) for part in self._parts)])

    def __len__(self) -> int:
        return int(self._starts[-1])

    def __getitem__(self, index: int) -> Image:
        if not 0 <= index < len(self):
            raise IndexError(index)
        at = int(np.searchsorted(self._starts, index, side="right")) - 1
        return np.asarray(self._parts[at][index - self._starts[at]])


def resized(picture: Image, width_px: int, height_px: int) -> Image:
    """A picture and its mask (2, h, w) at another size."""
    if picture.shape[1:] == (height_px, width_px):
        return picture
    way = cv2.INTER_AREA if picture.shape[2] >= width_px else cv2.INTER_LINEAR
    layers = [cv2.resize(layer, (width_px, height_px), interpolation=way) for layer in picture]
    return np.asarray(layers, dtype=np.uint8)


class Batches:
    """Endless batches (n, 2, h, w) of pictures and masks in random order, each changed at random.

    Half are mirrored, half are a part of the picture enlarged up to `ZOOM` times, most change in gain and gamma.
    """

    ZOOM, STRETCH = 1.7, 1.25

    def __init__(self, pictures: Pictures, width_px: int, height_px: int, batch: int, seed: int) -> None:
        if not len(pictures):
            raise ValueError("there are no pictures to learn from")
        self._pictures, self._batch = pictures, batch
        self._size = width_px, height_px
        self._rng = np.random.default_rng(seed)

    def __iter__(self) -> Iterator[Image]:
        waiting: list[int] = []
        while True:
            while len(waiting) < self._batch:
                waiting.extend(self._rng.permutation(len(self._pictures)).tolist())
            now, waiting = waiting[: self._batch], waiting[self._batch :]
            yield np.stack([self._changed(self._pictures[index]) for index in now])

    def _changed(self, picture: Image) -> Image:
        rng = self._rng
        if rng.random() < 0.5:
            picture = self._part_of(picture)
        picture = resized(picture, *self._size)
        if rng.random() < 0.5:
            picture = picture[:, :, ::-1]
        if rng.random() < 0.7:
            grey = cv2.LUT(np.ascontiguousarray(picture[0]), _tone(rng))
            picture = np.stack((np.asarray(grey, dtype=np.uint8), picture[1]))
        return picture

    def _part_of(self, picture: Image) -> Image:
        rng, (h, w) = self._rng, picture.shape[1:]
        zoom, stretch = rng.uniform(1.0, self.ZOOM), self.STRETCH ** rng.uniform(-0.5, 0.5)
        part_w, part_h = round(min(w / (zoom * stretch), w)), round(min(h / zoom * stretch, h))
        left, top = rng.integers(w - part_w + 1), rng.integers(h - part_h + 1)
        return picture[:, top : top + part_h, left : left + part_w]


def _tone(rng: np.random.Generator) -> Image:
    """A table of 256 grey values: gamma, gain and offset at random."""
    grey = np.linspace(0.0, 1.0, 256) ** np.exp(rng.uniform(-0.5, 0.5))
    return np.clip(255.0 * grey * rng.uniform(0.6, 1.3) + rng.uniform(-25.0, 25.0), 0, 255).astype(np.uint8)


def _opened(shard: Shard) -> Image:
    try:
        pictures = np.load(shard.path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{shard.path}: cannot be read: {error}; delete it, it is drawn anew") from None
    if pictures.shape != (shard.count, 2, HEIGHT_PX, WIDTH_PX) or pictures.dtype != np.uint8:
        raise ConfigError(f"{shard.path}: holds {pictures.shape} {pictures.dtype}; delete it, it is drawn anew")
    return pictures


def _is_whole(shard: Shard) -> bool:
    try:
        _opened(shard)
    except ConfigError:
        return False
    return True
