"""Work spread over processes: results in order, errors, and progress from inside a case."""

from __future__ import annotations

import functools
import io
import os
import signal
from pathlib import Path

import click
import pytest

from automodel.config import ConfigError
from automodel.console import workers
from automodel.console.progress import progress
from automodel.console.workers import Sweep, complete, spread
from tests.support.spread_work import die_if_negative, die_once, noted_root, root, slowly, whereabouts


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_come_in_order_and_errors_come_through(jobs: int) -> None:
    assert list(spread("roots", root, [9.0, 1.0, 4.0], Sweep(jobs=jobs))) == [(9.0, 3.0), (1.0, 1.0), (4.0, 2.0)]
    with pytest.raises(ValueError, match=r"math domain error|expected a nonnegative input"):
        list(spread("roots", root, [1.0, -1.0], Sweep(jobs=jobs)))


def test_no_cases_need_no_process() -> None:
    assert list(spread("nothing", root, [], Sweep(jobs=4))) == []


def test_a_worker_that_dies_costs_only_its_own_case(capsys: pytest.CaptureFixture[str]) -> None:
    sweep = Sweep(jobs=2)
    cases = [9.0, 1.0, -3.0, 4.0, 16.0, 25.0]
    assert list(spread("roots", die_if_negative, cases, sweep)) == [(case, case**0.5) for case in cases if case > 0]
    assert sweep.lost == ["-3.0"]
    assert "lost: -3.0: its worker process died 2 times" in capsys.readouterr().err
    with pytest.raises(click.ClickException, match="1 of 6 cases are lost") as caught:
        complete("roots", die_if_negative, cases, Sweep(jobs=2))
    assert caught.value.exit_code == 1


def test_a_worker_that_is_killed_once_loses_nothing(tmp_path: Path) -> None:
    sweep = Sweep(jobs=2)
    work = functools.partial(die_once, tmp_path)
    assert list(spread("roots", work, [9.0, 1.0, 4.0], sweep)) == [(9.0, 3.0), (1.0, 1.0), (4.0, 2.0)]
    assert not sweep.lost
    assert len(list(tmp_path.iterdir())) == 3  # each of the cases killed its process once


def test_finished_cases_are_kept_and_not_run_again(tmp_path: Path) -> None:
    log, keep = tmp_path / "log", tmp_path / "kept"
    work = functools.partial(noted_root, log)
    with pytest.raises(ValueError, match=r"math domain error|expected a nonnegative input"):
        list(spread("roots", work, [9.0, 4.0, -1.0], Sweep(jobs=1, keep=keep)))
    assert list(spread("roots", work, [9.0, 4.0, 1.0], Sweep(jobs=1, keep=keep))) == [
        (9.0, 3.0),
        (4.0, 2.0),
        (1.0, 1.0),
    ]
    assert log.read_text().split() == ["9.0", "4.0", "-1.0", "1.0"]
    for path in keep.iterdir():
        path.write_bytes(path.read_bytes()[:-2])  # cut by a power loss: run again
    assert list(spread("roots", work, [9.0], Sweep(jobs=1, keep=keep))) == [(9.0, 3.0)]
    assert log.read_text().split()[4:] == ["9.0"]
    for path in keep.iterdir():
        path.write_bytes(path.read_bytes()[:40] + b"\x95" + b"\xff" * 8 + path.read_bytes()[49:])  # an endless frame
    assert list(spread("roots", work, [9.0], Sweep(jobs=1, keep=keep))) == [(9.0, 3.0)]
    other = functools.partial(noted_root, tmp_path / "other")  # other arguments: other results
    assert list(spread("roots", other, [4.0], Sweep(jobs=1, keep=keep))) == [(4.0, 2.0)]
    assert (tmp_path / "other").read_text().split() == ["4.0"]


def test_shards_are_put_together_by_the_same_command_without_one(tmp_path: Path, capsys) -> None:
    log, cases = tmp_path / "log", [float(number) for number in range(7)]
    work = functools.partial(noted_root, log)
    for shard in ((2, 3), (1, 3), (3, 3)):
        with pytest.raises(click.exceptions.Exit) as ended:
            list(spread("roots", work, cases, Sweep(jobs=1, keep=tmp_path / "kept", shard=shard)))
        assert ended.value.exit_code == 0
    assert "shard 3/3: 2 of 7 cases are in" in capsys.readouterr().err
    assert sorted(log.read_text().split()) == sorted(map(str, cases))
    whole = list(spread("roots", work, cases, Sweep(jobs=2, keep=tmp_path / "kept")))
    assert whole == list(spread("roots", root, cases, Sweep(jobs=1)))
    assert len(log.read_text().split()) == len(cases)


def test_a_case_without_a_value_of_its_own_cannot_be_kept(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no value of its own"):
        list(spread("objects", lambda case, tick: 1.0, [object()], Sweep(jobs=1, keep=tmp_path)))


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"--keep .*file"):
        list(spread("roots", root, [1.0], Sweep(jobs=1, keep=tmp_path / "file")))


def test_a_cluster_gives_the_same_and_a_killed_worker_loses_nothing(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    cases = [float(number) for number in range(40)]
    work = functools.partial(whereabouts, tmp_path)
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        found, killed = [], None
        for case, result in spread("roots", work, cases, Sweep(scheduler=cluster.scheduler_address)):
            found.append((case, result))
            if killed is None and len(found) == 4:
                killed = int(next(iter(tmp_path.iterdir())).name)
                os.kill(killed, signal.SIGKILL)
    assert found == list(spread("roots", root, cases, Sweep(jobs=1)))
    assert len(list(tmp_path.iterdir())) >= 2


def test_a_scheduler_that_is_not_there_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(workers, "CONNECT_S", 0.2)
    with pytest.raises(click.ClickException, match="no Dask scheduler answers"):
        list(spread("roots", root, [1.0], Sweep(scheduler="tcp://127.0.0.1:9")))


@pytest.mark.parametrize("jobs", [1, 2])
def test_progress_moves_inside_a_case(jobs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[float] = []

    class Bar:
        def __enter__(self):
            return seen.append

        def __exit__(self, *_: object) -> None:
            pass

    monkeypatch.setattr(workers, "progress", lambda title, total, threaded: Bar())
    assert list(spread("work", slowly, [20, 20], Sweep(jobs=jobs))) == [(20, 20), (20, 20)]
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
