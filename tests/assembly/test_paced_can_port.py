"""How evenly messages leave, and how old their frames are."""

from __future__ import annotations

from typing import Any

import pytest

from automodel.assembly.simulated_car import PacedCanPort
from automodel.signals import Command

MS = 1_000_000
AGES_MS = (9.0, 11.0, 8.0, 12.0)


class SilentPort:
    place = "nowhere"
    open = receive = close = send = staticmethod(lambda *_: None)


def test_it_tells_the_unevenness_and_the_age_of_each_command_s_frame_once(monkeypatch: pytest.MonkeyPatch) -> None:
    now_ns = 0
    command: Command | None = None
    monkeypatch.setattr("time.monotonic_ns", lambda: now_ns)
    silent: Any = SilentPort()
    port = PacedCanPort(silent, 0.02, 0.1)
    port.carried = lambda: command
    assert set(port.metrics().values()) == {None}
    for k, age_ms in enumerate(AGES_MS):
        frame_ns = 1000 * MS + 20 * k * MS
        command = Command(t_ns=frame_ns + 5 * MS, steering_rad=0.0, speed_mps=1.0, valid_until_ns=frame_ns + 100 * MS)
        now_ns = frame_ns + round(age_ms * MS)
        port.send(0x100, b"", False)
        port.send(0x101, b"", False)  # another message
    now_ns += 20 * MS
    port.send(0x100, b"", False)  # the same command again
    now_ns += 20 * MS
    command = Command(t_ns=now_ns, steering_rad=0.0, speed_mps=0.0, valid_until_ns=now_ns + 100 * MS)  # a standstill
    port.send(0x100, b"", False)
    told = port.metrics()
    assert told["frame_to_bus_p50_ms"] == pytest.approx(10.0)
    assert told["frame_to_bus_p99_ms"] == pytest.approx(11.97)
    assert told["jitter_p50_ms"] == pytest.approx(2.0)
    assert told["jitter_p99_ms"] == pytest.approx(3.96)
