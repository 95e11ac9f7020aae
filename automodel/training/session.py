"""One training from start to end: draw samples, train, write network, metrics and model card, and check the network.

Needs torch and onnx (the extra `train`).
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import torch

from automodel.config.toml_reader import ConfigError
from automodel.console.messages import say
from automodel.console.workers import Sweep, complete
from automodel.output_files import output_path, output_text
from automodel.perception.markings.unet import BIRDSEYE, SIZES, MarkingNetwork, UnetConfig
from automodel.training import dataset, train
from automodel.training.batches import SHOWN, Batches
from automodel.training.metrics import NEAR_PX, Metrics
from automodel.training.scenes import make_sample
from automodel.training.unet import MarkingNet, with_metadata
from automodel.training.views import make_view
from automodel.viewer.plots import plotted

HEADER = f"""\
# The marking networks

They find lane markings in grey images. Input `image`, uint8 (1, 1, rows, width); output `marking`, uint8 of the
same shape: the probability of "lane marking" of each pixel times 255. The number of rows is open (a multiple of 8).
"birdseye" sees the road from above, as wide and deep as the bird's-eye view of the pipeline; the others see the rows of
the picture that show the road, of a picture stretched to their size.

- **Made by** `automodel train`: a U-Net of two levels on the image packed to half size
  (`automodel/training/unet.py`), after P. Cudrano et al. 2020.
- **Data**: drawn images only, none of them real (`automodel/training/scenes.py`, from above `views.py`).
- **For** lane markings on the ground, seen by a car's camera that looks ahead. Not for anything else.

Precision, recall and IoU count pixels of held-out drawn images, at a probability of one half. The "near" metrics
allow {NEAR_PX} px between a mark and a label.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Origin:
    """The origin of a network; also stored in its ONNX file."""

    size: str
    seed: int
    steps: int
    batch: int
    samples: int
    validation: int
    data_version: str
    parameters: int
    rate: float
    resumed: bool
    device: str
    command: str


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionConfig:
    """What to train, from how many samples, for how long (`minutes` or `steps`), and the folders of data and results.

    `resume` is a file of weights to start with, `proceed` goes on with the training that was interrupted in `out`,
    `workers` is the number of processes and threads.
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
    rate: float
    proceed: bool = False

    @property
    def length(self) -> str:
        """The length of the training, as an option of the command."""
        return f"--steps {self.steps}" if self.minutes is None else f"--minutes {self.minutes:g}"


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
        rate=config.rate,
        seed=config.seed,
        threads=config.workers,
    )
    config.out.mkdir(parents=True, exist_ok=True)
    learn, measure, version = _samples(config)
    torch.manual_seed(config.seed)
    net = MarkingNet()
    if config.resume is not None:
        train.load_weights(config.resume, net)
    training = train.Training(training_config, net, time.monotonic)
    file = config.out / f"marking_{config.size}"
    if config.proceed:
        training.restore(file.with_suffix(".state"))
        say(f"going on from step {training.steps}")
    device = _device_name(training.device)
    say(f"training on {device} with {config.workers} threads")
    shown = (1.0,) if config.size == BIRDSEYE else SHOWN
    batches = Batches(learn, width, height, config.batch, config.seed, training.device.type, shown)
    batches.start = training.steps
    truth = [dataset.resized(measure[at], width, height) for at in range(len(measure))]

    def write(kept: train.Kept) -> None:
        parameters = sum(weights.numel() for weights in net.parameters())
        _write(config, kept, _origin(config, kept, version, parameters, device))

    def checked() -> None:
        training.save(file.with_suffix(".state"))
        plot_curve(config.out / f"{file.name}_curve.png", training)

    kept = training.run(batches, truth, train.Watcher(progress=_say_progress, better=write, checked=checked))
    row = {"size": config.size, "steps": kept.steps, **asdict(kept.metrics)}
    if training.interrupted:
        say(f"automodel train: interrupted; the best network so far is in {config.out}, --continue goes on")
        return row, False
    return row, passes_self_test(config)


def _samples(config: SessionConfig) -> tuple[dataset.Samples, dataset.Samples, str]:
    """(to learn from, to measure with, data version); draws those that are not in the folder yet."""
    version = dataset.data_version(_maker(config.size))
    dataset.claim_folder(config.data, version)
    size = SIZES[BIRDSEYE] if config.size == BIRDSEYE else (dataset.WIDTH_PX, dataset.HEIGHT_PX)
    measure = dataset.shards(config.data, 0, config.validation, *size)
    learn = dataset.shards(config.data, dataset.FIRST_TRAINING_SEED * (config.seed + 1), config.samples, *size)
    missing = dataset.missing(measure + learn)
    if missing:
        say(f"drawing {sum(shard.count for shard in missing)} samples into {config.data}")
    complete("drawing", partial(_draw, config.size), missing, Sweep(jobs=config.workers))
    return dataset.Samples(learn), dataset.Samples(measure), version


def _maker(size: str) -> dataset.Maker:
    """What draws the samples for a network of that size."""
    return make_view if size == BIRDSEYE else make_sample


def _draw(size: str, shard: dataset.Shard, tick: Callable[[float], None]) -> None:
    dataset.write_shard(shard, _maker(size), tick)


def _write(config: SessionConfig, kept: train.Kept, origin: Origin) -> None:
    """Put a network into the folder, with its weights, metrics and card."""
    file = config.out / f"marking_{config.size}"
    with output_path(file.with_suffix(".onnx")) as part:
        part.write_bytes(with_metadata(kept.onnx, asdict(origin)))
    train.save_weights(file.with_suffix(".pt"), kept)
    write_metrics(file.with_suffix(".json"), origin, kept.metrics)
    write_card(config.out)
    found = ", ".join(f"{key} {value:.3f}" for key, value in asdict(kept.metrics).items())
    say(f"step {kept.steps}: {found}; written to {file}.onnx")


def _device_name(device: torch.device) -> str:
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"


def plot_curve(path: Path, training: train.Training) -> None:
    """Draw a training's loss, and its metrics on the samples to measure with, over the steps."""
    with plotted(path, (9, 6)) as figure:
        above, below = figure.subplots(2, 1, sharex=True)
        if training.losses:
            above.plot(*zip(*training.losses, strict=True), color="tab:blue")
        above.set_ylabel("mean loss")
        steps = [at for at, _ in training.checks]
        for name in ("near_precision", "near_recall", "score"):
            below.plot(steps, [getattr(m, name) for _, m in training.checks], marker=".", label=name.replace("_", " "))
        below.set_xlabel("steps")
        below.legend(loc="lower right")
        for axis in (above, below):
            axis.grid(alpha=0.3)


def _origin(config: SessionConfig, kept: train.Kept, version: str, parameters: int, device: str) -> Origin:
    options = f"--size {config.size} --samples {config.samples} {config.length} --batch {config.batch}"
    resume = " --resume FILE.pt" if config.resume is not None else ""
    command = f"automodel train {options} --rate {config.rate:g} --seed {config.seed}{resume}"
    return Origin(
        size=config.size,
        seed=config.seed,
        steps=kept.steps,
        batch=config.batch,
        samples=config.samples,
        validation=config.validation,
        data_version=version,
        parameters=parameters,
        rate=config.rate,
        resumed=config.resume is not None,
        device=device,
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
        f"  {progress.samples_per_s:.1f} samples/s"
    )


def write_metrics(path: Path, origin: Origin, metrics: Metrics) -> None:
    """Write the file that `write_card` reads, beside the network's ONNX file."""
    text = json.dumps({"origin": asdict(origin), "figures": asdict(metrics)}, indent=1)
    with output_text(path) as file:
        file.write(text + "\n")


def write_card(folder: Path) -> None:
    """MODEL_CARD.md of all the networks in a folder, from the files of `write_metrics` there."""
    parts = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("marking_*.json"))]
    with output_text(folder / "MODEL_CARD.md") as file:
        file.write("\n".join([HEADER, *map(_section, parts)]))


def _section(part: Mapping[str, Mapping[str, object]]) -> str:
    origin, metrics = part["origin"], part["figures"]
    rows = [(key.replace("_", " "), str(value)) for key, value in origin.items() if key not in ("size", "command")]
    rows += [(key.replace("_", " "), f"{value:.3f}") for key, value in metrics.items()]
    lines = [f"## marking_{origin['size']}.onnx", "", f"`{origin['command']}`", "", "| | |", "|---|---|"]
    return "\n".join([*lines, *(f"| {name} | {value} |" for name, value in rows), ""])
