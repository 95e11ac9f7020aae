"""`automodel train`: draw pictures, train the marking network on them, export it, and say how good it is."""

from __future__ import annotations

import importlib.util
import os
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

# Threads that wait for each other asleep: awake, they take the time of those that they wait for on a busy machine.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import click

from automodel.cli.options import ABOVE_ZERO, finite
from automodel.config.toml_reader import ConfigError
from automodel.console.messages import say
from automodel.console.progress import progress
from automodel.console.tables import show
from automodel.console.workers import spread
from automodel.output_files import output_path
from automodel.perception.markings.unet import SIZES, MarkingNetwork, UnetConfig

if TYPE_CHECKING:
    from automodel.training.dataset import Pictures
    from automodel.training.metrics import Origin
    from automodel.training.train import Kept, Progress, TrainConfig

BATCH = 8
MINUTES = 60.0


@click.command("train", short_help="Train the network that finds lane markings.")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=Path("trained"), show_default=True,
              help="Folder for the network, its figures and its model card.")  # fmt: skip
@click.option("--data", type=click.Path(path_type=Path, file_okay=False), default=None,
              help="Folder for the drawn pictures, 262 kB each, kept for next time.  [default: OUT/data]")  # fmt: skip
@click.option("--samples", type=click.IntRange(1, 10_000_000), default=12_000, show_default=True,
              help="Drawn pictures to learn from.")  # fmt: skip
@click.option("--validation", type=click.IntRange(1, 100_000), default=256, show_default=True,
              help="Drawn pictures to measure with, of other seeds.")  # fmt: skip
@click.option("--minutes", type=ABOVE_ZERO, callback=finite, default=None,
              help=f"Train for so long, after the pictures are drawn.  [default: {MINUTES:.0f}]")  # fmt: skip
@click.option("--steps", type=click.IntRange(1), default=None, help=f"Train for so many batches of {BATCH} instead.")
@click.option("--size", type=click.Choice(list(SIZES)), default="512x256", show_default=True,
              help="The network's picture.")  # fmt: skip
@click.option("--seed", type=click.IntRange(0, 2000), default=0, show_default=True, help="Of pictures and training.")
@click.option("--resume", type=click.Path(path_type=Path), default=None,
              help="Begin with the weights of this .pt file, of either size.")  # fmt: skip
@click.option("--workers", type=click.IntRange(1), default=None, help="Processes and threads.  [default: all cores]")
@click.option("--json", "as_json", is_flag=True, help="Print the figures as JSON.")
def command(
    out: Path,
    data: Path | None,
    samples: int,
    validation: int,
    minutes: float | None,
    steps: int | None,
    size: str,
    seed: int,
    resume: Path | None,
    workers: int | None,
    as_json: bool,
) -> int:
    """Train the network that finds lane markings, from pictures that are drawn for it.

    Ctrl-C ends the training early and keeps the best network so far. Needs torch: pip install 'automodel[train]'.
    """
    if minutes is not None and steps is not None:
        raise click.UsageError("give --minutes or --steps, not both")
    if resume is not None and not resume.is_file():
        raise ConfigError(f"--resume {resume}: no such file")
    _demand_torch()
    from automodel.training.train import TrainConfig

    workers = workers or os.cpu_count() or 1
    width, height = SIZES[size]
    if steps is None and minutes is None:
        minutes = MINUTES
    config = TrainConfig(width_px=width, height_px=height, steps=steps, minutes=minutes, seed=seed, threads=workers)
    out.mkdir(parents=True, exist_ok=True)
    learn, measure, version = _pictures(data or out / "data", samples, validation, seed, workers)
    run = _Run(config, size, out, resume, version)
    return run.train(learn, measure, as_json)


def _demand_torch() -> None:
    """Raises ConfigError where the extra is not installed."""
    for name in ("torch", "onnx"):
        if importlib.util.find_spec(name) is None:
            raise ConfigError(f"training needs {name}, which is not installed: pip install 'automodel[train]'")


def _pictures(folder: Path, samples: int, validation: int, seed: int, workers: int) -> tuple[Pictures, Pictures, str]:
    """(to learn from, to measure with, data version); draws those that are not in the folder yet."""
    from automodel.training import dataset

    version = dataset.data_version()
    dataset.claim_folder(folder, version)
    measure = dataset.shards(folder, 0, validation)
    learn = dataset.shards(folder, dataset.FIRST_TRAINING_SEED * (seed + 1), samples)
    wanted = dataset.missing(measure + learn)
    if wanted:
        say(f"drawing {sum(shard.count for shard in wanted)} pictures into {folder}")
    with progress("drawing", len(wanted)) as bar:
        for _ in spread(dataset.write_shard, wanted, min(workers, max(len(wanted), 1))):
            bar()
    return dataset.Pictures(learn), dataset.Pictures(measure), version


class _Run:
    """One training: tells how it goes, writes what is better, prints the figures."""

    def __init__(self, config: TrainConfig, size: str, out: Path, resume: Path | None, version: str) -> None:
        self._config, self._size, self._out, self._resume, self._version = config, size, out, resume, version
        self._samples = self._validation = self._parameters = 0

    def train(self, learn: Pictures, measure: Pictures, as_json: bool) -> int:
        """The exit code."""
        import torch

        from automodel.training import dataset, train
        from automodel.training.unet import MarkingNet

        config = self._config
        torch.manual_seed(config.seed)
        net = MarkingNet()
        if self._resume is not None:
            train.load_weights(self._resume, net)
        self._samples, self._validation = len(learn), len(measure)
        self._parameters = sum(weights.numel() for weights in net.parameters())
        training = train.Training(config, net, time.monotonic)
        say(f"training on {training.device} with {config.threads} threads")
        batches = dataset.Batches(learn, config.width_px, config.height_px, BATCH, config.seed)
        truth = [dataset.resized(measure[at], config.width_px, config.height_px) for at in range(len(measure))]
        kept = training.run(batches, truth, train.Watcher(progress=_tell, better=self._write))
        show("train", [{"size": self._size, "steps": kept.steps, **asdict(kept.figures)}], as_json)
        if training.interrupted:
            say(f"automodel train: interrupted; the best network so far is in {self._out}")
            return 1
        return self._check()

    def _write(self, kept: Kept) -> None:
        """Put a network into the folder, with its weights, figures and card."""
        from automodel.training.metrics import write_card, write_figures
        from automodel.training.train import save_weights
        from automodel.training.unet import with_metadata

        origin = self._origin(kept)
        name = f"marking_{self._size}"
        onnx = with_metadata(kept.onnx, asdict(origin))
        with output_path(self._out / f"{name}.onnx") as part:
            part.write_bytes(onnx)
        save_weights(self._out / f"{name}.pt", kept)
        write_figures(self._out / f"{name}.json", origin, kept.figures)
        write_card(self._out)
        found = ", ".join(f"{key} {value:.3f}" for key, value in asdict(kept.figures).items())
        say(f"step {kept.steps}: {found}; written to {self._out / name}.onnx")

    def _origin(self, kept: Kept) -> Origin:
        from automodel.training.metrics import Origin

        config = self._config
        length = f"--steps {config.steps}" if config.minutes is None else f"--minutes {config.minutes:g}"
        resume = " --resume FILE.pt" if self._resume is not None else ""
        return Origin(
            size=self._size,
            seed=config.seed,
            steps=kept.steps,
            batch=BATCH,
            samples=self._samples,
            validation=self._validation,
            data_version=self._version,
            parameters=self._parameters,
            resumed=self._resume is not None,
            command=f"automodel train --size {self._size} --samples {self._samples} {length}"
            f" --seed {config.seed}{resume}",
        )

    def _check(self) -> int:
        """Load the network as a car would; one that fails its self-test there is no success."""
        try:
            MarkingNetwork(UnetConfig(model=str(self._out / f"marking_{self._size}.onnx"), size=self._size))
        except ConfigError as error:
            say(f"automodel train: {error}; train longer")
            return 1
        return 0


def _tell(progress: Progress) -> None:
    say(
        f"{progress.share:4.0%}  step {progress.steps}  loss {progress.loss:.4f}"
        f"  {progress.pictures_per_s:.1f} pictures/s"
    )
