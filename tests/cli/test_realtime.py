"""The simulated car against the real clock: other processes, shared memory, a pseudo terminal."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from automodel.recording.reader import Recording
from automodel.signals import Command, Event, Frame
from tests.support.free_cores import Retries
from tests.support.slow_lane import rest_slow
from tests.support.terminal_signals import signals_of_a_terminal

pytestmark = pytest.mark.realtime
TRIES = 5  # a machine that does something else for a third of a second stops the car, rightly
LATE = (
    "the newest frame is ",
    "overloaded: ",
    "no frame",
    "the loop stood still for ",
    "the command went stale in the loop",
    "the vehicle has disarmed itself",
    "the vehicle has said nothing for ",
)
LATE_LINE = r": (hold|stop|disarmed|vehicle-fault|fault: offset uncertain): "  # the last: frames that come after a gap


def environment(tmp_path: Path) -> dict[str, str]:
    """Temporary files go where they can be counted."""
    (tmp_path / "tmp").mkdir(exist_ok=True)
    return {**os.environ, "TMPDIR": str(tmp_path / "tmp")}


def start(tmp_path: Path, *arguments: str) -> subprocess.Popen[str]:
    """A run in a session of its own, as a terminal starts it; SIGINT is not ignored as it is in background jobs."""
    run = ["run", "--realtime", "--track", "oval", "--pipeline", "windows", *arguments]
    with signals_of_a_terminal():
        return subprocess.Popen(
            [sys.executable, "-m", "automodel", *run],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment(tmp_path),
            start_new_session=True,
        )


def session(leader: int) -> list[str]:
    """The processes of a session that still run."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            fields = (entry / "stat").read_text().rsplit(")", 1)[1].split()
        except (OSError, IndexError):
            continue
        if entry.name.isdigit() and int(fields[3]) == leader and fields[0] != "Z":
            found.append((entry / "cmdline").read_text().replace("\0", " "))
    return found


def left_behind(tmp_path: Path, leader: int) -> tuple[list[str], list[str]]:
    """Processes and temporary files; a child may need a moment to see that its parent is gone."""
    for _ in range(100):
        processes, files = session(leader), [path.name for path in (tmp_path / "tmp").rglob("*")]
        if not processes and not files:
            break
        time.sleep(0.05)
    return processes, files


def reasons(err: str) -> list[str]:
    """Why the car was held or stopped."""
    held = r"(?:held (?:for [0-9.]+ s|[0-9]+ times within 10 s, and again): )?"
    found = (re.search(f": (?:hold|stop): {held}(.*)", line) for line in err.splitlines())
    return [match[1] for match in found if match]


@pytest.mark.parametrize("pipeline", rest_slow(("windows", "centerline"), "windows"))
def test_three_seconds_without_a_stop(pipeline: str, cli) -> None:
    """A machine that is too busy for it may be late, and nothing else: no lane is lost by that."""
    retries = Retries()
    for _ in range(TRIES):
        arguments = ("--realtime", "--track", "oval", "--pipeline", pipeline, "--duration", "3", "--json")
        said = cli("run", *arguments)
        (row,) = said.rows
        assert all(reason.startswith(LATE) for reason in reasons(said.err)), said.err
        drove = row["max_abs_offset_m"] is not None
        if drove and not row["stops"]:
            break
        retries.failed(said.err)
    else:
        pytest.skip("the machine is too busy to drive in real time")
    assert (said.code, row["left_lane"]) == (0, 0), said.err
    assert row["max_abs_offset_m"] <= 0.10
    assert 0 < row["latency_p50_ms"] <= row["latency_p99_ms"]


@pytest.mark.slow
@pytest.mark.parametrize("whole_group", [True, False], ids=["terminal", "kill"])
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_signal_while_driving(name: str, whole_group: bool, tmp_path: Path) -> None:
    """Ctrl-C and a closed terminal reach the whole group, `kill` one process."""
    record, number = tmp_path / "run.mcap", signal.Signals[name]
    retries = Retries()
    for _ in range(TRIES):
        with start(tmp_path, "--duration", "60", "--record", str(record), "--json") as child:  # 3 MB a second
            deadline = time.monotonic() + 60
            while child.poll() is None and time.monotonic() < deadline:
                if record.exists() and record.stat().st_size > 6_000_000:
                    break
                time.sleep(0.05)
            (os.killpg if whole_group else os.kill)(child.pid, number)
            out, err = child.communicate(timeout=60)
        if "the car has stood for" not in err:  # held or stopped too often to get anywhere
            break
        retries.failed(err)
        record.unlink()
    else:
        pytest.skip("the machine is too busy to drive in real time")
    (row,) = json.loads(out)["rows"]
    assert child.returncode == int(bool(row["stops"] or row["left_lane"])), err
    late = [line for line in err.splitlines() if re.search(LATE_LINE, line)]
    lines = [line for line in err.splitlines() if line not in late]
    assert lines[0].startswith(f"{record}: ")
    assert lines[1].startswith(f"stopped by {name}")  # and by what else, on a busy machine
    assert len(lines) == 2
    values = [message.value for message in Recording(record)]  # closed, and readable to its end
    assert sum(isinstance(value, Frame) for value in values) > 10
    drove = max(value.speed_mps for value in values if isinstance(value, Command)) > 0.0
    assert drove or late  # on a busy machine it may not come to that
    assert [value.text for value in values if isinstance(value, Event)][-1] == name
    assert left_behind(tmp_path, child.pid) == ([], [])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
@pytest.mark.parametrize("after_s", [0.25, 0.45, 0.7, 1.0])
def test_a_signal_while_starting(name: str, after_s: float, tmp_path: Path) -> None:
    """Wherever it strikes, imports or a child's birth: at most one line for each of two reasons, and nothing stays."""
    with start(tmp_path, "--duration", "60") as child:
        time.sleep(after_s)
        os.killpg(child.pid, signal.Signals[name])
        _, err = child.communicate(timeout=60)
    assert child.returncode in (0, 1), err
    said = [line for line in err.splitlines() if line and not re.search(LATE_LINE, line)]
    assert said in (["automodel: interrupted"], [f"stopped by {name}"])
    assert left_behind(tmp_path, child.pid) == ([], [])


@pytest.mark.slow
def test_a_run_that_is_killed_leaves_no_process(tmp_path: Path) -> None:
    """SIGKILL cannot be caught: the simulated world's process has to notice by itself."""
    record = tmp_path / "run.mcap"
    with start(tmp_path, "--duration", "60", "--record", str(record)) as child:
        deadline = time.monotonic() + 60
        while not (record.exists() and record.stat().st_size > 6_000_000) and time.monotonic() < deadline:
            time.sleep(0.05)
        child.kill()
        child.communicate(timeout=60)
    assert left_behind(tmp_path, child.pid) == ([], [])
