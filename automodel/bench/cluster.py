"""`bench cluster`: the same sweep in one process, in two, and on a Dask cluster of this machine whose worker is killed.

Each way must give what one process gives. The overhead of a case is what its workers were held for beyond the case
itself: start of processes, sending of cases and results, waiting at the end, and what the killed worker had done.
"""

from __future__ import annotations

import contextlib
import functools
import os
import signal
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from automodel.assembly.parts import make_pipeline
from automodel.bench.accuracy import AccuracyMeter, Case, Row, watch
from automodel.bench.faults.measure import CAR
from automodel.config import CarConfig
from automodel.config.extras import need_extra
from automodel.console.messages import say
from automodel.console.workers import Sweep, Tick, spread

WORKERS = 2
KILL_AFTER = 0.25  # share of the results after which a worker is killed
DRIVES = 10_000  # what a large sweep has; its cost is extrapolated
COLUMNS = ("way", "cases", "equal", "lost", "killed", "wall_s", "case_ms", "overhead_ms", "drives_10000_h")

Measured = tuple[Row, float]  # the results of a case, and the time [s] that it took by itself


@dataclass(frozen=True, slots=True, kw_only=True)
class ClusterChoice:
    """How many drives, of one seed each, and how many frames of each."""

    cases: int = 200
    frames: int = 10
    pipeline: str = "contour"
    track: str = "oval"


def drive(car: CarConfig, frames: int, case: Case, tick: Tick) -> Measured:
    """The results of the first frames of a drive."""
    start, meter = time.perf_counter(), AccuracyMeter()
    for estimate, truth, _ in watch(car, case, make_pipeline(case.pipeline, car).step, tick, frames):
        meter.add(estimate.t_ns * 1e-9, estimate, truth)
    return meter.row(), time.perf_counter() - start


def measure(choice: ClusterChoice, car: CarConfig = CAR) -> list[Row]:
    """A row for each way of running the sweep; raises ConfigError without Dask. The images are small by default."""
    need_extra("bench cluster", "distributed")
    # a clean floor: the patterns of any other take longer to draw than the few frames of a case
    first = Case(pipeline=choice.pipeline, track=choice.track, style="oscillating", look="clean", seed=0)
    cases = [replace(first, seed=seed) for seed in range(choice.cases)]
    work = functools.partial(drive, car, choice.frames)
    drive(car, 2, first, lambda share: None)  # compiled code is loaded before anything is timed
    rows = [_run("one process", work, cases, Sweep(jobs=1), 1)]
    rows.append(_run(f"{WORKERS} processes", work, cases, Sweep(jobs=WORKERS), WORKERS))
    with _cluster() as (address, pids):
        rows.append(_run(f"Dask, {WORKERS} workers", work, cases, Sweep(scheduler=address), WORKERS, pids[0]))
    found = [row.pop("found") for row in rows]
    for row, own in zip(rows, found, strict=True):
        row["equal"] = own == found[0]
    hours = min(float(row["drives_10000_h"]) for row in rows)
    say(
        f"{DRIVES} drives of {choice.frames} frames: {hours:.2g} h on this machine, extrapolated from {choice.cases}; "
        f"{hours / 10.0:.2g} h on ten such machines if they add up, which cases that share nothing do; longer drives "
        "cost in proportion to their frames"
    )
    return rows


@contextlib.contextmanager
def _cluster() -> Iterator[tuple[str, list[int]]]:
    """The address of a cluster on this machine, and the processes of its workers."""
    import distributed

    with (
        distributed.LocalCluster(n_workers=WORKERS, threads_per_worker=1, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
    ):
        yield cluster.scheduler_address, list(client.run(os.getpid).values())


def _run(way: str, work: Any, cases: Sequence[Case], sweep: Sweep, workers: int, victim: int | None = None) -> Row:
    """Run the sweep one way; `victim` is a worker's process that is killed on the way."""
    start, own_s, found, killed = time.perf_counter(), 0.0, [], 0
    for _, (row, seconds) in spread(f"bench cluster: {way}", work, cases, sweep):
        found.append(row)
        own_s += seconds
        if victim is not None and not killed and len(found) >= KILL_AFTER * len(cases):
            os.kill(victim, signal.SIGKILL)
            killed = 1
    wall_s = time.perf_counter() - start
    return {
        "way": way,
        "cases": len(cases),
        "equal": None,
        "lost": len(sweep.lost),
        "killed": killed,
        "wall_s": wall_s,
        "case_ms": 1e3 * own_s / len(found) if found else None,
        "overhead_ms": 1e3 * (workers * wall_s - own_s) / len(cases),
        "drives_10000_h": DRIVES * wall_s / len(cases) / 3600.0,
        "found": found,
    }
