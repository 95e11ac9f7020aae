"""Closed, full and broken standard streams: never a traceback."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

RUN = f"{sys.executable} -m automodel run --pipeline windows --track oval --duration 0.1 --json"
ENDED = "the car did not drive: the vehicle has not said hello\n"


def shell(command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["bash", "-c", command], capture_output=True, text=True)


@pytest.mark.parametrize("closed", ["<&-", "2>&-", "</dev/null"])
def test_closed_streams_change_nothing(closed: str) -> None:
    done = shell(f"{RUN} {closed}")
    assert done.returncode == 0
    assert json.loads(done.stdout)["command"] == "run"
    assert done.stderr == ("" if "2>&-" in closed else ENDED)


def test_a_closed_stdout_is_nobody_listening() -> None:
    done = shell(f"{RUN} >&-")
    assert (done.returncode, done.stderr) == (0, ENDED)


@pytest.mark.parametrize("command", [RUN, f"{sys.executable} -m automodel --help"])
def test_a_reader_that_goes_away_is_no_error_to_tell(command: str) -> None:
    done = shell(f"{command} | true")
    assert done.stderr in ("", ENDED)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
@pytest.mark.parametrize("unbuffered", ["", "PYTHONUNBUFFERED=1"])
def test_a_full_disk_behind_stdout_is_one_line(unbuffered: str) -> None:
    done = shell(f"{unbuffered} {RUN} > /dev/full")
    assert done.returncode in (1, 2)
    assert done.stderr.splitlines() == ["automodel: the output cannot be written: No space left on device"]


def test_piped_tables_are_plain() -> None:
    done = shell(f"{RUN.removesuffix('--json')} | cat")
    assert "\x1b" not in done.stdout
    assert done.stdout.split()[0] == "laps"
