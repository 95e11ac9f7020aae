"""Applies mutations to a copy of the tree, one at a time, and runs their tests there."""

from __future__ import annotations

import enum
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

from tests.mutations.catalogue import Mutation

ROOT = Path(__file__).parents[2]
TREE = ("automodel", "calibration", "firmware_link", "tests", "tracks", "pyproject.toml", "README.md")
RIGHT_S = 1200.0  # for the tests of the tree as it is, on a machine that is busy with other work
SLOWER, LEAST_S = 5.0, 60.0  # a mistake that makes them take so many times as long, and this, is found, too


class Outcome(enum.Enum):
    """What became of a mistake."""

    FOUND = "found"
    SURVIVED = "SURVIVED"
    BROKEN = "BROKEN"  # it does not apply, cannot be built, or its tests fail without it


class Copy:
    """A copy of the tree in `folder`, in which one mutation at a time is tried."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        # no byte code: two mutations within a second may have the same size, and Python would take the older one's
        self._environment = os.environ | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
        self._took_s: dict[tuple[str, ...], float | None] = {}  # tests in the copy as it is; None: they fail
        for name in TREE:
            if (ROOT / name).is_dir():
                shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", "build"))
            else:
                shutil.copy(ROOT / name, folder / name)

    def outcome(self, mutation: Mutation) -> Outcome:
        """Whether its tests find it; the copy is as before afterwards."""
        file = self._folder / mutation.file
        right = file.read_text(encoding="utf-8")
        took_s = self._right(mutation.tests)
        if right.count(mutation.old) != 1 or took_s is None:
            return Outcome.BROKEN
        file.write_text(right.replace(mutation.old, mutation.new), encoding="utf-8")
        try:
            return self._judged(mutation, max(SLOWER * took_s, LEAST_S))
        finally:
            file.write_text(right, encoding="utf-8")

    def by_bench(self, mutation: Mutation) -> str | None:
        """Which violation `bench faults` finds with the mistake, None where it finds none; the copy is as before."""
        file = self._folder / mutation.file
        right = file.read_text(encoding="utf-8")
        file.write_text(right.replace(mutation.old, mutation.new), encoding="utf-8")
        command = [sys.executable, "-m", "tests.mutations.bench", *(["avr"] if file.suffix in (".cpp", ".h") else [])]
        try:
            done = subprocess.run(
                command, cwd=self._folder, env=self._environment, capture_output=True, check=False, timeout=RIGHT_S
            )
        except subprocess.TimeoutExpired:
            return "it takes for ever"
        finally:
            file.write_text(right, encoding="utf-8")
        said = (done.stdout + done.stderr).decode(errors="replace").strip().splitlines()
        return None if done.returncode == 0 else said[-1]

    def _right(self, tests: tuple[str, ...]) -> float | None:
        """How long these tests take without a mistake [s], None where they fail."""
        if tests not in self._took_s:
            start_s = time.monotonic()
            passed = self._run(tests, RIGHT_S) == 0
            self._took_s[tests] = time.monotonic() - start_s if passed else None
        return self._took_s[tests]

    def _judged(self, mutation: Mutation, timeout_s: float) -> Outcome:
        if not self._builds(mutation.file):
            return Outcome.BROKEN
        code = self._run(mutation.tests, timeout_s)
        return {0: Outcome.SURVIVED, 1: Outcome.FOUND}.get(code, Outcome.BROKEN)

    def _builds(self, file: str) -> bool:
        if not file.endswith((".cpp", ".h")):
            compile((self._folder / file).read_text(encoding="utf-8"), file, "exec")
            return True
        firmware = self._folder / "firmware_link" / "firmware"
        nano = "/nano/" in file
        command = ["make", "-s", "-C", str(firmware), f"BUILD={self._folder / 'build'}"]
        command += [f"{self._folder / 'build' / 'firmware.elf'}" if nano else "host", "EXTRA=-Werror"]
        return subprocess.run(command, capture_output=True, check=False, timeout=RIGHT_S).returncode == 0

    def _run(self, tests: tuple[str, ...], timeout_s: float) -> int:
        """pytest's exit status; 1, too, where it takes for ever."""
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-m", "not slow", *tests]
        try:
            done = subprocess.run(
                command, cwd=self._folder, env=self._environment, capture_output=True, check=False, timeout=timeout_s
            )
        except subprocess.TimeoutExpired:
            return 1
        return done.returncode
