"""Runs one measurement of the doctor: it ends in time, and what goes wrong in it is a finding."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TypeVar

from automodel.doctor.findings import Finding, fail

T = TypeVar("T")


def bounded(name: str, work: Callable[[], T], timeout_s: float, do: str) -> T | Finding:
    """What `work` gives, or a FAIL under `name` that says why there is nothing, and what to `do`.

    An OSError, ValueError or ImportError is told in one line: ours say what, and after a semicolon what to do. A work
    that hangs is left behind in its thread, which does not keep the program from ending. Anything else that it raises
    is an error of this program: Python writes its traceback to stderr, and the other checks go on.
    """
    values: list[T] = []
    errors: list[Exception] = []

    def run() -> None:
        try:
            values.append(work())
        except (OSError, ValueError, ImportError) as error:
            errors.append(error)

    thread = threading.Thread(target=run, name=name, daemon=True)
    thread.start()
    thread.join(timeout_s)
    if values:
        return values[0]
    if errors:
        what, _, own = (" ".join(str(errors[0]).split()) or type(errors[0]).__name__).partition("; ")
        return fail(name, what, f"{own}; {do}" if own else do)
    if thread.is_alive():
        return fail(name, f"no answer within {timeout_s:g} s", do)
    return fail(name, "the check itself broke off", "report it, with the traceback on stderr")
