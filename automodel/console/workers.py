"""Work spread over processes, with progress from inside each case; Ctrl-C ends all of them."""

from __future__ import annotations

import concurrent.futures
import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.sharedctypes import Synchronized
from typing import TypeVar

import click

from automodel.console.progress import progress
from automodel.runtime.os_signals import signals_held_back

Case = TypeVar("Case")
Result = TypeVar("Result")
Tick = Callable[[float], None]  # takes the share of a case that was done since the last call
Work = Callable[[Case, Tick], Result]

POLL_S = 0.1
_done: Synchronized[float]  # in a worker process: how many cases all of them have done, in parts


def spread(title: str, work: Work[Case, Result], cases: Sequence[Case], jobs: int | None) -> Iterator[Result]:
    """Yield `work(case, tick)` in the order of `cases`, each result as soon as it is there, under a progress bar.

    `jobs` is the number of processes (None: one a core). Raises what `work` raises, and ClickException where a process
    died.
    """
    jobs = min(jobs or os.cpu_count() or 1, len(cases))
    with progress(title, len(cases), threaded=False) as tick:
        if jobs <= 1:
            for case in cases:
                yield work(case, tick)
        else:
            yield from _in_processes(work, cases, jobs, tick)


def _in_processes(work: Work[Case, Result], cases: Sequence[Case], jobs: int, tick: Tick) -> Iterator[Result]:
    context = multiprocessing.get_context("spawn")
    counter: Synchronized[float] = context.Value("d", 0.0)
    pool = concurrent.futures.ProcessPoolExecutor(jobs, context, initializer=_start_worker, initargs=(counter,))
    shown, whole = 0.0, False
    try:
        with signals_held_back():
            futures = [pool.submit(_run, work, case) for case in cases]
        for future in futures:
            while not concurrent.futures.wait([future], POLL_S).done:
                done = counter.get_obj().value  # without its lock, which a process may hold as it dies
                tick(done - shown)
                shown = done
            yield future.result()
        whole = True
    except concurrent.futures.process.BrokenProcessPool:
        raise click.ClickException("a worker process died; was the memory full? try fewer --jobs") from None
    finally:
        if not whole:
            for process in multiprocessing.active_children():
                process.kill()
        pool.shutdown(cancel_futures=True)


def _start_worker(counter: Synchronized[float]) -> None:
    global _done  # the pool hands shared memory to a process only as it starts
    import cv2

    cv2.setNumThreads(1)
    _done = counter


def _run(work: Work[Case, Result], case: Case) -> Result:
    return work(case, _tick)


def _tick(share: float) -> None:
    with _done.get_lock():
        _done.value += share
