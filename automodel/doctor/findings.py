"""A finding: one line of the doctor's report."""

from __future__ import annotations

import enum
from collections.abc import Iterable
from dataclasses import dataclass


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
