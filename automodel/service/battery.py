"""A battery that stays low ends the run, before it is damaged or the computer loses its power."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from automodel.console.messages import say
from automodel.runtime.run_types import TickRecord
from automodel.signals import Event

LASTING_S = 10.0  # longer than the voltage drop of any acceleration
FLAG = "battery-low"


class LowBattery:
    """Implements `assembly.drive.Viewer`; `over` says that the run has to end.

    Low is what the vehicle's state says for `LASTING_S` ("battery_low", below `[vehicle] battery_low_v`). Then the file
    `battery-low` is made in `folder` (default: systemd's $RUNTIME_DIRECTORY), for which the service shuts down.
    """

    def __init__(self, folder: Path | None = None) -> None:
        given = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0]
        self._folder = folder if folder is not None else Path(given) if given else None
        self._since_ns: int | None = None
        self._over = False

    def over(self) -> bool:
        """Whether the battery has been low for so long."""
        return self._over

    def on_tick(self, record: TickRecord) -> None:
        """A cycle of the run."""
        if record.state is None or self._over:
            return
        if "battery_low" not in record.state.faults:
            self._since_ns = None
        elif self._since_ns is None:
            self._since_ns = record.t_ns
        elif record.t_ns - self._since_ns >= LASTING_S * 1e9:
            self._over = True
            self._tell(record.state.battery_v)

    def on_event(self, event: Event) -> None:
        """Of no interest."""

    def _tell(self, battery_v: float | None) -> None:
        at = "" if battery_v is None else f" ({battery_v:.2f} V)"
        say(f"the battery has been low for {LASTING_S:g} s{at}: the run ends; charge it")
        if self._folder is not None:
            with contextlib.suppress(OSError):  # then nobody shuts down, and the run ends all the same
                (self._folder / FLAG).touch()
