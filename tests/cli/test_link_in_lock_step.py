"""The cable of the simulated car comes out while it drives; on virtual time, so that times can be asserted."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from automodel.assembly import simulated_car as simulated
from firmware_link.transport import MemoryTransport

OUT_S, IN_S = 2.0, 2.5


class Cable(MemoryTransport):
    """Comes out at `OUT_S` and is in again at `IN_S`."""

    def __init__(self, board, clock):
        super().__init__(board, clock)
        self._time, self._out, self._back = clock, False, False

    def _move(self):
        now_s = self._time.now_ns() * 1e-9
        if now_s >= OUT_S and not self._out:
            self._out = True
            self.unplug()
        if now_s >= IN_S and not self._back:
            self._back = True
            self.replug()

    def read(self):
        self._move()
        return super().read()

    def open(self):
        self._move()
        super().open()


def test_the_car_stops_reconnects_and_stays_disarmed(tmp_path: Path, cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulated, "MemoryTransport", Cable)
    said = cli(
        "run",
        "--pipeline",
        "contour",
        "--track",
        "oval",
        "--duration",
        "5",
        "--truth",
        tmp_path / "truth.csv",
        "--json",
    )
    assert said.code == 1
    assert said.rows[0]["stops"] == 1
    told = {kind: float(t) for t, kind in re.findall(r"^([0-9.]+) s: ([a-z-]+):", said.err, re.MULTILINE)}
    told.pop("vehicle-fault", None)  # the board may say that its timer ran out
    assert set(told) == {"link-lost", "stop", "link-back"}
    assert told["stop"] == told["link-lost"] == pytest.approx(OUT_S, abs=0.03)
    assert IN_S <= told["link-back"] <= IN_S + 1.0
    t_s, x_m, y_m = np.loadtxt(tmp_path / "truth.csv", delimiter=",", skiprows=1, usecols=(0, 6, 7)).T
    speed_mps = np.hypot(np.diff(x_m), np.diff(y_m)) / np.diff(t_s)
    assert speed_mps[(t_s[1:] > OUT_S - 0.1) & (t_s[1:] < OUT_S)].min() > 0.7
    # without bytes the board's own timer lets go after 100 ms; from then on the car only rolls out
    rolling = speed_mps[t_s[1:] > OUT_S + 0.3]
    assert (np.diff(rolling) <= 1e-3).all()
    assert speed_mps[t_s[1:] > 4.0].max() < 0.01  # nobody armed it again
