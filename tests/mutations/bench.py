"""`python -m tests.mutations.bench [avr]`, in a copy of the tree: exit code 1 with the first fault that is a violation.

A run of each fault of `automodel bench faults`, with the true lane; `avr`: of the wire and the board, on the chip.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from automodel.bench.faults.catalogue import chosen
from automodel.bench.faults.measure import CAR, TRUTH, judged
from firmware_link.emulator.avr import build_avr

SEED = 31


def main(link: str) -> int:
    """Judge a run of each fault."""
    with tempfile.TemporaryDirectory(prefix="avr-") as folder:
        program = build_avr(Path(folder), CAR.link.baud) if link == "avr" else None
        for fault in chosen((), images=False, link=link if link == "avr" else None):
            verdict = judged(TRUTH, fault, SEED, 0, program)
            if verdict.violations:
                sys.stdout.write(f"{fault.name}: {verdict.violations[0]}\n")
                return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1] if len(sys.argv) > 1 else "arduino"))
