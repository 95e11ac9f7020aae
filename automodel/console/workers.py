"""Work spread over processes, ended in order when someone presses Ctrl-C."""

from __future__ import annotations

import concurrent.futures
import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

import click

from automodel.runtime.os_signals import signals_held_back

Case = TypeVar("Case")
Result = TypeVar("Result")


def spread(work: Callable[[Case], Result], cases: Sequence[Case], jobs: int) -> Iterator[Result]:
    """`work` of each case, in the cases' order, each as soon as it is there; raises what `work` raises."""
    if jobs == 1:
        yield from map(work, cases)
        return
    context = multiprocessing.get_context("spawn")
    pool = concurrent.futures.ProcessPoolExecutor(jobs, mp_context=context, initializer=_one_thread)
    done = False
    try:
        with signals_held_back():
            results = pool.map(work, cases)
        yield from results
        done = True
    except concurrent.futures.process.BrokenProcessPool:
        raise click.ClickException("a worker process died, perhaps for want of memory; try fewer --jobs") from None
    finally:
        if not done:
            for process in multiprocessing.active_children():
                process.kill()
        pool.shutdown(cancel_futures=True)


def _one_thread() -> None:
    import cv2

    cv2.setNumThreads(1)
