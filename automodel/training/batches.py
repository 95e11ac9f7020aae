"""Endless batches of randomly changed samples for training, made on the device that trains. Needs torch.

Each batch follows from the seed and its own number alone, so that a training that was interrupted goes on with the
batches that it would have had.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from automodel.perception.markings.onnx_check import STRIDE
from automodel.training.dataset import Samples
from automodel.types import IntArray

ZOOM, STRETCH = 1.7, 1.25  # largest enlargement of a part of a sample, and how much wider or higher it may become
SHOWN = (1.0, 1.0, 0.75, 0.625)  # of an image's rows, the share from the bottom: in the car a network sees the road
NOISE = 5.0  # largest standard deviation of noise that is added [grey levels]
MOST_OF_MEMORY = 0.5  # of a GPU's free memory that samples may fill


class Batches:
    """Endless batches (n, 2, rows, w) uint8, image and mask, of samples in random order, each once a round.

    Half of them are mirrored, half are parts enlarged up to `ZOOM` times, most have a random gain and gamma and some
    noise. A batch has one of the shares `shown` of the rows. `start` is the number of the first batch. On a GPU all
    samples are kept in its memory where they fit.
    """

    def __init__(
        self,
        samples: Samples,
        width_px: int,
        height_px: int,
        batch: int,
        seed: int,
        device: str = "cpu",
        shown: tuple[float, ...] = SHOWN,
    ) -> None:
        if not len(samples):
            raise ValueError("there are no samples to learn from")
        self._samples, self._batch, self._seed = samples, batch, seed
        self._width_px, self._height_px, self._shown = width_px, height_px, shown
        self._device = torch.device(device)
        self.start = 0
        self._resident = self._all_samples() if self._fits() else None
        self._order: tuple[int, IntArray] = (-1, np.empty(0, np.int64))

    def __iter__(self) -> Iterator[Tensor]:
        number = self.start
        while True:
            yield self.at(number)
            number += 1

    def at(self, number: int) -> Tensor:
        """The batch of that number."""
        rng = np.random.default_rng((self._seed, number))
        return self._changed(self._taken(self.indices(number)), rng)

    def indices(self, number: int) -> list[int]:
        """The indices of a batch's samples."""
        count = len(self._samples)
        found = []
        for place in range(number * self._batch, (number + 1) * self._batch):
            turn, at = divmod(place, count)
            if self._order[0] != turn:
                self._order = turn, np.random.default_rng((self._seed, turn, count)).permutation(count)
            found.append(int(self._order[1][at]))
        return found

    def _fits(self) -> bool:
        if self._device.type != "cuda":
            return False
        free, _ = torch.cuda.mem_get_info(self._device)
        return len(self._samples) * self._samples[0].size < MOST_OF_MEMORY * free

    def _all_samples(self) -> Tensor:
        whole = torch.empty((len(self._samples), *self._samples[0].shape), dtype=torch.uint8, device=self._device)
        at = 0
        for part in self._samples.parts:
            whole[at : at + len(part)] = torch.from_numpy(np.array(part)).to(self._device)
            at += len(part)
        return whole

    def _taken(self, indices: list[int]) -> Tensor:
        if self._resident is not None:
            return self._resident[torch.tensor(indices, device=self._device)]
        return torch.from_numpy(np.stack([self._samples[index] for index in indices])).to(self._device)

    def _changed(self, samples: Tensor, rng: np.random.Generator) -> Tensor:
        """Samples (n, 2, h, w) uint8, changed at random, of the network's width and at most its height."""
        count = len(samples)
        across, down, left, top = _parts(rng, count)
        mirror = np.where(rng.random(count) < 0.5, -1.0, 1.0)
        zero = np.zeros(count)
        theta = np.stack((np.stack((mirror * across, zero, left), -1), np.stack((zero, down, top), -1)), -2)
        matrix = torch.from_numpy(theta.astype(np.float32)).to(self._device)
        size = [count, 2, self._height_px, self._width_px]
        shown = round(rng.choice(self._shown) * self._height_px) // STRIDE * STRIDE
        grid = functional.affine_grid(matrix, size, align_corners=False)[:, self._height_px - shown :]
        out = functional.grid_sample(samples.float(), grid, "bilinear", "border", align_corners=False)
        grey, mask = out[:, :1], out[:, 1:]
        changed = torch.cat((self._toned(grey, rng), mask), dim=1)
        return (changed + 0.5).clamp_(0.0, 255.0).to(torch.uint8)

    def _toned(self, grey: Tensor, rng: np.random.Generator) -> Tensor:
        """Images (n, 1, h, w) with random gamma, gain, offset and noise."""
        count = len(grey)
        toned = rng.random(count) < 0.7
        gamma = np.where(toned, np.exp(rng.uniform(-0.5, 0.5, count)), 1.0)
        gain = np.where(toned, rng.uniform(0.6, 1.3, count), 1.0)
        offset = np.where(toned, rng.uniform(-25.0, 25.0, count), 0.0)
        sigma = np.where(rng.random(count) < 0.3, rng.uniform(0.0, NOISE, count), 0.0)
        seed = int(rng.integers(2**31))
        table = torch.from_numpy(np.stack((gamma, 255.0 * gain, offset, sigma)).astype(np.float32)).to(self._device)
        power, factor, shift, deviation = table.reshape(4, count, 1, 1, 1)
        generator = torch.Generator(self._device).manual_seed(seed)
        noise = torch.randn(grey.shape, generator=generator, device=self._device)
        return ((grey * (1.0 / 255.0)).pow(power) * factor + shift).clamp_(0.0, 255.0) + deviation * noise


def _parts(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The part of each sample that is shown: its width and height as shares, its centre's place (-1 .. 1)."""
    is_part = rng.random(count) < 0.5
    zoom = rng.uniform(1.0, ZOOM, count)
    stretch = np.exp(rng.uniform(-0.5, 0.5, count) * math.log(STRETCH))
    across = np.where(is_part, np.minimum(1.0 / (zoom * stretch), 1.0), 1.0)
    down = np.where(is_part, np.minimum(stretch / zoom, 1.0), 1.0)
    left, top = rng.uniform(-1.0, 1.0, (2, count)) * (1.0 - np.stack((across, down)))
    return across, down, left, top
