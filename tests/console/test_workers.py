"""Work spread over processes: results in order, errors, and progress from inside a case."""

from __future__ import annotations

import io

import click
import pytest

from automodel.console import workers
from automodel.console.progress import progress
from automodel.console.workers import spread
from tests.support.spread_work import die, root, slowly


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_come_in_order_and_errors_come_through(jobs: int) -> None:
    assert list(spread("roots", root, [9.0, 1.0, 4.0], jobs)) == [3.0, 1.0, 2.0]
    with pytest.raises(ValueError, match=r"math domain error|expected a nonnegative input"):
        list(spread("roots", root, [1.0, -1.0], jobs))


def test_no_cases_need_no_process() -> None:
    assert list(spread("nothing", root, [], 4)) == []


def test_a_worker_that_dies_is_one_line() -> None:
    with pytest.raises(click.ClickException, match="a worker process died") as caught:
        list(spread("dying", die, [3, 3], 2))
    assert caught.value.exit_code == 1


@pytest.mark.parametrize("jobs", [1, 2])
def test_progress_moves_inside_a_case(jobs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[float] = []

    class Bar:
        def __enter__(self):
            return seen.append

        def __exit__(self, *_: object) -> None:
            pass

    monkeypatch.setattr(workers, "progress", lambda title, total, threaded: Bar())
    assert list(spread("work", slowly, [20, 20], jobs)) == [20, 20]
    assert len([share for share in seen if 0.0 < share < 1.0]) >= 3
    assert 1.0 < sum(seen) <= 2.0 + 1e-9


@pytest.mark.parametrize("threaded", [True, False])
def test_a_bar_on_a_terminal(threaded: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    with progress("driving", 4, threaded) as tick:
        tick()
        tick(0.5)
        tick(2.5)
    assert "driving" in terminal.getvalue()


def test_no_bar_elsewhere(capsys: pytest.CaptureFixture[str]) -> None:
    with progress("driving", 4) as tick:
        tick()
    assert capsys.readouterr() == ("", "")
