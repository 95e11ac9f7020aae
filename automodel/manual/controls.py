"""From the events of an input device (Linux' evdev) to what a person wants: gamepad and keyboard; pure, time passed in.

Gamepad, by Linux' convention for them: left stick to steer, right trigger ahead, left trigger back, the right shoulder
button held to drive, the lower or right face button for STOP. Pads without triggers as axes of their own give the speed
by the right stick.
Keyboard: arrow keys or W A S D, the left shift key held to drive, space bar or Esc for STOP.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Protocol

# <linux/input-event-codes.h>; these numbers never change, and evdev itself is not needed to know them
EV_SYN, EV_KEY, EV_ABS = 0x00, 0x01, 0x03
SYN_DROPPED = 3
ABS_X, ABS_Y, ABS_Z, ABS_RX, ABS_RY, ABS_RZ, ABS_GAS, ABS_BRAKE = 0, 1, 2, 3, 4, 5, 9, 10
BTN_SOUTH, BTN_EAST, BTN_TR = 0x130, 0x131, 0x137
KEY_ESC, KEY_LEFTSHIFT, KEY_SPACE = 1, 42, 57
AHEAD, BACK, LEFT, RIGHT = frozenset({103, 17}), frozenset({108, 31}), frozenset({105, 30}), frozenset({106, 32})

DEAD_ZONE = 0.06  # of a stick's way to either side, where its driver claims less: worn sticks rest there
KEY_STEER_S = 0.3  # from straight to the full angle by a key, which knows no half
KEY_BACK_S = 0.15  # and back


@dataclass(frozen=True, slots=True, kw_only=True)
class Axis:
    """A device's axis: its range, and how far from its middle it may rest (`flat`), in the device's own numbers."""

    low: int
    high: int
    flat: int = 0

    def centred(self, value: int) -> float:
        """-1 .. 1, 0 in the dead zone."""
        half = 0.5 * (self.high - self.low)
        share = min(max((value - self.low - half) / half, -1.0), 1.0) if half > 0 else 0.0
        dead = max(self.flat / half if half > 0 else 0.0, DEAD_ZONE)
        beyond = max(abs(share) - dead, 0.0) / (1.0 - dead) if dead < 1.0 else 0.0
        return beyond if share > 0 else -beyond

    def pressed(self, value: int) -> float:
        """0 .. 1, of a trigger that rests at the low end."""
        way = self.high - self.low
        share = min(max((value - self.low) / way, 0.0), 1.0) if way > 0 else 0.0
        return max(share - DEAD_ZONE, 0.0) / (1.0 - DEAD_ZONE)


@dataclass(slots=True, kw_only=True)
class DeviceState:
    """What is pressed and where the axes stand, kept up to date by `event`."""

    axes: Mapping[int, Axis]
    values: dict[int, int]
    keys: set[int] = field(default_factory=set)

    def event(self, kind: int, code: int, value: int) -> None:
        """Take up one event; other kinds are ignored."""
        if kind == EV_ABS and code in self.axes:
            self.values[code] = value
        elif kind == EV_KEY:
            (self.keys.add if value else self.keys.discard)(code)  # 2: a key that repeats

    def any_of(self, keys: Collection[int]) -> bool:
        """Whether one of the keys is pressed."""
        return not self.keys.isdisjoint(keys)


class Controls(Protocol):
    """Reads what a person wants from a device's state."""

    name: str
    hold_key: int
    stop_keys: frozenset[int]
    how: str

    def wanted(self, state: DeviceState, now_ns: int) -> tuple[float, float]:
        """Shares -1 .. 1 of the greatest steering, left positive, and speed."""
        ...


class Gamepad:
    """Implements `Controls`."""

    name = "the gamepad"
    hold_key = BTN_TR
    stop_keys = frozenset({BTN_SOUTH, BTN_EAST})

    def __init__(self, axes: Collection[int]) -> None:
        if {ABS_GAS, ABS_BRAKE} <= set(axes):
            self._triggers: tuple[int, int] | None = (ABS_GAS, ABS_BRAKE)
        else:
            self._triggers = (ABS_RZ, ABS_Z) if {ABS_RX, ABS_RY, ABS_RZ, ABS_Z} <= set(axes) else None
        self._stick = next((axis for axis in (ABS_RY, ABS_RZ, ABS_Y) if axis in axes), None)
        speed = "triggers: speed" if self._triggers else "right stick: speed"
        self.how = (
            f"hold the right shoulder button to drive; left stick: steering, {speed}, lower or right button: STOP"
        )

    def wanted(self, state: DeviceState, now_ns: int) -> tuple[float, float]:
        """As the sticks and triggers stand."""
        steering = -state.axes[ABS_X].centred(state.values[ABS_X])  # the device's numbers grow to the right
        if self._triggers is not None:
            ahead, back = (state.axes[code].pressed(state.values[code]) for code in self._triggers)
            return steering, ahead - back
        if self._stick is None:
            return steering, 0.0
        return steering, -state.axes[self._stick].centred(state.values[self._stick])  # and downwards


class Keyboard:
    """Implements `Controls`; the wheels go to where a key asks for in `KEY_STEER_S`."""

    name = "the keyboard"
    hold_key = KEY_LEFTSHIFT
    stop_keys = frozenset({KEY_ESC, KEY_SPACE})
    how = "hold the left shift key to drive; arrows or W A S D: steering and speed, space bar or Esc: STOP"

    def __init__(self) -> None:
        self._steering = 0.0
        self._last_ns: int | None = None

    def wanted(self, state: DeviceState, now_ns: int) -> tuple[float, float]:
        """As the keys are pressed, the steering on its way there."""
        target = float(state.any_of(LEFT)) - float(state.any_of(RIGHT))
        dt_s = 0.0 if self._last_ns is None else max(now_ns - self._last_ns, 0) * 1e-9
        self._last_ns = now_ns
        step = dt_s / (KEY_STEER_S if target != 0.0 and target * self._steering >= 0.0 else KEY_BACK_S)
        self._steering += min(max(target - self._steering, -step), step)
        return self._steering, float(state.any_of(AHEAD)) - float(state.any_of(BACK))


def controls_of(axes: Collection[int], keys: Collection[int]) -> Controls | None:
    """How a device with these axes and keys is driven with; None where it is neither gamepad nor keyboard."""
    if {BTN_SOUTH, BTN_TR} <= set(keys) and ABS_X in axes:
        return Gamepad(axes)
    if {KEY_LEFTSHIFT, KEY_SPACE, *AHEAD, *BACK, *LEFT, *RIGHT} <= set(keys):
        return Keyboard()
    return None
