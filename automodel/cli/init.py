"""`automodel init`: a commented car.toml to begin with."""

from __future__ import annotations

import contextlib
import importlib.resources
import os
import shutil
from pathlib import Path

import click

from automodel.cli.options import FILE
from automodel.config import ConfigError
from automodel.console.messages import say

KITS = {  # each in automodel/cli/kits/<name>.toml
    "nano-arduino": "Jetson Nano, CSI camera, Arduino Nano: cars in the manner of the AutoModelCar.",
    "jetracer": "JetRacer: its Jetson and camera; its servo driver makes way for an Arduino Nano.",
    "sim": "The simulated car, no hardware at all.",
}
_NEXT = "next: measure what is marked +, then: automodel doctor --car"


@click.command("init")
@click.argument("kit", required=False)
@click.option("--out", type=FILE, default=Path("car.toml"), show_default=True, help="The file to write.")
@click.option("--list", "listing", is_flag=True, help="Name the kits and write nothing.")
@click.option("--force", is_flag=True, help="Write over a file that is there; it is kept beside it as NAME.bak.")
def command(kit: str | None, out: Path, listing: bool, force: bool) -> int:
    """Write a commented car.toml for KIT (see --list)."""
    if listing:
        width = max(map(len, KITS))
        for name, what in KITS.items():
            click.echo(f"{name:<{width}}  {what}")
        return 0
    if kit is None:
        raise click.UsageError(f"KIT is missing: one of {', '.join(KITS)}")
    if kit == "can":
        raise ConfigError("can: this version drives no car over CAN; replay and the simulator do without a link")
    if kit not in KITS:
        raise click.BadParameter(f"{kit!r} is none of {', '.join(KITS)}", param_hint="KIT")
    backup = write_new(out, kit_text(kit), force)
    kept = f"; the old one is {backup}" if backup else ""
    say(f"{out}: written for {kit}{kept}")
    say(f"{_NEXT} {out}" if kit != "sim" else f"next: automodel run --car {out}")
    return 0


def kit_text(kit: str) -> str:
    """The car.toml of one of KITS."""
    return (importlib.resources.files("automodel.cli") / "kits" / f"{kit}.toml").read_text(encoding="utf-8")


def write_new(path: Path, text: str, force: bool) -> Path | None:
    """Write a file, whole or not at all; the path that an old one was kept under, None where there was none.

    Raises ConfigError where there is a file and not `force`, or where it cannot be written.
    """
    if path.is_dir():
        raise ConfigError(f"{path}: is a folder; give the name of a file")
    if os.path.lexists(path) and not force:
        raise ConfigError(f"{path}: is there already; choose another name with --out, or give --force")
    backup = _free_name(path) if os.path.lexists(path) else None
    part = path.with_name(f"{path.name}.new")
    try:
        part.write_text(text, encoding="utf-8")
        if backup is not None:
            shutil.copy2(path, backup)
        os.replace(part, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            part.unlink()
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from None
    return backup


def _free_name(path: Path) -> Path:
    """The first of NAME.bak, NAME.bak.2, ... that is not taken."""
    backup, number = path.with_name(f"{path.name}.bak"), 1
    while os.path.lexists(backup):
        number += 1
        backup = path.with_name(f"{path.name}.bak.{number}")
    return backup
