from __future__ import annotations

import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from automodel.runtime import os_signals
from automodel.runtime.os_signals import stop_on_signals
from tests.support.slow_lane import rest_slow

pytestmark = pytest.mark.realtime
ROOT = Path(__file__).resolve().parents[2]


def run_child(tmp_path: Path, what: str, first: signal.Signals, second: signal.Signals | None) -> tuple[str, list[str]]:
    """The child's last line and the log from the signal on; `second` is sent while the recording is being closed."""
    log = tmp_path / "log"
    with subprocess.Popen(
        [sys.executable, "-m", "tests.support.runner_child", str(log), what],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as child:
        assert child.stdout is not None
        assert child.stdout.readline().strip() == ("waiting" if what == "silence" else "driving")
        child.send_signal(first)
        assert child.stdout.readline().strip() == "closing"
        if second is not None:
            child.send_signal(second)
            child.send_signal(second)
        out, err = child.communicate(timeout=60)
    assert err == ""
    assert child.returncode == 0
    return out.strip(), [line.split(" ", 1)[1].strip() for line in log.read_text().splitlines()]


@pytest.mark.parametrize("what", ["frames", "silence"])
@pytest.mark.parametrize("name", rest_slow(("SIGINT", "SIGTERM", "SIGHUP"), "SIGINT"))
def test_a_signal_ends_in_neutral_and_a_closed_recording(tmp_path: Path, what: str, name: str) -> None:
    out, log = run_child(tmp_path, what, signal.Signals[name], None)
    assert out == f"SIGNAL {name} True []"
    assert log[-5:] == ["send 0.0", "disarm", "close", "closing the recording", "recording closed"]
    speeds = [float(line.split()[1]) for line in log if line.startswith("send")]
    assert (max(speeds) > 0.0) is (what == "frames")


def test_a_second_signal_does_not_break_the_clean_up(tmp_path: Path) -> None:
    out, log = run_child(tmp_path, "frames", signal.SIGINT, signal.SIGINT)
    assert out == "SIGNAL SIGINT True []"
    assert log[-1] == "recording closed"


def test_the_flag_and_the_former_handlers() -> None:
    former = signal.getsignal(signal.SIGTERM)
    with stop_on_signals() as signalled:
        assert signalled() is None
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGINT)
        assert signalled() == "SIGTERM"
    assert signal.getsignal(signal.SIGTERM) is former


def test_a_signal_that_was_swallowed_before_the_run_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """As by an import that catches everything."""
    monkeypatch.setattr(os_signals, "_come", [])
    with pytest.raises(KeyboardInterrupt):
        os_signals.interrupt(signal.SIGTERM, None)
    with pytest.raises(os_signals.Interrupted):
        os_signals.raise_if_interrupted()
    with stop_on_signals() as signalled:
        assert signalled() == "SIGTERM"


def test_outside_the_main_thread_nothing_is_installed() -> None:
    seen: list[object] = []

    def work() -> None:
        with stop_on_signals() as signalled:
            seen.extend((signalled(), signal.getsignal(signal.SIGTERM)))

    former = signal.getsignal(signal.SIGTERM)
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [None, former]
