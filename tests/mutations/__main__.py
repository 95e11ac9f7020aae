"""`python -m tests.mutations [--bench] [NAME ...]`: a line for each mistake; exit code 1 where one is not found.

By its tests; with `--bench` by `automodel bench faults`, or by the second layer that covers it.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

from tests.mutations.catalogue import LAYERS, MUTATIONS, Mutation
from tests.mutations.runner import Copy, Outcome

BENCH = "--bench"


def by_tests(copy: Copy, mutation: Mutation) -> tuple[bool, str]:
    """Whether a test finds it, and in a word."""
    outcome = copy.outcome(mutation)
    return outcome is Outcome.FOUND, outcome.value


def by_bench(copy: Copy, mutation: Mutation) -> tuple[bool, str]:
    """Whether the bench finds it or a second layer covers it, and by what."""
    found, layer = copy.by_bench(mutation), LAYERS.get(mutation.name)
    if found is not None:
        return True, f"found: {found}"
    return layer is not None, f"covered: {layer}" if layer else Outcome.SURVIVED.value


def main(arguments: list[str]) -> int:
    """Try the mutations with these names, all without any."""
    names = [argument for argument in arguments if argument != BENCH]
    tried = by_bench if BENCH in arguments else by_tests
    unknown = set(names) - {mutation.name for mutation in MUTATIONS}
    if unknown:
        sys.stderr.write(f"mutations: {', '.join(sorted(unknown))}: no such mutation\n")
        return 2
    chosen = [mutation for mutation in MUTATIONS if not names or mutation.name in names]
    wrong = 0
    with tempfile.TemporaryDirectory(prefix="mutations-") as folder:
        copy = Copy(Path(folder))
        for mutation in chosen:
            start_s = time.monotonic()
            found, word = tried(copy, mutation)
            wrong += not found
            took_s = time.monotonic() - start_s
            sys.stdout.write(f"{word:9} {took_s:5.1f} s  {mutation.name:30} {mutation.file}\n")
            sys.stdout.flush()
    sys.stdout.write(f"{len(chosen) - wrong} of {len(chosen)} found\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
