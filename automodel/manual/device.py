"""Input devices of Linux by evdev: found, opened, and read without waiting. Needs the extra `manual`."""

from __future__ import annotations

import contextlib
from typing import Any

from automodel.config import ConfigError
from automodel.config.extras import need_extra
from automodel.manual.controls import (
    EV_ABS,
    EV_KEY,
    EV_SYN,
    SYN_DROPPED,
    Axis,
    Controls,
    DeviceState,
    Gamepad,
    Keyboard,
    controls_of,
)

_READS = 16  # of up to 64 events at a time; more wait for the next cycle
KINDS = {"gamepad": Gamepad, "keyboard": Keyboard}


class EvdevDevice:
    """An open device and its state; `device` is an `evdev.InputDevice`. What the device is now is asked at the start.

    Raises ValueError for a device that is neither gamepad nor keyboard.
    """

    def __init__(self, device: Any) -> None:
        self._device = device
        capabilities = device.capabilities(absinfo=False)
        axes = {code: device.absinfo(code) for code in capabilities.get(EV_ABS, [])}
        found = controls_of(axes, capabilities.get(EV_KEY, []))
        if found is None:
            raise ValueError(f"{device.path}: {device.name}: is neither a gamepad nor a keyboard")
        self.controls: Controls = found
        self.name = str(device.name)
        known = {code: Axis(low=info.min, high=info.max, flat=info.flat) for code, info in axes.items()}
        self.state = DeviceState(axes=known, values={})
        self._refresh()

    def read(self) -> DeviceState:
        """The state now; never waits. Raises OSError where the device is gone."""
        dropped = False
        with contextlib.suppress(BlockingIOError):  # nothing has happened
            for _ in range(_READS):
                for event in self._device.read():
                    dropped = dropped or (event.type, event.code) == (EV_SYN, SYN_DROPPED)
                    self.state.event(event.type, event.code, event.value)
        if dropped:  # the kernel's queue ran over: what was lost is asked for
            self._refresh()
        return self.state

    def close(self) -> None:
        """Close the device; may be called twice."""
        with contextlib.suppress(OSError):
            self._device.close()

    def _refresh(self) -> None:
        self.state.keys = set(self._device.active_keys())
        self.state.values = {code: self._device.absinfo(code).value for code in self.state.axes}


def open_device(name: str) -> EvdevDevice:
    """The first "gamepad" or "keyboard", or the device at a path; raises ConfigError, what to do in it."""
    need_extra("--manual", "evdev")
    import evdev

    kind, refused = KINDS.get(name), []
    for path in evdev.list_devices() if kind else [name]:
        try:
            opened = EvdevDevice(evdev.InputDevice(path))
        except OSError as error:
            refused.append(f"{path}: {error.strerror}")
        except ValueError as error:
            refused.append(str(error))
        else:
            if kind is None or isinstance(opened.controls, kind):
                return opened
            opened.close()
    if kind is None:
        raise ConfigError(f"--manual {refused[0]}; give gamepad, keyboard or a device in /dev/input")
    raise ConfigError(
        f"--manual: there is no {name} that may be read in /dev/input; plug it in, or: sudo usermod -aG input $USER"
    )


def reopen_device(name: str) -> EvdevDevice | None:
    """As `open_device`, None where it is not there (yet)."""
    try:
        return open_device(name)
    except ConfigError:
        return None
