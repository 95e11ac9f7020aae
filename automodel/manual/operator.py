"""A person with a gamepad or keyboard at the car's own computer."""

from __future__ import annotations

import time
import types
from collections.abc import Callable
from typing import Protocol

from automodel.manual.controls import Controls, DeviceState
from automodel.manual.dead_man import DeadMan
from automodel.runtime.run_types import TickRecord
from automodel.signals import DriverInput, Event


class InputDevice(Protocol):
    """A gamepad or keyboard that is open."""

    name: str
    controls: Controls

    def read(self) -> DeviceState:
        """The state now; never waits. Raises OSError where the device is gone."""
        ...

    def close(self) -> None:
        """Close the device; may be called twice."""
        ...


class DeviceOperator:
    """Implements `assembly.drive.Operator` with a device: driven by hand for as long as its button is held.

    A device that vanishes stops the car, whoever drives it, and nobody arms it until it is back: with it goes the way
    to take over. It is opened again by `reopen` (None: it is not), at most once a second; its button has to be pressed
    anew, as one that was held at the start.
    """

    _REOPEN_NS = 1_000_000_000

    def __init__(
        self,
        device: InputDevice,
        reopen: Callable[[], InputDevice | None] | None = None,
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._device: InputDevice | None = device
        self._controls = device.controls
        self._reopen, self._now_ns = reopen, now_ns
        self._dead_man = DeadMan(self._controls.name)
        self._pressed = True  # until it was seen released: one that is held at the start does not count
        self._reason: str | None = None
        self._tried_ns = 0

    def __enter__(self) -> DeviceOperator:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: types.TracebackType | None
    ) -> None:
        """Close the device."""
        if self._device is not None:
            self._device.close()

    def wanted_by_hand(self) -> DriverInput | None:
        """What the person wants, None while the button is not held; never waits."""
        state, now_ns = self._read(), self._now_ns()
        if state is None or not self._dead_man.held:
            return None
        steering, speed = self._controls.wanted(state, now_ns)
        return DriverInput(t_ns=now_ns, steering=steering, speed=speed)

    def stop_requested(self) -> str | None:
        """Why the car has to stop, None where it has not; never waits."""
        if self._read() is None:
            return f"{self._controls.name} is gone"
        reason, self._reason = self._reason, None
        return reason

    def arm_requested(self) -> bool:
        """Whether the button was pressed since the last call."""
        return self._dead_man.take_arm()

    def on_tick(self, record: TickRecord) -> None:
        """A device shows nothing."""

    def on_event(self, event: Event) -> None:
        """A device tells nothing."""

    def _read(self) -> DeviceState | None:
        """The device's state, its buttons heard; None while it is gone."""
        device = self._device if self._device is not None else self._found_again()
        if device is None:
            return None
        try:
            state = device.read()
        except OSError:
            device.close()
            self._device, self._tried_ns = None, self._now_ns()
            self._dead_man.release()
            return None
        pressed, now_ns = self._controls.hold_key in state.keys, self._now_ns()
        if state.any_of(self._controls.stop_keys):
            self._reason = self._dead_man.stop()
        elif pressed and not self._pressed:
            self._dead_man.press(now_ns)
        elif not pressed:
            self._reason = self._dead_man.release() or self._reason
        self._pressed = pressed
        return state

    def _found_again(self) -> InputDevice | None:
        now_ns = self._now_ns()
        if self._reopen is None or now_ns - self._tried_ns < self._REOPEN_NS:
            return None
        self._tried_ns = now_ns
        self._device = self._reopen()
        if self._device is not None:
            self._controls, self._pressed = self._device.controls, True
        return self._device
