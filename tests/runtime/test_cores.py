from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator

import pytest

from automodel.runtime import cores
from automodel.runtime.cores import CorePlan, LoopCores, plan_cores

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only Linux has it")
SEVERAL = pytest.mark.skipif(cores.usable_cores() < 2, reason="there is one core only")


@pytest.mark.parametrize(
    ("usable", "plan"),
    [
        ({3}, None),
        ({0, 1}, CorePlan(loop=frozenset({1}), capture=frozenset({0}), others=frozenset({0}))),
        ({2, 4, 7}, CorePlan(loop=frozenset({7}), capture=frozenset({4}), others=frozenset({2}))),
        ({0, 1, 2, 3}, CorePlan(loop=frozenset({3}), capture=frozenset({2}), others=frozenset({0, 1}))),
    ],
)
def test_the_loop_has_a_core_and_the_camera_one_of_three(usable: set[int], plan: CorePlan | None) -> None:
    assert plan_cores(usable) == plan


class Named:
    """A thread as the camera's or the recorder's."""

    def __init__(self, name: str) -> None:
        self._over = threading.Event()
        self.thread = threading.Thread(target=self._over.wait, name=name, daemon=True)
        self.thread.start()

    @property
    def id(self) -> int:
        assert self.thread.native_id is not None
        return self.thread.native_id

    def close(self) -> None:
        self._over.set()
        self.thread.join()


@pytest.fixture
def named() -> Iterator[dict[str, Named]]:
    threads = {name: Named(name) for name in ("capture", "recorder", "other")}
    yield threads
    for thread in threads.values():
        thread.close()


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> dict[int, int]:
    """The niceness that was asked for, by thread; the system grants it without giving it."""
    found: dict[int, int] = {}
    monkeypatch.setattr(os, "setpriority", lambda _, thread, nice: found.update({thread: nice}))
    return found


def child_cores() -> set[int]:
    said = subprocess.run(
        [sys.executable, "-c", "import os; print(*os.sched_getaffinity(0))"], capture_output=True, text=True, check=True
    )
    return {int(core) for core in said.stdout.split()}


@SEVERAL
def test_what_is_started_stays_off_the_loops_core(asked: dict[int, int], named: dict[str, Named]) -> None:
    before, nice = os.sched_getaffinity(0), os.getpriority(os.PRIO_PROCESS, 0)
    me, plan = threading.get_native_id(), plan_cores(before)
    assert plan is not None
    with LoopCores() as loop:
        assert child_cores() == plan.others
        loop.claim()
        assert os.sched_getaffinity(0) == before
        assert os.sched_getaffinity(named["capture"].id) == plan.capture
        assert os.sched_getaffinity(named["recorder"].id) == plan.others
        assert os.sched_getaffinity(named["other"].id) == before  # it is none of ours
        assert asked == dict.fromkeys((me, named["capture"].id, named["recorder"].id), cores.NICE)
        with loop.elsewhere():
            assert child_cores() == plan.others
            assert asked[me] == nice  # what is started would inherit it
            late = Named("capture")
        assert os.sched_getaffinity(0) == before
        assert os.sched_getaffinity(late.id) == plan.capture
        assert (asked[me], asked[late.id]) == (cores.NICE, cores.NICE)
        late.close()
    assert os.sched_getaffinity(0) == before
    assert asked[me] == nice


@SEVERAL
def test_what_the_system_does_not_allow_is_left_out(monkeypatch: pytest.MonkeyPatch, named: dict[str, Named]) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "setpriority", refuse)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr("resource.getrlimit", lambda _: (8 << 20, 8 << 20))
    before = os.sched_getaffinity(0)
    waits = "the loop waits for other processes (no niceness of -15)"
    assert cores.denied() == (waits, "memory may be swapped out (no mlockall)")
    with LoopCores() as loop:
        loop.claim()
        assert os.sched_getaffinity(named["recorder"].id) == before - {max(before)}
    assert os.sched_getaffinity(0) == before


def test_on_a_single_core_nothing_is_changed(monkeypatch: pytest.MonkeyPatch, asked: dict[int, int]) -> None:
    only = {min(os.sched_getaffinity(0))}
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: only)
    monkeypatch.setattr(os, "sched_setaffinity", lambda *_: pytest.fail("it was moved"))
    with LoopCores() as loop:
        loop.claim()
        with loop.elsewhere():
            pass
    assert asked == {}


_HEAP = """
import ctypes
import threading
import numpy as np
from automodel.runtime.cores import LoopCores

def resident_kb():
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) for line in status if line.startswith("RssAnon"))

with LoopCores() as loop:
    loop.claim()
    ctypes.CDLL(None).malloc_trim(0)  # as a library may
    before_kb = resident_kb()
    waiting = []
    camera = threading.Thread(target=lambda: waiting.extend(np.ones(100_000, np.uint8) for _ in range(100)))
    camera.start()
    camera.join()
    print(resident_kb() - before_kb, sum(image.nbytes for image in waiting) // 1024)
"""


@SEVERAL
@pytest.mark.skipif(not cores._may_lock_memory(), reason="the system does not let memory be locked")
def test_memory_is_in_hand_for_a_cameras_images_that_wait() -> None:
    said = subprocess.run([sys.executable, "-c", _HEAP], capture_output=True, text=True, check=True)
    more_kb, waiting_kb = map(int, said.stdout.split())
    assert more_kb < 0.1 * waiting_kb
