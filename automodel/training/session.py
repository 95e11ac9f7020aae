"""One training from start to end: draw pictures, train, write network, metrics and model card, and check the network.

Needs torch and onnx (the extra `train`).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from automodel.config.toml_reader import ConfigError
from automodel.console.messages import say
from automodel.console.workers import spread
from automodel.output_files import output_path
from automodel.perception.markings.unet import SIZES, MarkingNetwork, UnetConfig
from automodel.training import dataset, train
from automodel.training.metrics import Origin, write_card, write_figures
from automodel.training.unet import MarkingNet, with_metadata


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionConfig:
    """What to train, from how many pictures, for how long (`minutes` or `steps`), and the folders of data and results.

    `resume` is a file of weights to start with, `workers` the number of processes and threads.
    """

    out: Path
    data: Path
    samples: int
    validation: int
    minutes: float | None
    steps: int | None
    size: str
    seed: int
    resume: Path | None
    workers: int
    batch: int


def run_session(config: SessionConfig) -> tuple[dict[str, object], bool]:
    """Train; gives size, steps and metrics of the best network, and whether a car can use it.

    It cannot where the training was interrupted, or the network fails its self-test. Raises ConfigError.
    """
    width, height = SIZES[config.size]
    training_config = train.TrainConfig(
        width_px=width,
        height_px=height,
        steps=config.steps,
        minutes=config.minutes,
        seed=config.seed,
        threads=config.workers,
    )
    config.out.mkdir(parents=True, exist_ok=True)
    learn, measure, version = _pictures(config)
    torch.manual_seed(config.seed)
    net = MarkingNet()
    if config.resume is not None:
        train.load_weights(config.resume, net)
    training = train.Training(training_config, net, time.monotonic)
    say(f"training on {training.device} with {config.workers} threads")
    batches = dataset.Batches(learn, width, height, config.batch, config.seed)
    truth = [dataset.resized(measure[at], width, height) for at in range(len(measure))]

    def write(kept: train.Kept) -> None:
        parameters = sum(weights.numel() for weights in net.parameters())
        _write(config, kept, _origin(config, kept, version, parameters))

    kept = training.run(batches, truth, train.Watcher(progress=_say_progress, better=write))
    row = {"size": config.size, "steps": kept.steps, **asdict(kept.figures)}
    if training.interrupted:
        say(f"automodel train: interrupted; the best network so far is in {config.out}")
        return row, False
    return row, passes_self_test(config)


def _pictures(config: SessionConfig) -> tuple[dataset.Pictures, dataset.Pictures, str]:
    """(to learn from, to measure with, data version); draws those that are not in the folder yet."""
    version = dataset.data_version()
    dataset.claim_folder(config.data, version)
    measure = dataset.shards(config.data, 0, config.validation)
    learn = dataset.shards(config.data, dataset.FIRST_TRAINING_SEED * (config.seed + 1), config.samples)
    wanted = dataset.missing(measure + learn)
    if wanted:
        say(f"drawing {sum(shard.count for shard in wanted)} pictures into {config.data}")
    for _ in spread("drawing", _draw, wanted, config.workers):
        pass
    return dataset.Pictures(learn), dataset.Pictures(measure), version


def _draw(shard: dataset.Shard, tick: Callable[[float], None]) -> None:
    dataset.write_shard(shard, tick=tick)


def _write(config: SessionConfig, kept: train.Kept, origin: Origin) -> None:
    """Put a network into the folder, with its weights, metrics and card."""
    file = config.out / f"marking_{config.size}"
    with output_path(file.with_suffix(".onnx")) as part:
        part.write_bytes(with_metadata(kept.onnx, asdict(origin)))
    train.save_weights(file.with_suffix(".pt"), kept)
    write_figures(file.with_suffix(".json"), origin, kept.figures)
    write_card(config.out)
    found = ", ".join(f"{key} {value:.3f}" for key, value in asdict(kept.figures).items())
    say(f"step {kept.steps}: {found}; written to {file}.onnx")


def _origin(config: SessionConfig, kept: train.Kept, version: str, parameters: int) -> Origin:
    length = f"--steps {config.steps}" if config.minutes is None else f"--minutes {config.minutes:g}"
    resume = " --resume FILE.pt" if config.resume is not None else ""
    command = f"automodel train --size {config.size} --samples {config.samples} {length} --seed {config.seed}{resume}"
    return Origin(
        size=config.size,
        seed=config.seed,
        steps=kept.steps,
        batch=config.batch,
        samples=config.samples,
        validation=config.validation,
        data_version=version,
        parameters=parameters,
        resumed=config.resume is not None,
        command=command,
    )


def passes_self_test(config: SessionConfig) -> bool:
    """Load the network as a car does; says why where it fails its self-test."""
    try:
        MarkingNetwork(UnetConfig(model=str(config.out / f"marking_{config.size}.onnx"), size=config.size))
    except ConfigError as error:
        say(f"automodel train: {error}; train longer")
        return False
    return True


def _say_progress(progress: train.Progress) -> None:
    say(
        f"{progress.share:4.0%}  step {progress.steps}  loss {progress.loss:.4f}"
        f"  {progress.pictures_per_s:.1f} pictures/s"
    )
