"""A finding is one line of the doctor's report; a check that hangs or fails becomes one, too."""

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
    SKIP = "SKIP"  # not checked, or nothing to check


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """`what` the check `name` found, and what to `do` about it; raises ValueError for a WARN or FAIL without `do`."""

    name: str
    verdict: Verdict
    what: str
    do: str = ""

    def __post_init__(self) -> None:
        if self.verdict in (Verdict.WARN, Verdict.FAIL) and not self.do:
            raise ValueError(f"do: {self.name} says {self.verdict.value}, but not what to do")


def okay(name: str, what: str) -> Finding:
    """The check passed."""
    return Finding(name=name, verdict=Verdict.OK, what=what)


def warn(name: str, what: str, do: str) -> Finding:
    """The car drives, with a restriction."""
    return Finding(name=name, verdict=Verdict.WARN, what=what, do=do)


def fail(name: str, what: str, do: str) -> Finding:
    """The car does not drive."""
    return Finding(name=name, verdict=Verdict.FAIL, what=what, do=do)


def skip(name: str, what: str, do: str = "") -> Finding:
    """Nothing was checked."""
    return Finding(name=name, verdict=Verdict.SKIP, what=what, do=do)


def failed(findings: Iterable[Finding]) -> bool:
    """Whether any finding says FAIL."""
    return any(finding.verdict is Verdict.FAIL for finding in findings)


def summary(findings: Iterable[Finding]) -> str:
    """`9 checks: 7 OK, 1 WARN, 1 SKIP`."""
    verdicts = [finding.verdict for finding in findings]
    counts = [f"{verdicts.count(verdict)} {verdict.value}" for verdict in Verdict if verdict in verdicts]
    return f"{len(verdicts)} checks: {', '.join(counts)}"


T = TypeVar("T")


def bounded(name: str, work: Callable[[], T], timeout_s: float, do: str) -> T | Finding:
    """The result of `work`, or a FAIL under `name` with the reason and what to `do`.

    The text of an OSError, ValueError or ImportError is reported in one line; ours say after a semicolon what to do.
    Work that hangs is left in its daemon thread, which does not keep the program from ending. Any other exception is an
    error of this program: Python writes its traceback to stderr, and the other checks go on.
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
        return fail(name, what, f"{own}{' ' if own.endswith('?') else '; '}{do}" if own else do)
    if thread.is_alive():
        return fail(name, f"no answer within {timeout_s:g} s", do)
    return fail(name, "the check itself failed", "report it, with the traceback on stderr")
