"""`automodel train`: draw samples, train the marking network on them, export it, and say how good it is."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

# Threads that wait for each other asleep: awake, they take the time of those that they wait for on a busy machine.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import click

from automodel.cli.options import ABOVE_ZERO, finite
from automodel.config.extras import need_extra
from automodel.config.toml_reader import ConfigError
from automodel.console.tables import show
from automodel.perception.markings.unet import BIRDSEYE, SIZES

MINUTES = 60.0


@click.command("train", short_help="Train the network that finds lane markings.")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=Path("trained"), show_default=True,
              help="Folder for the network, its metrics and its model card.")  # fmt: skip
@click.option("--data", type=click.Path(path_type=Path, file_okay=False), default=None,
              help="Folder for the drawn samples, 262 or (birdseye) 61 kB each, kept for next time."
              "  [default: OUT/data, or OUT/views]")  # fmt: skip
@click.option("--samples", type=click.IntRange(1, 10_000_000), default=12_000, show_default=True,
              help="Drawn samples to learn from.")  # fmt: skip
@click.option("--validation", type=click.IntRange(1, 100_000), default=256, show_default=True,
              help="Drawn samples to measure with, of other seeds.")  # fmt: skip
@click.option("--minutes", type=ABOVE_ZERO, callback=finite, default=None,
              help=f"Train for so long, once the samples are drawn.  [default: {MINUTES:.0f}]")  # fmt: skip
@click.option("--steps", type=click.IntRange(1), default=None, help="Train for so many batches instead.")
@click.option("--batch", type=click.IntRange(1, 4096), default=8, show_default=True,
              help="Samples a batch; a GPU likes more.")  # fmt: skip
@click.option("--rate", type=ABOVE_ZERO, callback=finite, default=3e-3, show_default=True,
              help="Of learning, at its peak; a larger batch allows a larger one.")  # fmt: skip
@click.option("--size", type=click.Choice(list(SIZES)), default=BIRDSEYE, show_default=True,
              help="The picture that the network sees, or the road from above.")  # fmt: skip
@click.option("--seed", type=click.IntRange(0, 2000), default=0, show_default=True, help="Of samples and training.")
@click.option("--resume", type=click.Path(path_type=Path), default=None,
              help="Start with the weights of this .pt file, of any size.")  # fmt: skip
@click.option("--continue", "proceed", is_flag=True, help="Go on with the training that was interrupted in OUT.")
@click.option("--workers", type=click.IntRange(1), default=None, help="Processes and threads.  [default: all cores]")
@click.option("--json", "as_json", is_flag=True, help="Results as JSON on stdout.")
def command(
    out: Path,
    data: Path | None,
    minutes: float | None,
    steps: int | None,
    workers: int | None,
    as_json: bool,
    **rest: Any,
) -> int:
    """Train the network that finds lane markings, from samples that are drawn for it.

    Ctrl-C ends the training early and keeps the best network so far; --continue with the same options goes on from its
    last measurement. Uses a GPU that torch can use; there, larger batches (--batch 64 --rate 0.005) are faster. Needs
    torch: pip install 'automodel[train]'.

    Example:

    automodel train --out trained --minutes 60
    """
    if minutes is not None and steps is not None:
        raise click.UsageError("give --minutes or --steps, not both")
    if rest["resume"] is not None and not rest["resume"].is_file():
        raise ConfigError(f"--resume {rest['resume']}: no such file")
    if rest["proceed"] and not (out / f"marking_{rest['size']}.state").is_file():
        raise ConfigError(f"--continue: {out} holds no interrupted training of {rest['size']}")
    need_extra("training", "torch", "onnx")
    from automodel.training.session import SessionConfig, run_session

    minutes = MINUTES if steps is None and minutes is None else minutes
    workers = workers or os.cpu_count() or 1
    data = data or out / ("views" if rest["size"] == BIRDSEYE else "data")
    config = SessionConfig(out=out, data=data, minutes=minutes, steps=steps, workers=workers, **rest)
    row, usable = run_session(config)
    show("train", [row], as_json)
    return 0 if usable else 1
