"""The firmware on the simulated chip, for tests: built once a process, and heard by what it says."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest

from firmware_link import messages
from firmware_link.emulator.avr import AvrBoard, AvrMissing, AvrProgram, build_avr
from firmware_link.emulator.logic import BoardCounters
from firmware_link.emulator.pty import BenchPeripherals

_built: dict[str, AvrProgram] = {}  # one build serves all tests of a process
_folder = tempfile.TemporaryDirectory(prefix="avr-")


def built_avr() -> AvrProgram:
    """Both programs; skips where the toolchain is missing."""
    if not _built:
        try:
            _built["avr"] = build_avr(Path(_folder.name))
        except AvrMissing as error:
            pytest.skip(str(error))
    return _built["avr"]


class HeardAvr(AvrBoard):
    """The firmware on the simulated chip; what the emulated board shows is taken from what this one says."""

    def __init__(self, peripherals: BenchPeripherals, boot_ns: int = 0) -> None:
        super().__init__(built_avr(), peripherals, boot_ns=boot_ns)
        self.counters = BoardCounters()
        self.said: list[messages.Message] = []
        self.boot_id: int | None = None
        self.armed = False
        self._decoder = messages.decoder(on_board=False)

    def transmit(self, now_ns: int) -> bytes:
        sent = super().transmit(now_ns)
        for message in map(messages.decode, self._decoder.feed(sent)):
            self.said.append(message)
            if isinstance(message, messages.Status):
                self.armed = bool(message.flags & messages.StatusFlag.ARMED)
            elif isinstance(message, messages.Hello):
                self.boot_id = message.boot_id
        return sent
