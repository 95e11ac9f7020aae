"""Applies mutations to a copy of the tree, one at a time, and runs their tests there."""

from __future__ import annotations

import enum
import os
import shutil
import subprocess
import sys
from pathlib import Path

from tests.mutations.catalogue import Mutation

ROOT = Path(__file__).parents[2]
TREE = ("automodel", "calibration", "firmware_link", "tests", "tracks", "pyproject.toml", "README.md")
TIMEOUT_S = 120.0  # a mistake that makes a test wait for ever is found, too


class Outcome(enum.Enum):
    """What became of a mistake."""

    FOUND = "found"
    SURVIVED = "SURVIVED"
    BROKEN = "BROKEN"  # it does not apply, cannot be built, or its tests fail without it


class Copy:
    """A copy of the tree in `folder`, in which one mutation at a time is tried."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._passing: dict[tuple[str, ...], bool] = {}  # tests in the copy as it is
        for name in TREE:
            if (ROOT / name).is_dir():
                shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", "build"))
            else:
                shutil.copy(ROOT / name, folder / name)

    def outcome(self, mutation: Mutation) -> Outcome:
        """Whether its tests find it; the copy is as before afterwards."""
        file = self._folder / mutation.file
        right = file.read_text(encoding="utf-8")
        if mutation.tests not in self._passing:
            self._passing[mutation.tests] = self._run(mutation.tests) == 0
        if right.count(mutation.old) != 1 or not self._passing[mutation.tests]:
            return Outcome.BROKEN
        file.write_text(right.replace(mutation.old, mutation.new), encoding="utf-8")
        try:
            return self._judged(mutation)
        finally:
            file.write_text(right, encoding="utf-8")

    def _judged(self, mutation: Mutation) -> Outcome:
        if not self._builds(mutation.file):
            return Outcome.BROKEN
        code = self._run(mutation.tests)
        return {0: Outcome.SURVIVED, 1: Outcome.FOUND}.get(code, Outcome.BROKEN)

    def _builds(self, file: str) -> bool:
        if not file.endswith((".cpp", ".h")):
            compile((self._folder / file).read_text(encoding="utf-8"), file, "exec")
            return True
        firmware = self._folder / "firmware_link" / "firmware"
        nano = "/nano/" in file
        command = ["make", "-s", "-C", str(firmware), f"BUILD={self._folder / 'build'}"]
        command += [f"{self._folder / 'build' / 'firmware.elf'}" if nano else "host", "EXTRA=-Werror"]
        return subprocess.run(command, capture_output=True, check=False, timeout=TIMEOUT_S).returncode == 0

    def _run(self, tests: tuple[str, ...]) -> int:
        """pytest's exit status; 1, too, where it takes for ever."""
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-m", "not slow", *tests]
        # no byte code: two mutations within a second may have the same size, and Python would take the older one's
        environment = os.environ | {"PYTHONPATH": str(self._folder), "PYTHONDONTWRITEBYTECODE": "1"}
        try:
            done = subprocess.run(
                command, cwd=self._folder, env=environment, capture_output=True, check=False, timeout=TIMEOUT_S
            )
        except subprocess.TimeoutExpired:
            return 1
        return done.returncode
