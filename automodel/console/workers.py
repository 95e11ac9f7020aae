"""Independent cases spread over processes or a cluster, with progress from inside each; Ctrl-C ends all of them.

A process that dies takes nothing but its own case with it, which is tried once more.
"""

from __future__ import annotations

import collections
import concurrent.futures
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from multiprocessing.context import SpawnContext
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from typing import Any, TypeVar

import click

from automodel.config.extras import need_extra
from automodel.console.kept import KeptResults, code_digest
from automodel.console.messages import say
from automodel.console.progress import progress
from automodel.runtime.os_signals import signals_held_back

Case = TypeVar("Case")
Result = TypeVar("Result")
Tick = Callable[[float], None]  # takes the share of a case that was done since the last call
Work = Callable[[Case, Tick], Result]

POLL_S = 0.1
TRIES = 2  # of a case whose process dies: the first death may be anyone's doing, such as full memory
CONNECT_S = 10.0  # for a scheduler to answer
_CASE_TEXT = 160  # characters of a lost case in its message
_LOST: Any = object()
_done: Synchronized[float]  # in a worker process: how many cases it has done, in parts
_alone = threading.Lock()  # in a cluster's worker: cases move module constants, and so run one at a time


@dataclass(frozen=True, slots=True, kw_only=True)
class Sweep:
    """Where cases run: `jobs` processes (None: one a core), or the Dask cluster of `scheduler` ("tcp://host:port").

    `keep` is a folder for the results of finished cases, which are not run again. `shard` (i, n) runs every n-th case
    from the i-th (1 .. n) into that folder. `lost` collects cases whose process died.
    """

    jobs: int | None = None
    keep: Path | None = None
    shard: tuple[int, int] | None = None
    scheduler: str | None = None
    lost: list[str] = field(default_factory=list)


def spread(title: str, work: Work[Case, Result], cases: Sequence[Case], sweep: Sweep) -> Iterator[tuple[Case, Result]]:
    """Yield each case with `work(case, tick)`, in the order of `cases`, under a progress bar.

    A lost case is left out, reported on stderr and added to `sweep.lost`. A shard yields nothing: its results are kept,
    and the command ends (click.exceptions.Exit). Raises what `work` raises, ConfigError for a folder that cannot be
    written, ClickException for a cluster that cannot be used.
    """
    kept = None if sweep.keep is None else KeptResults(sweep.keep, work)
    first, step = (1, 1) if sweep.shard is None else sweep.shard
    mine = range(first - 1, len(cases), step)
    todo = {index: cases[index] for index in mine if kept is None or not kept.has(cases[index])}
    found: dict[int, Any] = {}
    due = collections.deque(mine)
    with progress(title, len(mine), threaded=False) as tick:
        tick(len(mine) - len(todo))
        for index, result in _run_all(work, todo, sweep, tick):
            if result is _LOST:
                _lose(cases[index], sweep)
            elif kept is not None:
                kept.put(cases[index], result)
            if sweep.shard is None:
                found[index] = result
                yield from _in_order(cases, due, found, todo, kept)
        if sweep.shard is None:
            yield from _in_order(cases, due, found, todo, kept)
    if sweep.shard is not None:
        say(
            f"shard {first}/{step}: {len(mine) - len(sweep.lost)} of {len(cases)} cases are in {sweep.keep};"
            " the same command without --shard runs what is missing and gives the results of all"
        )
        raise click.exceptions.Exit(1 if sweep.lost else 0)


def complete(title: str, work: Work[Case, Result], cases: Sequence[Case], sweep: Sweep) -> list[tuple[Case, Result]]:
    """All results of `spread`, for what makes no sense without one of them; raises ClickException for a lost case."""
    results = list(spread(title, work, cases, sweep))
    if sweep.lost:
        raise click.ClickException(f"{len(sweep.lost)} of {len(cases)} cases are lost: no result without them")
    return results


def _lose(case: object, sweep: Sweep) -> None:
    text = repr(case)
    text = text if len(text) <= _CASE_TEXT else text[: _CASE_TEXT - 3] + "..."
    sweep.lost.append(text)
    say(f"lost: {text}: its worker process died {TRIES} times; was the memory full? try fewer --jobs")


def _in_order(
    cases: Sequence[Case],
    due: collections.deque[int],
    found: dict[int, Any],
    todo: Mapping[int, Case],
    kept: KeptResults | None,
) -> Iterator[tuple[Case, Any]]:
    """The results that are next; those that were kept from an earlier run are read here."""
    while due and (due[0] in found or due[0] not in todo):
        index = due.popleft()
        result = found.pop(index) if kept is None or index in todo else kept.get(cases[index])
        if result is not _LOST:
            yield cases[index], result


def _run_all(work: Work[Case, Any], todo: Mapping[int, Case], sweep: Sweep, tick: Tick) -> Iterator[tuple[int, Any]]:
    jobs = min(sweep.jobs or os.cpu_count() or 1, len(todo))
    if sweep.scheduler is not None:
        yield from _on_cluster(sweep.scheduler, work, todo, tick)
    elif jobs <= 1:
        for index, case in todo.items():
            yield index, work(case, tick)
    else:
        yield from _in_processes(work, todo, jobs, tick)


class _Slot:
    """A worker process that runs one case at a time, and is replaced when it dies."""

    def __init__(self, context: SpawnContext) -> None:
        self._context = context
        self.finished = 0
        self.start()

    def start(self) -> None:
        self._counter: Synchronized[float] = self._context.Value("d", float(self.finished))
        self.pool = concurrent.futures.ProcessPoolExecutor(
            1, self._context, initializer=_start_worker, initargs=(self._counter,)
        )

    def submit(self, work: Work[Case, Result], case: Case) -> concurrent.futures.Future[Result]:
        with signals_held_back():
            return self.pool.submit(_run, work, case)

    @property
    def done(self) -> float:
        return self._counter.get_obj().value  # without its lock, which a process may hold as it dies


def _in_processes(work: Work[Case, Any], todo: Mapping[int, Case], jobs: int, tick: Tick) -> Iterator[tuple[int, Any]]:
    context = multiprocessing.get_context("spawn")
    slots = [_Slot(context) for _ in range(jobs)]
    idle, waiting, deaths = slots[::-1], collections.deque(todo), collections.Counter[int]()
    running: dict[concurrent.futures.Future[Any], tuple[_Slot, int]] = {}
    shown, whole = 0.0, False
    try:
        while waiting or running:
            while idle and waiting:
                slot, index = idle.pop(), waiting.popleft()
                running[slot.submit(work, todo[index])] = slot, index
            ended = concurrent.futures.wait(running, POLL_S, concurrent.futures.FIRST_COMPLETED).done
            done = sum(slot.done for slot in slots)
            tick(done - shown)
            shown = done
            for future in ended:
                slot, index = running.pop(future)
                idle.append(slot)
                try:
                    result = future.result()
                except BrokenProcessPool:
                    slot.pool.shutdown(wait=False)
                    deaths[index] += 1
                    if deaths[index] < TRIES:
                        waiting.appendleft(index)
                        slot.start()
                        continue
                    result = _LOST
                slot.finished += 1
                if result is _LOST:
                    slot.start()
                yield index, result
        whole = True
    finally:
        if not whole:
            for process in multiprocessing.active_children():
                process.kill()
        for slot in slots:
            slot.pool.shutdown(cancel_futures=True)


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


def _on_cluster(address: str, work: Work[Case, Any], todo: Mapping[int, Case], tick: Tick) -> Iterator[tuple[int, Any]]:
    need_extra("--scheduler", "distributed")
    import distributed

    try:
        client = distributed.Client(address, timeout=CONNECT_S)
    except (OSError, ValueError) as error:
        raise click.ClickException(f"--scheduler {address}: no Dask scheduler answers ({error})") from None
    with client:
        digest = code_digest()
        futures = {client.submit(_run_alone, work, case, digest, pure=False): index for index, case in todo.items()}
        for future in distributed.as_completed(futures):
            failure = future.exception()
            if failure is None:
                yield futures[future], future.result()
            elif isinstance(failure, distributed.KilledWorker):
                yield futures[future], _LOST
            else:
                raise failure
            tick(1.0)
            future.release()


def _run_alone(work: Work[Case, Result], case: Case, digest: str) -> Result:
    """A case in a worker of a cluster, which must have the same code."""
    if code_digest() != digest:
        raise click.ClickException(
            "--scheduler: a worker has another version of automodel; install the same everywhere"
        )
    import cv2

    with _alone:
        cv2.setNumThreads(1)
        return work(case, lambda share: None)
