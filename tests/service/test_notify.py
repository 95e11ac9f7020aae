from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from automodel.runtime.run_types import TickRecord
from automodel.runtime.safety import Action, SafetyDecision, SafetyMode
from automodel.service.notify import Notifier, ServiceViewer, process_age_s
from automodel.signals import Frame, VehicleState

WAIT_S = 60.0  # far beyond what any step takes
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="systemd is of Linux")


class Systemd:
    """Systemd's end of the socket."""

    def __init__(self, address: str) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind("\0" + address[1:] if address.startswith("@") else address)
        self.address = address

    def heard(self, wait_s: float = 0.0) -> dict[str, str] | None:
        """The next datagram's variables, None where none comes in time."""
        self._socket.settimeout(wait_s or 1e-9)
        try:
            return dict(line.split("=", 1) for line in self._socket.recv(4096).decode().splitlines())
        except (BlockingIOError, TimeoutError):
            return None

    def all_heard(self) -> list[dict[str, str]]:
        return list(iter(self.heard, None))

    def close(self) -> None:
        self._socket.close()


@pytest.fixture(params=["path", "abstract"])
def systemd(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Systemd]:
    made = Systemd(f"{tmp_path}/notify" if request.param == "path" else f"@automodel-test-{os.getpid()}")
    yield made
    made.close()


def record(frame: bool = True, state: bool = True, mode: SafetyMode = SafetyMode.DISARMED) -> TickRecord:
    decision = SafetyDecision(
        mode=mode, action=Action.NEUTRAL, arm=False, disarm=False, reason="the lane\nis lost", events=()
    )
    return TickRecord(
        t_ns=1,
        frame=Frame(t_ns=1, index=1, image=np.zeros((4, 4), np.uint8)) if frame else None,
        state=VehicleState(t_ns=1) if state else None,
        tick=None,
        decision=decision,
        sent=None,
        latency_ns=None,
    )


def test_ready_comes_once_when_a_frame_and_the_vehicle_are_there(systemd: Systemd) -> None:
    environment = {"NOTIFY_SOCKET": systemd.address, "WATCHDOG_USEC": "20000000"}
    with ServiceViewer(Notifier(environment)) as viewer:
        viewer.on_tick(record(state=False))
        viewer.on_tick(record(frame=False))
        assert systemd.all_heard() == [{"WATCHDOG": "1"}]  # alive, and not ready
        viewer.on_tick(record())
        (told,) = systemd.all_heard()
        assert told["READY"] == "1"
        assert told["STATUS"].endswith("s after the process began")
        viewer.on_tick(record())
        assert systemd.all_heard() == []
    assert systemd.all_heard() == [{"STOPPING": "1"}]
    assert environment == {}  # no child speaks in our name


def test_signs_of_life_come_at_a_quarter_of_the_time_and_only_with_the_loops_cycles(
    systemd: Systemd, monkeypatch
) -> None:
    now_ns = [10**12]
    monkeypatch.setattr(time, "monotonic_ns", lambda: now_ns[0])
    notifier = Notifier({"NOTIFY_SOCKET": systemd.address, "WATCHDOG_USEC": "4000000"})
    viewer, alive = ServiceViewer(notifier), 0
    for _ in range(250):  # 5 s of cycles
        now_ns[0] += 20_000_000
        viewer.on_tick(record())
        alive += sum("WATCHDOG" in heard for heard in systemd.all_heard())
    assert alive == 5
    now_ns[0] += 100_000_000_000  # a loop that hangs
    assert systemd.all_heard() == []
    notifier.close()


def test_the_status_says_what_the_run_does_in_one_line(systemd: Systemd, monkeypatch) -> None:
    now_ns = [10**12]
    monkeypatch.setattr(time, "monotonic_ns", lambda: now_ns[0])
    notifier = Notifier({"NOTIFY_SOCKET": systemd.address})
    viewer = ServiceViewer(notifier)
    viewer.on_tick(record())
    now_ns[0] += 2_000_000_000
    for _ in range(3):
        viewer.on_tick(record(mode=SafetyMode.HOLD))
    texts = [heard["STATUS"] for heard in systemd.all_heard() if "STATUS" in heard]
    assert texts[1:] == ["HOLD: the lane is lost"]
    notifier.close()


@pytest.mark.parametrize("environment", [{}, {"NOTIFY_SOCKET": ""}, {"NOTIFY_SOCKET": "vsock:2:1"}])
def test_without_systemd_nothing_is_sent(environment: dict[str, str]) -> None:
    notifier = Notifier(environment)
    assert not notifier.heard
    notifier.send(READY="1")
    notifier.close()


def test_a_socket_that_is_gone_or_full_stops_nobody(tmp_path: Path) -> None:
    systemd = Systemd(str(tmp_path / "notify"))
    notifier = Notifier({"NOTIFY_SOCKET": systemd.address})
    for _ in range(10_000):  # nobody reads: far more than a socket takes
        notifier.send(WATCHDOG="1")
    systemd.close()
    notifier.send(READY="1")
    notifier.close()
    notifier.close()


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({"WATCHDOG_USEC": "20000000"}, 20_000_000_000),
        ({"WATCHDOG_USEC": "20000000", "WATCHDOG_PID": str(os.getpid())}, 20_000_000_000),
        ({"WATCHDOG_USEC": "20000000", "WATCHDOG_PID": "1"}, None),  # another process's
        ({"WATCHDOG_USEC": "soon"}, None),
        ({}, None),
    ],
)
def test_whose_watchdog_it_is(environment: dict[str, str], expected: int | None) -> None:
    assert Notifier(environment).watchdog_ns == expected


def test_the_age_of_a_process_is_that_of_the_kernel() -> None:
    begun = time.clock_gettime(time.CLOCK_BOOTTIME)
    code = "from automodel.service.notify import process_age_s; print(process_age_s())"
    age_s = float(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)
    assert 0.0 <= age_s <= time.clock_gettime(time.CLOCK_BOOTTIME) - begun + 0.02  # a tick of the kernel's


@pytest.mark.slow
@pytest.mark.realtime
def test_a_run_tells_systemd(tmp_path: Path) -> None:
    systemd = Systemd(str(tmp_path / "notify"))
    environment = {**os.environ, "NOTIFY_SOCKET": systemd.address, "WATCHDOG_USEC": "400000"}
    command = [sys.executable, "-m", "automodel", "run", "--realtime", "--track", "oval", "--pipeline", "windows"]
    with subprocess.Popen([*command, "--duration", "8"], env=environment, stderr=subprocess.DEVNULL) as run:
        heard: list[dict[str, str]] = []
        while not (heard and "STOPPING" in heard[-1]):
            told = systemd.heard(WAIT_S)
            assert told is not None
            heard.append(told)
    ready = [told for told in heard if "READY" in told]
    assert len(ready) == 1
    assert sum("WATCHDOG" in told for told in heard) > 3
    assert {told["STATUS"].split(":")[0] for told in heard if "STATUS" in told} - {ready[0]["STATUS"]} <= {
        mode.value for mode in SafetyMode
    }
    assert process_age_s() is not None
    assert run.returncode in (0, 1)
    systemd.close()
