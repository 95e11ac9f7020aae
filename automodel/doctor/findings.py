"""A finding: one line of the doctor's report.

Runs one measurement of the doctor: it ends in time, and what goes wrong in it is a finding.
"""

from __future__ import annotations

import enum
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TypeVar


class Verdict(enum.Enum):
    """How a check ended."""

    OK = "OK"
    WARN = "WARN"  # the car drives, but not as well as it could, or not as safely
    FAIL = "FAIL"  # the car does not drive
    SKIP = "SKIP"  # not looked at, or nothing to look at


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """`what` was found by the check `name`, and what to `do` about it; a WARN or a FAIL always says that."""

    name: str
    verdict: Verdict
    what: str
    do: str = ""

    def __post_init__(self) -> None:
        if self.verdict in (Verdict.WARN, Verdict.FAIL) and not self.do:
            raise ValueError(f"do: {self.name} says {self.verdict.value} and not what to do")


def okay(name: str, what: str) -> Finding:
    """All is well."""
    return Finding(name=name, verdict=Verdict.OK, what=what)


def warn(name: str, what: str, do: str) -> Finding:
    """The car drives, but."""
    return Finding(name=name, verdict=Verdict.WARN, what=what, do=do)


def fail(name: str, what: str, do: str) -> Finding:
    """The car does not drive."""
    return Finding(name=name, verdict=Verdict.FAIL, what=what, do=do)


def skip(name: str, what: str, do: str = "") -> Finding:
    """Nothing was looked at."""
    return Finding(name=name, verdict=Verdict.SKIP, what=what, do=do)


def failed(findings: Iterable[Finding]) -> bool:
    """Whether any of them says FAIL."""
    return any(finding.verdict is Verdict.FAIL for finding in findings)


def summary(findings: Iterable[Finding]) -> str:
    """`9 checks: 7 OK, 1 WARN, 1 SKIP`."""
    verdicts = [finding.verdict for finding in findings]
    counts = [f"{verdicts.count(verdict)} {verdict.value}" for verdict in Verdict if verdict in verdicts]
    return f"{len(verdicts)} checks: {', '.join(counts)}"


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
