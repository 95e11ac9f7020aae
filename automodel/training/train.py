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
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from automodel.config.toml_reader import ConfigError, positive
from automodel.output_files import output_path
from automodel.perception.markings.unet import open_session, run_network
from automodel.training.metrics import Metrics, measured
from automodel.training.shapes import UNKNOWN
from automodel.training.unet import MarkingNet, onnx_bytes
from automodel.types import Image

T = TypeVar("T")

FOCUS = 1.5  # exponent of the error that weights a pixel's loss, so that the many easy pixels do not dominate
EMA_DECAY = 0.998
WARM_UP = 0.03  # share of the training in which the rate rises
MAX_BAD = 10  # batches in a row without a finite gradient: bfloat16 overflows now and then
CHECKS = 10  # how often the network is measured and, if better, kept


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig:
    """How to train: for `steps` batches (reproducible) or for `minutes`."""

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
    """The best network so far: its weights, ONNX file and metrics, and the number of steps."""

    weights: dict[str, Tensor]
    onnx: bytes
    metrics: Metrics
    steps: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """The progress of a training: the share that is done, the recent mean loss, and the speed."""

    share: float
    steps: int
    loss: float
    samples_per_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Watcher:
    """Callbacks for progress (a hundred times), for each measurement, and for each network that is the best so far."""

    progress: Callable[[Progress], None]
    better: Callable[[Kept], None]
    checked: Callable[[], None] = lambda: None


class Training:
    """One training of `net`, in place; `clock_s` counts seconds."""

    def __init__(self, config: TrainConfig, net: MarkingNet, clock_s: Callable[[], float]) -> None:
        torch.set_num_threads(config.threads)
        self.config, self._clock_s = config, clock_s
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        on_gpu = self.device.type == "cuda"
        torch.backends.cudnn.benchmark = on_gpu
        self._net = net.to(self.device, memory_format=torch.channels_last)
        self._average = copy.deepcopy(self._net).eval()
        groups = _groups(self._net, config.weight_decay)
        self._optimizer = torch.optim.AdamW(groups, lr=config.rate, fused=on_gpu)
        self._start_s, self._before_s = clock_s(), 0.0
        self.steps = self._bad = 0
        self.kept: Kept | None = None
        self.losses: list[tuple[int, float]] = []  # steps, mean loss since the last entry
        self.checks: list[tuple[int, Metrics]] = []
        self.interrupted = False

    def save(self, path: Path) -> None:
        """Write all that `restore` needs to go on from here."""
        state = {
            "net": self._net.state_dict(),
            "average": self._average.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "steps": self.steps,
            "spent_s": self._clock_s() - self._start_s,
            "losses": self.losses,
            "checks": [(steps, asdict(metrics)) for steps, metrics in self.checks],
            "kept": None if self.kept is None else _kept_state(self.kept),
        }
        with output_path(path) as part:
            torch.save(state, part)

    def restore(self, path: Path) -> None:
        """Go on from a file of `save`; raises ConfigError if it is not of such a training."""
        state = _loaded(path, "a file of an interrupted training")
        try:
            self._net.load_state_dict(state["net"])
            self._average.load_state_dict(state["average"])
            self._optimizer.load_state_dict(state["optimizer"])
            self.steps, self._before_s = int(state["steps"]), float(state["spent_s"])
            self._start_s = self._clock_s() - self._before_s
            self.losses = [(int(steps), float(mean)) for steps, mean in state["losses"]]
            self.checks = [(int(steps), Metrics(**metrics)) for steps, metrics in state["checks"]]
            kept = state["kept"]
            self.kept = None if kept is None else Kept(**{**kept, "metrics": Metrics(**kept["metrics"])})
        except _NOT_OURS as error:
            raise _unreadable(path, "a file of an interrupted training", error) from None

    def run(self, batches: Iterable[Tensor], validation: Iterable[Image], watcher: Watcher) -> Kept:
        """Train and give the best network; KeyboardInterrupt ends the training early (`interrupted`).

        `batches` are (n, 2, h, w) uint8, grey and mask; `validation` samples are (2, h, w). Raises ValueError if the
        loss is no longer finite.
        """
        try:
            self._learn(batches, validation, watcher)
        except KeyboardInterrupt:
            self.interrupted = True
        self._check(validation, watcher)
        assert self.kept is not None
        return self.kept

    def _learn(self, batches: Iterable[Tensor], validation: Iterable[Image], watcher: Watcher) -> None:
        losses: list[float] = []
        count, reported = 0, self._share_done() if self.steps else 0.0
        checked = reported
        with _ahead(batches) as coming:
            for batch in coming:
                share = self._share_done()
                if share >= 1.0:
                    break
                lately = self.step(batch, share)
                losses += [lately] if math.isfinite(lately) else []
                count += len(batch)
                if share - reported >= 0.01:
                    reported = share
                    mean = float(np.mean(losses or [math.nan]))
                    self.losses.append((self.steps, mean))
                    watcher.progress(self._progress(share, mean, count))
                    losses.clear()
                if share - checked >= 1.0 / CHECKS:
                    checked = share
                    self._check(validation, watcher)

    def step(self, batch: Tensor, share_done: float) -> float:
        """Learn from one batch (n, 2, h, w); gives its loss.

        A batch without a finite gradient is skipped; raises ValueError after `MAX_BAD` in a row.
        """
        for group in self._optimizer.param_groups:
            group["lr"] = self.config.rate * rate_factor(share_done)
        self._net.train()
        samples = batch.to(self.device, non_blocking=True)
        image, mask = samples[:, :1], samples[:, 1:]
        with torch.autocast(self.device.type, dtype=torch.bfloat16):
            logits = self._net(image)
        value = loss(logits.float(), mask.float() * (1.0 / 255.0))
        self._optimizer.zero_grad(set_to_none=True)
        value.backward()
        norm = nn.utils.clip_grad_norm_(self._net.parameters(), 2.0)
        self.steps += 1
        self._bad = 0 if math.isfinite(norm.item()) and math.isfinite(value.item()) else self._bad + 1
        if not self._bad:
            self._optimizer.step()
            _average_in(self._average, self._net, min(EMA_DECAY, (1.0 + self.steps) / (10.0 + self.steps)))
        elif self._bad > MAX_BAD:
            raise ValueError("the loss is no longer finite; start with other weights or another seed")
        else:
            _restore_statistics(self._net, self._average)
        return float(value.item())

    def _check(self, validation: Iterable[Image], watcher: Watcher) -> None:
        """Measure the averaged network as ONNX, and keep it if it is the best so far."""
        data = onnx_bytes(self._average, self.config.width_px, self.config.height_px, {})
        session = open_session(data, "cpu", self.config.threads)
        metrics = measured(lambda grey: run_network(session, grey), validation)
        self.checks.append((self.steps, metrics))
        if self.kept is None or metrics.score > self.kept.metrics.score:
            weights = {name: value.detach().cpu().clone() for name, value in self._average.state_dict().items()}
            self.kept = Kept(weights=weights, onnx=data, metrics=metrics, steps=self.steps)
            watcher.better(self.kept)
        watcher.checked()

    def _share_done(self) -> float:
        if self.config.steps is not None:
            return self.steps / self.config.steps
        return (self._clock_s() - self._start_s) / (60.0 * (self.config.minutes or 1.0))

    def _progress(self, share: float, mean_loss: float, samples: int) -> Progress:
        spent_s = max(self._clock_s() - self._start_s - self._before_s, 1e-9)
        return Progress(share=share, steps=self.steps, loss=mean_loss, samples_per_s=samples / spent_s)


def loss(logits: Tensor, coverage: Tensor) -> Tensor:
    """The loss of logits (n, 1, h, w), given the share of each pixel that is marking (same shape).

    Cross-entropy weighted by the error (focal loss for soft labels: Li et al. 2020, eq. (4)) per marked pixel, plus the
    soft Dice loss of the batch (Milletari et al. 2016).
    """
    known = (255.0 * coverage - UNKNOWN).abs() > 0.5  # both answers are right for an invisible marking
    probability = torch.sigmoid(logits) * known
    entropy = known * functional.binary_cross_entropy_with_logits(logits, coverage, reduction="none")
    labelled = coverage.sum()
    focal = ((probability - coverage).abs().pow(FOCUS) * entropy).sum() / (labelled + 1e-3 * coverage.numel())
    overlap = 2.0 * (probability * coverage).sum() + 1.0
    return focal + 1.0 - overlap / (probability.square().sum() + coverage.square().sum() + 1.0)


def rate_factor(share_done: float) -> float:
    """The learning rate as a share of its peak: a linear rise, then half a cosine down to 0.01."""
    if share_done < WARM_UP:
        return max(share_done / WARM_UP, 0.01)
    along = min((share_done - WARM_UP) / (1.0 - WARM_UP), 1.0)
    return 0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * along))


def save_weights(path: Path, kept: Kept) -> None:
    """Write a network's weights for `load_weights`."""
    with output_path(path) as part:
        torch.save({"weights": kept.weights, "steps": kept.steps, "figures": asdict(kept.metrics)}, part)


def load_weights(path: Path, net: MarkingNet) -> None:
    """Load weights from a file of `save_weights` into `net`; raises ConfigError if they do not fit."""
    what = "a file of this network's weights"
    found = _loaded(path, what)
    try:
        net.load_state_dict(found["weights"])
    except _NOT_OURS as error:
        raise _unreadable(path, what, error) from None


_NOT_OURS = (OSError, RuntimeError, ValueError, LookupError, TypeError, AttributeError, UnpicklingError)


def _loaded(path: Path, what: str) -> Any:
    """What torch saved in a file; raises ConfigError."""
    if path.is_file() and not zipfile.is_zipfile(path):  # torch also reads older formats, with errors of all kinds
        raise ConfigError(f"{path}: is not {what}")
    try:
        return torch.load(path, map_location="cpu", weights_only=True)  # False could run code from the file
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except _NOT_OURS as error:
        raise _unreadable(path, what, error) from None


def _unreadable(path: Path, what: str, error: Exception) -> ConfigError:
    text = " ".join(str(error).split())[:120]
    return ConfigError(f"{path}: is not {what} ({type(error).__name__}: {text})")


def _kept_state(kept: Kept) -> dict[str, Any]:
    return {"weights": kept.weights, "onnx": kept.onnx, "metrics": asdict(kept.metrics), "steps": kept.steps}


def _groups(net: nn.Module, weight_decay: float) -> list[dict[str, object]]:
    """Parameter groups: kernels with weight decay, biases and normalisation scales without."""
    kernels = [p for p in net.parameters() if p.ndim > 1]
    others = [p for p in net.parameters() if p.ndim <= 1]
    return [{"params": kernels, "weight_decay": weight_decay}, {"params": others, "weight_decay": 0.0}]


def _average_in(average: nn.Module, net: nn.Module, decay: float) -> None:
    """Move the averaged network towards `net`: average <- decay average + (1 - decay) net, statistics included."""
    with torch.no_grad():
        both = list(zip(average.state_dict().values(), net.state_dict().values(), strict=True))
        smooth = [pair for pair in both if pair[0].is_floating_point()]
        torch._foreach_lerp_([old for old, _ in smooth], [new for _, new in smooth], 1.0 - decay)
        for old, new in both:
            if not old.is_floating_point():
                old.copy_(new)


def _restore_statistics(net: nn.Module, average: nn.Module) -> None:
    """Restore the statistics of the normalisation after a bad batch."""
    with torch.no_grad():
        for own, good in zip(net.buffers(), average.buffers(), strict=True):
            own.copy_(good)


@contextlib.contextmanager
def _ahead(items: Iterable[T]) -> Iterator[Iterator[T]]:
    """The items, each prepared in a thread while the previous one is in use."""
    with concurrent.futures.ThreadPoolExecutor(1) as pool:

        def coming() -> Iterator[T]:
            source = iter(items)
            made = pool.submit(next, source, None)
            while (item := made.result()) is not None:
                made = pool.submit(next, source, None)
                yield item

        yield coming()
