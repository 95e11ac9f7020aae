from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from automodel.service.installation import RULES, UNIT
from automodel.service.unit import Service, quoted, rules_text, unit_text
from tests.support.command_line import Cli, as_ordinary_user, cli

__all__ = ["cli"]
SYSTEMD = pytest.mark.skipif(shutil.which("systemctl") is None, reason="needs systemd's programs")
VERIFY = pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
CAR = '[camera]\nsource = "usb"\n[link]\nport = "/dev/ttyUSB0"\n'


@pytest.fixture
def car(tmp_path: Path) -> Path:
    path = tmp_path / "my car 100%.toml"
    path.write_text(CAR)
    return path


@pytest.fixture
def root(tmp_path: Path) -> Path:
    folder = tmp_path / "root"
    folder.mkdir()
    return folder


@SYSTEMD
def test_install_writes_enables_and_remove_takes_it_back(car: Path, root: Path, cli: Cli) -> None:
    said = cli("service", "install", "--car", car, "--root", root, "--user", "root", "--", "--web", "0.0.0.0:8765")
    assert said.code == 0
    text = (root / UNIT).read_text()
    assert f'run --car "{str(car).replace("%", "%%")}" --web 0.0.0.0:8765 --until-battery-low\n' in text
    assert f"ExecStart={sys.executable} -m automodel run" in text
    assert (root / UNIT).parent.joinpath("multi-user.target.wants/automodel.service").is_symlink()
    assert "/dev/automodel-board" in said.err
    assert cli("service", "install", "--car", car, "--root", root, "--user", "root").code == 0  # anew
    assert "--web" not in (root / UNIT).read_text()
    assert cli("service", "status", "--root", root, "--json").rows == [{"installed": True, "unit": str(root / UNIT)}]
    assert cli("service", "remove", "--root", root).code == 0
    assert not [path for path in root.rglob("*") if not path.is_dir()]
    assert cli("service", "remove", "--root", root).err == "there is no service here\n"


@SYSTEMD
@VERIFY
def test_systemd_itself_finds_nothing_wrong(car: Path, root: Path, cli: Cli) -> None:
    assert cli("service", "install", "--car", car, "--root", root, "--user", "root").code == 0
    done = subprocess.run(["systemd-analyze", "verify", root / UNIT], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@VERIFY
def test_the_verification_can_fail(tmp_path: Path) -> None:
    service = Service(command=["/missing/python"], folder=tmp_path, user="root")
    unit = tmp_path / "automodel.service"
    unit.write_text(unit_text(service).replace("WatchdogSec=20", "WatchdogSec=soon"))
    done = subprocess.run(["systemd-analyze", "verify", unit], capture_output=True, text=True, check=False)
    assert "Failed to parse sec value" in done.stderr
    assert "/missing/python" in done.stderr


def test_without_poweroff_nothing_shuts_down(tmp_path: Path) -> None:
    service = Service(command=["x"], folder=tmp_path, user="root")
    assert "ExecStopPost" in unit_text(service)
    without = Service(command=["x"], folder=tmp_path, user="root", poweroff=False)
    assert "ExecStopPost" not in unit_text(without)


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("plain", "plain"),
        ("", '""'),
        ("a b", '"a b"'),
        ("100%", "100%%"),
        ("$HOME", "$$HOME"),
        ('say "x"', '"say \\"x\\""'),
        ("back\\slash", "back\\\\slash"),
        ("a;b", '"a;b"'),
    ],
)
def test_words_are_quoted_for_systemd(word: str, expected: str) -> None:
    assert quoted(word) == expected


def test_each_rule_is_one_of_udevs() -> None:
    for line in rules_text().splitlines()[1:]:
        for part in line.split(", "):
            assert re.fullmatch(r'[A-Z]+(\{\w+\})?(==|=|\+=)"[^"]*"', part), part


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--", "--wep"], "automodel run: No such option"),
        (["--", "--speed", "fast"], "automodel run: Invalid value for '--speed': 'fast' is not a valid float range."),
        (["--user", "no-such-user"], "automodel: --user no-such-user: there is no such user on this machine"),
    ],
)
def test_what_is_wrong_is_told_and_nothing_is_written(
    arguments: list[str], line: str, car: Path, root: Path, cli: Cli
) -> None:
    said = cli("service", "install", "--car", car, "--root", root, *arguments)
    assert (said.code, said.out) == (2, "")
    assert said.line().startswith(line)
    assert not list(root.iterdir())


def test_a_simulated_car_is_no_service(tmp_path: Path, root: Path, cli: Cli) -> None:
    (tmp_path / "sim.toml").write_text("")
    said = cli("service", "install", "--car", tmp_path / "sim.toml", "--root", root)
    assert said.line().endswith('[link] port is "sim": a service drives a real car')


def test_a_unit_of_somebody_else_is_left_alone(car: Path, root: Path, cli: Cli) -> None:
    unit = root / UNIT
    unit.parent.mkdir(parents=True)
    unit.write_text("[Service]\n")
    for command in (["install", "--car", car, "--user", "root"], ["remove"]):
        said = cli("service", *command, "--root", root)
        assert said.line() == f"automodel: {unit}: was not written by automodel; move it away first"
    assert unit.read_text() == "[Service]\n"
    assert not (root / RULES).exists()


def test_without_rights_nothing_is_written(car: Path, root: Path) -> None:
    folder = (root / UNIT).parent
    folder.mkdir(parents=True)
    folder.chmod(0o555)
    said = as_ordinary_user("service", "install", "--car", car, "--root", root, "--user", "root")
    assert (said.code, said.line()) == (2, f"automodel: {root / UNIT}: cannot be written; use sudo, or --root")
    assert not list(folder.iterdir())


def test_a_machine_without_systemd_is_told_so(monkeypatch: pytest.MonkeyPatch, cli: Cli) -> None:
    monkeypatch.setenv("PATH", "")
    assert cli("service", "logs").line() == (
        "automodel: journalctl: not found: this machine has no systemd; the service needs one"
    )


@pytest.mark.parametrize("state", ["active", "activating"])
def test_status_and_logs_ask_systemd(state: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cli: Cli) -> None:
    """With programs in their place that answer as systemd does."""
    programs = tmp_path / "bin"
    programs.mkdir()
    answer = (
        f"ActiveState={state}\nSubState=running\nUnitFileState=enabled\nResult=success\nNRestarts=3\nMainPID=77\n"
        "StatusText=DRIVING\n"
    )
    for name, text in {"systemctl": answer, "journalctl": "$*\n"}.items():
        (programs / name).write_text(f"#!/bin/sh\ncat <<END\n{text}END\n")
        (programs / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}:{os.environ['PATH']}")
    monkeypatch.setattr("automodel.service.installation.UNIT", tmp_path.relative_to("/") / "there")
    (tmp_path / "there").touch()
    said = cli("service", "status", "--json")
    assert said.code == (0 if state == "active" else 1)
    (row,) = said.rows
    assert {name: row[name] for name in ("at_boot", "restarts", "pid", "says")} == {
        "at_boot": True, "restarts": 3, "pid": 77, "says": "DRIVING"
    }  # fmt: skip
    assert cli("service", "logs", "--lines", "7").code == 0
