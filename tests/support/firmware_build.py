"""Builds the board's program for tests; skips with the reason where a tool is missing."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

import firmware_link

FIRMWARE = Path(firmware_link.__file__).parent / "firmware"


def need(*tools: str, package: str) -> None:
    """Skip where one of `tools` is missing."""
    missing = [tool for tool in tools if shutil.which(tool) is None]
    if missing:
        pytest.skip(f"{', '.join(missing)} is not installed (Debian: apt-get install {package})")


def host_library(folder: Path, extra: str = "") -> Path:
    """The decisions as a shared library for this machine, built into `folder` with more compiler flags."""
    need("make", "g++", package="make g++")
    return make("libfirmware.so", folder, f"EXTRA=-Werror {extra}")


def make(name: str, folder: Path, *variables: str, source: Path = FIRMWARE) -> Path:
    """One file by the Makefile of `source`; fails with what the compiler said."""
    command = ["make", "-s", "-C", str(source), f"BUILD={folder}", *variables, f"{folder}/{name}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder / name
