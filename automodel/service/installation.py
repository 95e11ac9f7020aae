"""Installs the service, asks systemd how it is, shows its log."""

from __future__ import annotations

import getpass
import grp
import os
import pwd
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from automodel.config import ConfigError
from automodel.output_files import output_text
from automodel.service.unit import GROUPS, MARK, NAME, Service, rules_text, unit_text

UNIT, RULES = Path("etc/systemd/system") / NAME, Path("etc/udev/rules.d/60-automodel.rules")
_ASKED = ("ActiveState", "SubState", "UnitFileState", "Result", "NRestarts", "MainPID", "StatusText")


def service_of(car_file: Path, options: Sequence[str], user: str | None, poweroff: bool) -> Service:
    """The service that drives with this car.toml; raises ConfigError for a user that there is not."""
    name = user or os.environ.get("SUDO_USER") or getpass.getuser()
    try:
        pwd.getpwnam(name)
    except KeyError:
        raise ConfigError(f"--user {name}: there is no such user on this machine") from None
    known = {group.gr_name for group in grp.getgrall()}
    car = car_file.resolve()
    command = [sys.executable, "-m", "automodel", "run", "--car", str(car), *options]
    return Service(
        command=[*command, "--until-battery-low"] if poweroff else command,
        folder=car.parent,
        user=name,
        groups=[group for group in GROUPS if group in known],
        poweroff=poweroff,
    )


def install(service: Service, root: Path) -> list[Path]:
    """Write unit and rules below `root`, and enable the service; gives the files. Raises ConfigError."""
    texts = {root / UNIT: unit_text(service), root / RULES: rules_text()}
    for path in texts:
        _check_ours(path)
    for path, text in texts.items():
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"{path.parent}: cannot be made: {error.strerror}; use sudo, or --root") from None
        if not os.access(path.parent, os.W_OK):
            raise ConfigError(f"{path}: cannot be written; use sudo, or --root")
        with output_text(path) as file:
            file.write(text)
    if root == Path("/"):
        _call("systemctl", "daemon-reload")
        _call("udevadm", "control", "--reload")
        _call("systemctl", "enable", NAME)
    else:
        _call("systemctl", f"--root={root}", "enable", NAME)
    return list(texts)


def remove(root: Path) -> list[Path]:
    """Stop and disable the service and delete its files; gives those that were there. Raises ConfigError."""
    there = [path for path in (root / UNIT, root / RULES) if path.exists()]
    for path in there:
        _check_ours(path)
    if root / UNIT in there:
        _call("systemctl", *(["disable", "--now"] if root == Path("/") else [f"--root={root}", "disable"]), NAME)
    for path in there:
        try:
            path.unlink()
        except OSError as error:
            raise ConfigError(f"{path}: cannot be deleted: {error.strerror}; use sudo") from None
    return there


def status(root: Path) -> dict[str, object]:
    """How the service is: whether it is installed and, on this machine's own root, what systemd says of it."""
    row: dict[str, object] = {"installed": (root / UNIT).exists(), "unit": str(root / UNIT)}
    if root == Path("/") and row["installed"]:
        answer = _call("systemctl", "show", NAME, *(f"--property={name}" for name in _ASKED))
        said = dict(line.partition("=")[::2] for line in answer.splitlines())
        row |= {
            "state": f"{said.get('ActiveState', '')} ({said.get('SubState', '')})",
            "at_boot": said.get("UnitFileState") == "enabled",
            "restarts": int(said.get("NRestarts") or 0),
            "pid": int(said.get("MainPID") or 0) or None,
            "result": said.get("Result"),
            "says": said.get("StatusText"),
        }
    return row


def logs(lines: int, follow: bool) -> int:
    """Show the journal of the service on this terminal; gives journalctl's exit code. Raises ConfigError."""
    program = _program("journalctl")
    arguments = [program, f"--unit={NAME}", f"--lines={lines}", "--output=short-precise"]
    return subprocess.run([*arguments, *(["--follow"] if follow else ["--no-pager"])], check=False).returncode


def _check_ours(path: Path) -> None:
    try:
        ours = not path.exists() or path.read_text(encoding="utf-8", errors="replace").startswith(MARK)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    if not ours:
        raise ConfigError(f"{path}: was not written by automodel; move it away first")


def _program(name: str) -> str:
    found = shutil.which(name)
    if found is None:
        raise ConfigError(f"{name}: not found: this machine has no systemd; the service needs one")
    return found


def _call(name: str, *arguments: str) -> str:
    done = subprocess.run([_program(name), *arguments], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        why = " ".join((done.stderr or done.stdout).split()) or f"ended with {done.returncode}"
        raise ConfigError(f"{name} {arguments[0]}: {why}")
    return done.stdout
