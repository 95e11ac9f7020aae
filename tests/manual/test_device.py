"""Devices by evdev's own reading of the kernel's event structs, from a pipe; through /dev/uinput where that exists."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator

import pytest

from automodel.config import ConfigError
from automodel.manual.controls import (
    ABS_RX,
    ABS_RY,
    ABS_RZ,
    ABS_X,
    ABS_Z,
    BTN_EAST,
    BTN_SOUTH,
    BTN_TR,
    EV_ABS,
    EV_KEY,
    Gamepad,
)
from automodel.manual.device import EvdevDevice, open_device, reopen_device
from automodel.manual.operator import DeviceOperator
from automodel.signals import DriverInput
from tests.support.piped_pad import PipedPad

evdev = pytest.importorskip("evdev", reason="needs the extra manual")

DROPPED = (0, 3, 0)


@pytest.fixture
def pad() -> Iterator[PipedPad]:
    made = PipedPad()
    yield made
    made.close()


class Driven:
    """An operator with the pad, and its clock."""

    def __init__(self, pad: PipedPad, reopen: PipedPad | None = None) -> None:
        self.now_ns = 10_000_000_000
        self.operator = DeviceOperator(
            EvdevDevice(pad), lambda: None if reopen is None else EvdevDevice(reopen), lambda: self.now_ns
        )

    def turn(self) -> tuple[DriverInput | None, str | None, bool]:
        self.now_ns += 20_000_000
        return self.operator.wanted_by_hand(), self.operator.stop_requested(), self.operator.arm_requested()


def test_the_states_at_the_start_are_asked_for(pad: PipedPad) -> None:
    pad.at[ABS_RZ], pad.pressed = 1023, [BTN_TR]
    device = EvdevDevice(pad)
    assert isinstance(device.controls, Gamepad)
    assert device.read().keys == {BTN_TR}
    assert device.controls.wanted(device.read(), 0) == pytest.approx((0.0, 1.0))


def test_a_press_arms_drives_and_letting_go_stops(pad: PipedPad) -> None:
    driven = Driven(pad)
    assert driven.turn() == (None, None, False)
    pad.send((EV_KEY, BTN_TR, 1), (EV_ABS, ABS_X, -32768), (EV_ABS, ABS_RZ, 1023), (0, 0, 0))
    wanted, stop, arm = driven.turn()
    assert (stop, arm) == (None, True)
    assert wanted == DriverInput(t_ns=driven.now_ns, steering=1.0, speed=1.0)
    for _ in range(100):  # a stick that rests gives no events, and the car drives on
        wanted, stop, arm = driven.turn()
        assert (wanted is not None, stop, arm) == (True, None, False)
    pad.send((EV_KEY, BTN_TR, 0))
    assert driven.turn() == (None, "the gamepad's button was released", False)
    assert driven.turn() == (None, None, False)


def test_stop_stops_whoever_drives_for_as_long_as_it_is_pressed(pad: PipedPad) -> None:
    driven = Driven(pad)
    driven.turn()
    pad.send((EV_KEY, BTN_EAST, 1), (EV_KEY, BTN_TR, 1))
    assert driven.turn() == (None, "STOP on the gamepad", False)
    assert driven.turn()[1] == "STOP on the gamepad"
    pad.send((EV_KEY, BTN_EAST, 0))
    assert driven.turn() == (None, None, False)  # the button is held still, and was not pressed anew


def test_a_button_that_is_held_at_the_start_has_to_be_let_go_first(pad: PipedPad) -> None:
    pad.pressed = [BTN_TR]
    driven = Driven(pad)
    assert driven.turn() == (None, None, False)
    pad.send((EV_KEY, BTN_TR, 0))
    assert driven.turn() == (None, None, False)
    pad.send((EV_KEY, BTN_TR, 1))
    assert driven.turn()[2]


def test_a_device_that_vanishes_stops_the_car_until_it_is_back_and_pressed_anew(pad: PipedPad) -> None:
    back = PipedPad()
    driven = Driven(pad, reopen=back)
    driven.turn()
    pad.send((EV_KEY, BTN_TR, 1))
    assert driven.turn()[0] is not None
    pad.unplugged = True
    for _ in range(40):
        assert driven.turn() == (None, "the gamepad is gone", False)
    back.pressed = [BTN_TR]
    for _ in range(20):
        wanted, stop, arm = driven.turn()
    assert (wanted, stop, arm) == (None, None, False)
    back.send((EV_KEY, BTN_TR, 0), (EV_KEY, BTN_TR, 1))
    driven.turn()
    back.send((EV_KEY, BTN_TR, 0))
    driven.turn()
    back.send((EV_KEY, BTN_TR, 1))
    assert driven.turn()[2]


def test_what_the_kernel_had_to_drop_is_asked_for(pad: PipedPad) -> None:
    driven = Driven(pad)
    driven.turn()
    pad.send((EV_KEY, BTN_TR, 1))
    assert driven.turn()[0] is not None
    pad.pressed = []  # its release was lost
    pad.send(DROPPED)
    assert driven.turn() == (None, "the gamepad's button was released", False)


def test_a_burst_of_events_is_taken_up_over_cycles(pad: PipedPad) -> None:
    driven = Driven(pad)
    driven.turn()
    pad.send((EV_KEY, BTN_TR, 1), *[(EV_ABS, ABS_X, -index) for index in range(2000)], (EV_ABS, ABS_X, -32768))
    for _ in range(3):
        wanted = driven.turn()[0]
    assert wanted is not None
    assert wanted.steering == 1.0


def test_what_is_neither_is_refused_by_name(pad: PipedPad) -> None:
    pad.capabilities = lambda absinfo=True: {EV_KEY: [116]}  # type: ignore[method-assign] # a power button
    with pytest.raises(ValueError, match=r"/dev/input/event7: a pad: is neither a gamepad nor a keyboard"):
        EvdevDevice(pad)


def test_a_device_that_is_not_there_is_named(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"--manual .*event99: .*; give gamepad, keyboard or a device in /dev/input"):
        open_device(str(tmp_path / "event99"))


@pytest.mark.skipif(bool(evdev.list_devices()), reason="this machine has input devices")
def test_no_device_at_all_is_told() -> None:
    with pytest.raises(ConfigError, match="--manual: there is no gamepad that may be read in /dev/input; plug it in"):
        open_device("gamepad")
    assert reopen_device("gamepad") is None


@pytest.mark.skipif(not os.access("/dev/uinput", os.W_OK), reason="needs a writable /dev/uinput")
def test_through_the_kernel() -> None:
    info = evdev.AbsInfo(value=0, min=-32768, max=32767, fuzz=0, flat=0, resolution=0)
    axes = [(code, info) for code in (ABS_X, ABS_RX, ABS_RY)]
    axes += [(code, info._replace(min=0, max=1023)) for code in (ABS_Z, ABS_RZ)]
    keys = [BTN_SOUTH, BTN_EAST, BTN_TR]
    with evdev.UInput({EV_KEY: keys, EV_ABS: axes}, name="automodel test pad") as kernel:
        time.sleep(0.5)  # udev's rights
        device = open_device(kernel.device.path)
        kernel.write(EV_KEY, BTN_TR, 1)
        kernel.write(EV_ABS, ABS_X, -32768)
        kernel.syn()
        until = time.monotonic() + 20
        while not device.read().keys and time.monotonic() < until:
            time.sleep(0.001)
        assert device.controls.wanted(device.read(), 0)[0] == 1.0
