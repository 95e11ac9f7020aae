"""`automodel init`: a commented car.toml to start with."""

from __future__ import annotations

import os
from pathlib import Path

import click

from automodel.cli.options import FILE
from automodel.config import ConfigError
from automodel.console.messages import say
from calibration.car_file import replace_file

KITS = {  # each in automodel/cli/kits/<name>.toml
    "nano-arduino": "Jetson Nano, CSI camera, Arduino Nano: cars like the AutoModelCar.",
    "orin-nano-arduino": "Jetson Orin Nano, CSI camera, Arduino Nano.",
    "usb-camera": "Any machine with a USB camera, Arduino Nano.",
    "pi5": "Raspberry Pi 5 with its camera, Arduino Nano.",
    "jetracer": "JetRacer: its Jetson and camera; an Arduino Nano replaces its servo driver.",
    "full-size": "A full-size car on a CAN bus; as it is written the simulated one.",
    "sim": "The simulated car, no hardware at all.",
    "sim-stereo": "The simulated car with two cameras.",
}
_TRACK = {"full-size": " --track ring"}
SIMULATED = ("sim", "sim-stereo", "full-size")
_NEXT = "next: measure what is marked +, then: automodel doctor --car"


@click.command("init")
@click.argument("kit", required=False)
@click.option("--out", type=FILE, default=Path("car.toml"), show_default=True, help="The file to write.")
@click.option("--list", "listing", is_flag=True, help="List the kits and write nothing.")
@click.option("--force", is_flag=True, help="Replace an existing file; the old one is kept as NAME.bak.")
def command(kit: str | None, out: Path, listing: bool, force: bool) -> int:
    """Write a commented car.toml for KIT (see --list).

    Example:

    automodel init nano-arduino --out car.toml
    """
    if listing:
        width = max(map(len, KITS))
        for name, what in KITS.items():
            click.echo(f"{name:<{width}}  {what}")
        return 0
    if kit is None:
        raise click.UsageError(f"KIT is missing: one of {', '.join(KITS)}")
    if kit not in KITS:
        raise click.BadParameter(f"expected one of {', '.join(KITS)}, got {kit!r}", param_hint="KIT")
    backup = write_new(out, kit_text(kit), force)
    say(f"{out}: written for {kit}" + (f"; the old one is {backup}" if backup else ""))
    say(f"{_NEXT} {out}" if kit not in SIMULATED else f"next: automodel run --car {out}{_TRACK.get(kit, '')}")
    return 0


def kit_text(kit: str) -> str:
    """The car.toml of one of KITS."""
    return kit_path(kit).read_text(encoding="utf-8")


def kit_path(kit: str) -> Path:
    """The file of one of KITS."""
    return Path(__file__).parent / "kits" / f"{kit}.toml"


def write_new(path: Path, text: str, force: bool) -> Path | None:
    """Write a file, whole or not at all; returns the backup of an old one, None where there was none.

    Raises ConfigError for an existing file without `force`, or where the file cannot be written.
    """
    if path.is_dir():
        raise ConfigError(f"{path}: is a folder; give the name of a file")
    if os.path.lexists(path) and not force:
        raise ConfigError(f"{path}: exists already; choose another name with --out, or give --force")
    try:
        return replace_file(Path(os.path.realpath(path)), text)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from None
