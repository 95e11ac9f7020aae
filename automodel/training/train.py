"""Training of the marking network. Needs torch and onnx (the extra `train`)."""

from __future__ import annotations

import concurrent.futures
import contextlib
import copy
import math
import zipfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from automodel.config.toml_reader import ConfigError, positive
from automodel.output_files import output_path
from automodel.perception.markings.unet import open_session, run_network
from automodel.training.metrics import Figures, measured
from automodel.training.shapes import UNKNOWN
from automodel.training.unet import MarkingNet, onnx_bytes
from automodel.types import Image

T = TypeVar("T")

FOCUS = (
    1.5  # the loss of a pixel is weighted with its error to this power: the many easy ones do not drown the few hard
)
EMA_DECAY = 0.998
WARM_UP = 0.03  # share of the training in which the rate rises
MOST_BAD = 10  # batches in a row without a finite gradient: short floating point overflows now and then
CHECKS = 10  # times the network is measured and, when better, kept


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig:
    """How to train: either for `steps` batches (the same result each time) or for `minutes`."""

    width_px: int = 512
    height_px: int = 256
    steps: int | None = None
    minutes: float | None = None
    rate: float = 3e-3  # of learning, at its peak
    weight_decay: float = 1e-2
    seed: int = 0
    threads: int = 2

    def __post_init__(self) -> None:
        if (self.steps is None) == (self.minutes is None):
            raise ValueError("steps: give either steps or minutes")
        positive(self, "steps" if self.minutes is None else "minutes", "rate", "threads")


@dataclass(frozen=True, slots=True, kw_only=True)
class Kept:
    """A network worth keeping: its weights, its ONNX file, how good it is, and after how many steps."""

    weights: dict[str, Tensor]
    onnx: bytes
    figures: Figures
    steps: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """Where the training is: `share` of it done, the mean loss lately, and how fast it goes."""

    share: float
    steps: int
    loss: float
    pictures_per_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Watcher:
    """Who is told: of progress (a hundred times), and of each network that is better than those before it."""

    progress: Callable[[Progress], None]
    better: Callable[[Kept], None]


class Training:
    """One training of `net`, which it changes. `clock_s` counts seconds; it decides only where minutes are given."""

    def __init__(self, config: TrainConfig, net: MarkingNet, clock_s: Callable[[], float]) -> None:
        torch.set_num_threads(config.threads)
        self.config, self._clock_s = config, clock_s
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self._net = net.to(self.device, memory_format=torch.channels_last)
        self._average = copy.deepcopy(self._net).eval()
        self._optimizer = torch.optim.AdamW(_groups(self._net, config.weight_decay), lr=config.rate)
        self._begin_s = clock_s()
        self._steps = self._bad = 0
        self.kept: Kept | None = None
        self.interrupted = False

    def run(self, batches: Iterable[Image], validation: Iterable[Image], watcher: Watcher) -> Kept:
        """Train to the end and give the best network; KeyboardInterrupt ends it early (`interrupted`).

        `batches` are (n, 2, h, w) uint8, grey and mask; `validation` pictures (2, h, w). Raises ValueError when the
        loss is no longer finite.
        """
        try:
            self._learn(batches, validation, watcher)
        except KeyboardInterrupt:
            self.interrupted = True
        self._check(validation, watcher)
        assert self.kept is not None
        return self.kept

    def _learn(self, batches: Iterable[Image], validation: Iterable[Image], watcher: Watcher) -> None:
        losses: list[float] = []
        pictures, told, checked = 0, 0.0, 0.0
        with _ahead(batches) as coming:
            for batch in coming:
                share = self._share_done()
                if share >= 1.0:
                    break
                lately = self.step(batch, share)
                losses += [lately] if math.isfinite(lately) else []
                pictures += len(batch)
                if share - told >= 0.01:
                    told = share
                    watcher.progress(self._progress(share, float(np.mean(losses or [math.nan])), pictures))
                    losses.clear()
                if share - checked >= 1.0 / CHECKS:
                    checked = share
                    self._check(validation, watcher)

    def step(self, batch: Image, share_done: float) -> float:
        """Learn from one batch (n, 2, h, w); gives its loss.

        A batch that gives no finite gradient is passed over; raises ValueError when there are `MOST_BAD` in a row.
        """
        for group in self._optimizer.param_groups:
            group["lr"] = self.config.rate * rate_factor(share_done)
        self._net.train()
        pictures = torch.from_numpy(batch).to(self.device, non_blocking=True)
        image, mask = pictures[:, :1], pictures[:, 1:]
        with torch.autocast(self.device.type, dtype=torch.bfloat16):
            logits = self._net(image)
        value = loss(logits.float(), mask.float() * (1.0 / 255.0))
        self._optimizer.zero_grad(set_to_none=True)
        value.backward()
        norm = nn.utils.clip_grad_norm_(self._net.parameters(), 2.0)
        self._steps += 1
        self._bad = 0 if math.isfinite(norm.item()) and math.isfinite(value.item()) else self._bad + 1
        if not self._bad:
            self._optimizer.step()
            _average_in(self._average, self._net, min(EMA_DECAY, (1.0 + self._steps) / (10.0 + self._steps)))
        elif self._bad > MOST_BAD:
            raise ValueError("the loss is no longer finite; begin with other weights or another seed")
        else:
            _restore_statistics(self._net, self._average)
        return float(value.item())

    def _check(self, validation: Iterable[Image], watcher: Watcher) -> None:
        """Measure the averaged network as it will run, and keep it when it is the best so far."""
        data = onnx_bytes(self._average, self.config.width_px, self.config.height_px, {})
        session = open_session(data, "cpu", self.config.threads)
        figures = measured(lambda grey: run_network(session, grey), validation)
        if self.kept is None or figures.score > self.kept.figures.score:
            weights = {name: value.detach().cpu().clone() for name, value in self._average.state_dict().items()}
            self.kept = Kept(weights=weights, onnx=data, figures=figures, steps=self._steps)
            watcher.better(self.kept)

    def _share_done(self) -> float:
        if self.config.steps is not None:
            return self._steps / self.config.steps
        return (self._clock_s() - self._begin_s) / (60.0 * (self.config.minutes or 1.0))

    def _progress(self, share: float, mean_loss: float, pictures: int) -> Progress:
        spent_s = max(self._clock_s() - self._begin_s, 1e-9)
        return Progress(share=share, steps=self._steps, loss=mean_loss, pictures_per_s=pictures / spent_s)


def loss(logits: Tensor, coverage: Tensor) -> Tensor:
    """How wrong logits (n, 1, h, w) are, given the share of each pixel that is marking (same shape).

    Cross-entropy weighted by the error (focal loss for soft labels: Li et al. 2020, eq. (4)), an amount per marked
    pixel, plus the soft Dice loss of the batch, which looks at the marks as a whole (Milletari et al. 2016).
    """
    known = (255.0 * coverage - UNKNOWN).abs() > 0.5  # a marking that nobody can see: either answer is right
    probability = torch.sigmoid(logits) * known
    entropy = known * functional.binary_cross_entropy_with_logits(logits, coverage, reduction="none")
    labelled = coverage.sum()
    focal = ((probability - coverage).abs().pow(FOCUS) * entropy).sum() / (labelled + 1e-3 * coverage.numel())
    overlap = 2.0 * (probability * coverage).sum() + 1.0
    return focal + 1.0 - overlap / (probability.square().sum() + coverage.square().sum() + 1.0)


def rate_factor(share_done: float) -> float:
    """The learning rate as a share of its peak: a straight rise, then half a cosine down to a hundredth."""
    if share_done < WARM_UP:
        return max(share_done / WARM_UP, 0.01)
    along = min((share_done - WARM_UP) / (1.0 - WARM_UP), 1.0)
    return 0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * along))


def save_weights(path: Path, kept: Kept) -> None:
    """Write a network's weights so that `load_weights` takes them."""
    with output_path(path) as part:
        torch.save({"weights": kept.weights, "steps": kept.steps, "figures": asdict(kept.figures)}, part)


def load_weights(path: Path, net: MarkingNet) -> None:
    """Put the weights of a file of `save_weights` into `net`; raises ConfigError when they do not fit."""
    if path.is_file() and not zipfile.is_zipfile(path):  # torch would take older forms too, with errors of all kinds
        raise ConfigError(f"{path}: is no file of this network's weights")
    try:
        found = torch.load(path, map_location="cpu", weights_only=True)  # False would run code from the file
        net.load_state_dict(found["weights"])
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except (OSError, RuntimeError, ValueError, LookupError, TypeError, AttributeError, UnpicklingError) as error:
        said = " ".join(str(error).split())[:120]
        raise ConfigError(f"{path}: is no file of this network's weights ({type(error).__name__}: {said})") from None


def _groups(net: nn.Module, weight_decay: float) -> list[dict[str, object]]:
    """Kernels decay, biases and the scales of the normalisation do not."""
    kernels = [p for p in net.parameters() if p.ndim > 1]
    others = [p for p in net.parameters() if p.ndim <= 1]
    return [{"params": kernels, "weight_decay": weight_decay}, {"params": others, "weight_decay": 0.0}]


def _average_in(average: nn.Module, net: nn.Module, decay: float) -> None:
    """Move the averaged network towards `net`: average <- decay average + (1 - decay) net, statistics included."""
    with torch.no_grad():
        for old, new in zip(average.state_dict().values(), net.state_dict().values(), strict=True):
            if old.is_floating_point():
                old.lerp_(new, 1.0 - decay)
            else:
                old.copy_(new)


def _restore_statistics(net: nn.Module, average: nn.Module) -> None:
    """Give the normalisation its statistics back that a bad batch has spoilt."""
    with torch.no_grad():
        for own, good in zip(net.buffers(), average.buffers(), strict=True):
            own.copy_(good)


@contextlib.contextmanager
def _ahead(items: Iterable[T]) -> Iterator[Iterator[T]]:
    """The items, each made by another thread while the one before it is in use."""
    with concurrent.futures.ThreadPoolExecutor(1) as pool:

        def coming() -> Iterator[T]:
            source = iter(items)
            made = pool.submit(next, source, None)
            while (item := made.result()) is not None:
                made = pool.submit(next, source, None)
                yield item

        yield coming()
