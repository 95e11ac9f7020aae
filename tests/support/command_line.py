"""Fixtures of the tests that run command lines; import them in a conftest."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from automodel.cli.main import run


@dataclass(frozen=True)
class Said:
    """What a command line gave."""

    code: int
    out: str
    err: str

    @property
    def rows(self) -> list[dict[str, Any]]:
        """The rows of --json, which is one object and nothing else on stdout."""
        said = json.loads(self.out)
        assert list(said)[:3] == ["version", "command", "rows"]
        assert list(said)[3:] in ([], ["machine"])
        return said["rows"]

    def line(self) -> str:
        """The one line on stderr."""
        lines = self.err.splitlines()
        assert len(lines) == 1, self.err
        return lines[0]


Cli = Callable[..., Said]


@pytest.fixture
def cli(capsys: pytest.CaptureFixture[str]) -> Cli:
    """Runs a command line in this process."""

    def call(*arguments: object) -> Said:
        capsys.readouterr()
        code = run([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        return Said(code, out, err)

    return call


def as_ordinary_user(*arguments: object) -> Said:
    """Runs a command line in a process that must keep to the permissions of files, also where root runs the tests."""
    command = [sys.executable, "-m", "automodel", *(str(argument) for argument in arguments)]
    if os.geteuid() == 0:
        command = ["setpriv", "--bounding-set=-dac_override,-dac_read_search", *command]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    return Said(done.returncode, done.stdout, done.stderr)


@pytest.fixture(scope="session")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with run.mcap and truth.csv: two seconds on the oval in lock-step, once for all tests; leave them."""
    folder = tmp_path_factory.mktemp("driven")
    arguments = ["--track", "oval", "--duration", "2", "--seed", "3", "--lossless"]
    assert run(["run", *arguments, "--record", f"{folder}/run.mcap", "--truth", f"{folder}/truth.csv"]) == 0
    return folder
