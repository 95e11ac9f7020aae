from __future__ import annotations

import pytest

from automodel.manual import controls
from automodel.manual.controls import Axis, DeviceState, Gamepad, Keyboard, controls_of

MS = 1_000_000
STICK, TRIGGER = Axis(low=-32768, high=32767, flat=128), Axis(low=0, high=1023)
XBOX = {
    controls.ABS_X: STICK, controls.ABS_Y: STICK, controls.ABS_RX: STICK, controls.ABS_RY: STICK,
    controls.ABS_Z: TRIGGER, controls.ABS_RZ: TRIGGER,
}  # fmt: skip
PAD_KEYS = {controls.BTN_SOUTH, controls.BTN_EAST, controls.BTN_TR}
ALL_KEYS = set(range(1, 128))


def state(axes: dict[int, Axis], **at: int) -> DeviceState:
    rest = dict.fromkeys(axes, 0)
    return DeviceState(axes=axes, values={**rest, **{getattr(controls, name): value for name, value in at.items()}})


@pytest.mark.parametrize(
    ("at", "expected"),
    [
        ({}, (0.0, 0.0)),
        ({"ABS_X": -32768}, (1.0, 0.0)),  # to the left
        ({"ABS_X": 32767}, (-1.0, 0.0)),
        ({"ABS_X": 1500}, (0.0, 0.0)),  # a worn stick
        ({"ABS_RZ": 1023}, (0.0, 1.0)),
        ({"ABS_Z": 1023}, (0.0, -1.0)),
        ({"ABS_Z": 1023, "ABS_RZ": 1023}, (0.0, 0.0)),
        ({"ABS_RY": -32768}, (0.0, 0.0)),  # the right stick has no part in it
    ],
)
def test_a_gamepad_with_triggers(at: dict[str, int], expected: tuple[float, float]) -> None:
    pad = controls_of(XBOX, PAD_KEYS)
    assert isinstance(pad, Gamepad)
    assert pad.wanted(state(XBOX, **at), 0) == pytest.approx(expected)


def test_a_stick_half_way_is_half_beyond_the_dead_zone() -> None:
    steering, _ = Gamepad(XBOX).wanted(state(XBOX, ABS_X=-16384), 0)
    assert steering == pytest.approx((0.5 - controls.DEAD_ZONE) / (1 - controls.DEAD_ZONE), abs=1e-3)


def test_a_driver_that_claims_more_play_than_we_do_is_believed() -> None:
    assert Axis(low=-100, high=100, flat=30).centred(29) == 0.0
    assert Axis(low=-100, high=100, flat=30).centred(100) == 1.0
    assert Axis(low=0, high=0).centred(5) == 0.0  # a broken device
    assert Axis(low=0, high=0).pressed(5) == 0.0


def test_a_wheel_gives_gas_and_brake() -> None:
    axes = {controls.ABS_X: STICK, controls.ABS_GAS: TRIGGER, controls.ABS_BRAKE: TRIGGER}
    assert Gamepad(axes).wanted(state(axes, ABS_GAS=1023), 0) == pytest.approx((0.0, 1.0))


def test_a_pad_without_triggers_as_axes_gives_the_speed_by_its_right_stick() -> None:
    centred = Axis(low=0, high=255)
    axes = dict.fromkeys((controls.ABS_X, controls.ABS_Y, controls.ABS_Z, controls.ABS_RZ), centred)
    at_rest = dict.fromkeys(("ABS_X", "ABS_Y", "ABS_Z", "ABS_RZ"), 128)
    assert Gamepad(axes).wanted(state(axes, **at_rest), 0) == (0.0, 0.0)
    assert Gamepad(axes).wanted(state(axes, **{**at_rest, "ABS_RZ": 0}), 0) == pytest.approx((0.0, 1.0))  # ahead


def test_a_keyboard_steers_step_by_step_and_comes_back() -> None:
    board, keys = Keyboard(), DeviceState(axes={}, values={})
    keys.event(controls.EV_KEY, 105, 1)  # left
    keys.event(controls.EV_KEY, 103, 1)  # ahead
    told = [board.wanted(keys, turn * 20 * MS) for turn in range(30)]
    steering = [steering for steering, _ in told]
    assert {speed for _, speed in told} == {1.0}
    assert steering[:3] == pytest.approx([0.0, 20 / 300, 40 / 300])
    assert steering[-1] == 1.0
    keys.event(controls.EV_KEY, 105, 0)
    back = [board.wanted(keys, (30 + turn) * 20 * MS)[0] for turn in range(9)]
    assert back[-1] == 0.0
    assert back == sorted(back, reverse=True)
    keys.event(controls.EV_KEY, 32, 1)  # D: right
    assert board.wanted(keys, 800 * MS)[0] < 0


def test_keys_that_repeat_stay_pressed_and_both_ways_cancel() -> None:
    keys = DeviceState(axes={}, values={})
    for code in (105, 106):
        keys.event(controls.EV_KEY, code, 2)
    board = Keyboard()
    board.wanted(keys, 0)
    assert board.wanted(keys, 500 * MS) == (0.0, 0.0)


def test_what_a_device_is() -> None:
    assert isinstance(controls_of([], ALL_KEYS), Keyboard)
    assert controls_of([], [controls.KEY_SPACE]) is None  # a power button, a mouse
    assert controls_of([controls.ABS_X, controls.ABS_Y], [controls.BTN_SOUTH - 0x20]) is None  # a touch pad
