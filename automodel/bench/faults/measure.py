"""Runs the cases of `bench faults`, in parallel."""

from __future__ import annotations

import functools
import math
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from automodel.bench.faults.catalogue import chosen
from automodel.bench.faults.fault import Fault, Must
from automodel.bench.faults.judge import Verdict
from automodel.bench.faults.rig import run_fault
from automodel.config import CameraConfig, CarConfig, ConfigError, Intrinsics
from automodel.console.messages import say
from automodel.console.progress import progress
from automodel.console.tables import show
from automodel.console.workers import spread

# Half the usual picture in each direction, of the same view: enough to see the lane, and cheap to draw.
CAR = CarConfig(
    camera=CameraConfig(
        width_px=320, height_px=180, intrinsics=Intrinsics(fx_px=240.0, fy_px=240.0, cx_px=159.5, cy_px=89.5)
    )
)


@dataclass(frozen=True, slots=True)
class Case:
    """A run of one fault."""

    name: str
    index: int


def chosen_faults(names: Sequence[str]) -> tuple[Fault, ...]:
    """The faults of these names, all of them without names; raises ConfigError for a name that is none."""
    try:
        return chosen(names)
    except ValueError as error:
        raise ConfigError(f"--only {error}") from None


def list_faults(faults: Sequence[Fault], as_json: bool) -> None:
    """Print what each fault is, and what the car must do."""
    rows: list[dict[str, object]] = [
        {
            "fault": fault.name,
            "kind": fault.kind.value,
            "must": fault.must.value,
            "within_ms": None if fault.must is Must.NOTHING or math.isinf(fault.within_s) else fault.within_s * 1e3,
            "what": fault.text,
        }
        for fault in faults
    ]
    if as_json:
        show("bench faults", rows, as_json)
        return
    for row in rows:
        sys.stdout.write(f"{row['fault']:<24}{row['kind']:<14}{row['must']:<9}{row['what']}\n")


def measure_faults(
    faults: Sequence[Fault], runs: int, seed: int, pipeline: str, jobs: int | None
) -> tuple[list[dict[str, object]], int]:
    """A row a fault, and how many runs had a violation; each of those is told on stderr."""
    cases = [Case(faults[number % len(faults)].name, number // len(faults)) for number in range(runs)]
    verdicts: dict[str, list[Verdict]] = {case.name: [] for case in cases}
    jobs = min(jobs or os.cpu_count() or 1, len(cases))
    with progress("bench faults", len(cases)) as bar:
        for case, verdict in zip(cases, spread(functools.partial(_verdict, pipeline, seed), cases, jobs), strict=True):
            verdicts[case.name].append(verdict)
            if verdict.violations:
                say(f"{case.name}, run {case.index} of seed {seed}: {'; '.join(verdict.violations)}")
            bar()
    rows = [_row(name, found) for name, found in verdicts.items()]
    return rows, sum(bool(verdict.violations) for found in verdicts.values() for verdict in found)


def _verdict(pipeline: str, seed: int, case: Case) -> Verdict:
    (fault,) = chosen((case.name,))
    return run_fault(CAR, pipeline, fault, seed, case.index)


def _row(name: str, verdicts: Sequence[Verdict]) -> dict[str, object]:
    reactions_ms = [verdict.reaction_s * 1e3 for verdict in verdicts if verdict.reaction_s is not None]
    return {
        "fault": name,
        "runs": len(verdicts),
        "violations": sum(bool(verdict.violations) for verdict in verdicts),
        "reaction_p50_ms": round(float(np.median(reactions_ms)), 3) if reactions_ms else None,
        "reaction_max_ms": round(max(reactions_ms), 3) if reactions_ms else None,
    }
