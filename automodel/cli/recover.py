"""`automodel recover`: make a cut recording readable."""

from __future__ import annotations

from pathlib import Path

import click

from automodel.cli.options import FILE
from automodel.console.messages import say
from automodel.recording.recover import recover


@click.command("recover")
@click.argument("recording", type=FILE)
@click.option("-o", "--output", type=FILE, help="The new file (default: NAME.recovered.mcap).")
@click.option("--force", is_flag=True, help="Write over a file that is there already.")
def command(recording: Path, output: Path | None, force: bool) -> int:
    """Save what is whole in a RECORDING that was cut (power loss, full disk) into a new file.

    Example:

    automodel recover cut.mcap
    """
    saved = recover(recording, output, force)
    say(f"{saved.path}: {saved.messages} messages, {saved.frames} frames, {saved.duration_s:.2f} s")
    return 0
