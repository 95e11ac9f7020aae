"""`python -m tests.fuzz [--target NAME] [--count N] [--seed N]`: exit code 1 where a damaged file was taken wrong."""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from tests.fuzz.runner import trials
from tests.fuzz.targets import TARGETS


def main() -> int:
    """Try every target, or the one that is named; what was wrong is kept in a folder that is told."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description="Damaged files at every parser.")
    parser.add_argument("--target", choices=[target.name for target in TARGETS])
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    wrong = 0
    folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
    for target in TARGETS:
        if given.target in (None, target.name):
            found = [(number, text) for number, text in trials(target, given.count, given.seed, folder) if text]
            wrong += len(found)
            sys.stdout.write(f"{target.name}: {given.count} damaged files, {len(found)} taken wrong\n")
            sys.stdout.writelines(f"  {folder}/{target.name}-{given.seed}-{number}: {text}\n" for number, text in found)
            sys.stdout.flush()
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
