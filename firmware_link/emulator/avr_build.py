"""Builds what `AvrBoard` runs: the firmware by avr-gcc, the simulated board around it by gcc and simavr."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

from firmware_link.errors import LinkError

FIRMWARE = Path(__file__).parents[1] / "firmware"
PACKAGES = "make gcc gcc-avr avr-libc libsimavr-dev libelf-dev"
_TIMEOUT_S = 120.0
_HEADERS = (("avr-g++", "avr/io.h"), ("gcc", "simavr/sim_avr.h"), ("gcc", "libelf.h"))


class AvrMissing(LinkError):
    """The simulated AVR cannot be built here; the text says what to install."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AvrProgram:
    """The firmware for the chip, and the program for this machine that simulates the board."""

    firmware: Path
    simulator: Path


def build_avr(folder: Path, baud: int = 115200) -> AvrProgram:
    """Build both into `folder` (about 2 s); raises AvrMissing where a tool is not there or does not do its work."""
    simulator = FIRMWARE / "simavr"
    if not simulator.is_dir():
        raise AvrMissing(
            f"{simulator}: not there; the simulated AVR is no part of the installed package, use a checkout"
        )
    missing = missing_tools()
    if missing:
        raise AvrMissing(f"{', '.join(missing)}: missing for the simulated AVR; apt-get install {PACKAGES}")
    _make(FIRMWARE, folder / "firmware.elf", f"BUILD={folder}", f"BAUD={baud}")
    _make(simulator, folder / "avr_board", f"BUILD={folder}")
    return AvrProgram(firmware=folder / "firmware.elf", simulator=folder / "avr_board")


def missing_tools() -> list[str]:
    """The programs and headers that are not installed."""
    missing = [tool for tool in ("make", "gcc", "avr-g++") if shutil.which(tool) is None]
    return missing + [name for tool, name in _HEADERS if tool not in missing and not _has_header(tool, name)]


def _has_header(compiler: str, name: str) -> bool:
    command = [compiler, "-E", "-x", "c", "-include", name, "/dev/null"]
    if compiler != "gcc":
        command.insert(1, "-mmcu=atmega328p")
    return subprocess.run(command, capture_output=True, timeout=_TIMEOUT_S, check=False).returncode == 0


def _make(source: Path, target: Path, *variables: str) -> None:
    command = ["make", "-s", "-C", str(source), *variables, str(target)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)
    if done.returncode != 0:
        errors = [line for line in done.stderr.splitlines() if "error" in line.lower()] or done.stderr.splitlines()
        raise AvrMissing(f"{target.name}: cannot be built: {errors[0] if errors else 'make failed'}")
