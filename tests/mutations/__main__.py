"""`python -m tests.mutations [NAME ...]`: a line for each mistake; exit code 1 where one is not found."""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

from tests.mutations.catalogue import MUTATIONS
from tests.mutations.runner import Copy, Outcome


def main(names: list[str]) -> int:
    """Try the mutations with these names, all without any."""
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
            outcome = copy.outcome(mutation)
            wrong += outcome is not Outcome.FOUND
            took_s = time.monotonic() - start_s
            sys.stdout.write(f"{outcome.value:9} {took_s:5.1f} s  {mutation.name:30} {mutation.file}\n")
            sys.stdout.flush()
    sys.stdout.write(f"{len(chosen) - wrong} of {len(chosen)} found\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
