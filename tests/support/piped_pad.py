"""A gamepad of which all is real but the kernel: evdev reads the kernel's event structs from a pipe."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from automodel.manual.controls import ABS_RX, ABS_RY, ABS_RZ, ABS_X, ABS_Z, BTN_EAST, BTN_SOUTH, BTN_TR, EV_ABS, EV_KEY

EventIO: Any = pytest.importorskip("evdev.eventio", reason="needs the extra manual").EventIO
EVENT = struct.Struct("llHHi")  # struct input_event
STICK, TRIGGER = (-32768, 32767), (0, 1023)
AXES = {ABS_X: STICK, ABS_RX: STICK, ABS_RY: STICK, ABS_Z: TRIGGER, ABS_RZ: TRIGGER}


class PipedPad(EventIO):  # type: ignore[misc] # evdev is of an extra
    """As an `evdev.InputDevice`; `send` is what the kernel does."""

    path, name = "/dev/input/event7", "a pad"

    def __init__(self) -> None:
        self.fd, self._kernel = os.pipe()
        self._open = [self.fd, self._kernel]
        os.set_blocking(self.fd, False)
        self.pressed: list[int] = []
        self.at = dict.fromkeys(AXES, 0)
        self.unplugged = False

    def send(self, *events: tuple[int, int, int]) -> None:
        for event in events:
            os.write(self._kernel, EVENT.pack(0, 0, *event))

    def read(self) -> Iterator[object]:
        if self.unplugged:
            raise OSError(19, "No such device")  # ENODEV, as the kernel says
        return super().read()

    def capabilities(self, absinfo: bool = True) -> dict[int, list[int]]:
        return {EV_KEY: [BTN_SOUTH, BTN_EAST, BTN_TR], EV_ABS: list(AXES)}

    def absinfo(self, code: int) -> SimpleNamespace:
        low, high = AXES[code]
        return SimpleNamespace(value=self.at[code], min=low, max=high, flat=0)

    def active_keys(self) -> list[int]:
        return self.pressed

    def close(self) -> None:
        while self._open:
            os.close(self._open.pop())
