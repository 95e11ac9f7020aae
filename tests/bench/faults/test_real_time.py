"""`bench faults --real-time`: its judge on constructed servo frames, and some runs by the real clock."""

from __future__ import annotations

import errno
from dataclasses import replace
from random import Random
from types import SimpleNamespace

import pytest

from automodel.bench.faults import real_time
from automodel.bench.faults.fault import Must
from automodel.bench.faults.real_catalogue import REAL_FAULTS, RealFault
from automodel.bench.faults.real_time import TRIES, RealVerdict, judge_real, run_real
from automodel.cli.main import run
from tests.support.command_line import Cli, cli

__all__ = ["cli"]

MS = 1_000_000
BY_NAME = {fault.name: fault for fault in REAL_FAULTS}
KILLED, CLOCK, OVERLOAD = BY_NAME["real-killed"], BY_NAME["real-clock"], BY_NAME["real-overload"]


def frames(*rests_ms: tuple[float, float], until_ms: int = 2000) -> list[tuple[int, bool]]:
    """Servo frames of a motor that turns but for the spans (from, to)."""
    return [(t * MS, not any(a <= t < b for a, b in rests_ms)) for t in range(0, until_ms, 20)]


def test_a_stop_counts_from_the_fault_to_the_first_neutral_that_stays() -> None:
    verdict = judge_real(KILLED, 1005 * MS, frames((1140, 9999)), [])
    assert verdict.violations == ()
    assert verdict.reaction_s == pytest.approx(0.135)
    late = judge_real(KILLED, 1005 * MS, frames((1160, 9999)), [])
    assert late.violations == ("neutral after 155 ms",)
    again = judge_real(KILLED, 1005 * MS, frames((1140, 1500), (1600, 9999)), [])
    assert again.violations == ("neutral after 595 ms",)  # it drove off by itself
    assert judge_real(KILLED, 1005 * MS, frames(), []).violations == ("the motor's pin never went neutral",)


def test_a_car_that_must_drive_on_may_not_be_neutral_once() -> None:
    assert judge_real(CLOCK, 1005 * MS, frames((0, 1000)), []).violations == ()
    assert judge_real(CLOCK, 1005 * MS, frames((1400, 1420)), []).violations == ("neutral 0.40 s after the fault",)


def test_an_overloaded_car_may_stop_but_never_drive_on_what_is_old() -> None:
    commands = [t * MS for t in range(0, 1310, 10)]
    good = judge_real(OVERLOAD, 1005 * MS, frames((1420, 1500)), [t for t in commands if t < 1300 * MS])
    assert good.violations == ()
    assert good.reaction_s == pytest.approx(0.13)
    assert judge_real(OVERLOAD, 1005 * MS, frames(), commands) == RealVerdict(violations=(), reaction_s=None)
    (text,) = judge_real(OVERLOAD, 1005 * MS, frames((1460, 1500)), commands).violations
    assert text == "neutral after 160 ms"


def test_a_run_in_which_the_board_was_held_up_is_repeated_and_at_last_says_nothing(
    cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers: list[RealVerdict | None] = [None, RealVerdict(violations=("late",), reaction_s=0.2)]

    class NoCar:
        def __init__(self, *_: object) -> None: ...
        def __enter__(self) -> NoCar:
            return self

        def __exit__(self, *_: object) -> None: ...

    monkeypatch.setattr(real_time, "RealCar", NoCar)
    monkeypatch.setattr(real_time, "_observed", lambda *_: answers.pop(0))
    assert run_real(KILLED, "windows", 0, 0) == RealVerdict(violations=("late",), reaction_s=0.2, disturbed=1)
    monkeypatch.setattr(real_time, "_observed", lambda *_: None)
    said = cli("bench", "faults", "--real-time", "--only", "real-killed", "--runs", "2", "--json")
    assert said.code == 0
    assert said.err.startswith(f"2 runs say nothing: the machine held the board up {TRIES} times")
    assert (said.rows[0]["runs"], said.rows[0]["disturbed"]) == (0, 2 * TRIES)


@pytest.mark.parametrize(
    ("ended", "violations", "disturbed"), [(True, ("it ended before it drove: no",), 0), (False, (), TRIES)]
)
def test_a_car_that_never_drives_says_nothing_unless_its_program_has_ended(
    ended: bool, violations: tuple[str, ...], disturbed: int
) -> None:
    car = SimpleNamespace(drive=lambda: False, ended=ended, said="no")
    verdict = real_time._observed(KILLED, car, Random(1))  # type: ignore[arg-type]
    assert verdict == RealVerdict(violations=violations, reaction_s=None, disturbed=disturbed)


def test_the_list_of_the_real_faults(cli: Cli) -> None:
    rows = cli("bench", "faults", "--real-time", "--list", "--json").rows
    assert [row["fault"] for row in rows] == [fault.name for fault in REAL_FAULTS]
    assert {row["within_ms"] for row in rows} == {150.0, None}


def test_what_cannot_be_written_to_a_closed_terminal_is_no_wrong_argument(monkeypatch: pytest.MonkeyPatch) -> None:
    def closed(*_: object, **__: object) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr("automodel.cli.bench.show", closed)
    assert run(["bench", "faults", "--list"]) == 1


@pytest.mark.realtime
@pytest.mark.slow
@pytest.mark.timeout(240)
@pytest.mark.parametrize("name", ["real-killed", "real-terminal", "real-clock", "real-disk-full"])
def test_a_run_by_the_real_clock(name: str) -> None:
    verdict = run_real(BY_NAME[name], "windows", 1, 0)
    if verdict.disturbed == TRIES:
        pytest.skip("the machine is busy with other work")
    assert verdict.violations == ()
    assert (verdict.reaction_s is None) == (BY_NAME[name].must is Must.NOTHING)


@pytest.mark.realtime
@pytest.mark.slow
@pytest.mark.timeout(240)
def test_a_program_that_does_not_stop_is_found_out() -> None:
    harmless = replace(KILLED, strike=lambda car, random: None)
    assert isinstance(harmless, RealFault)
    verdict = run_real(harmless, "windows", 1, 0)
    if verdict.disturbed == TRIES:
        pytest.skip("the machine is busy with other work")
    assert verdict.violations[0].startswith("the motor's pin never went neutral")
