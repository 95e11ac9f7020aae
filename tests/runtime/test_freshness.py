"""The defaults of the freshness chain: whatever falls silent, the motor's pin is neutral within 150 ms."""

from __future__ import annotations

from automodel.bench.faults import judge
from automodel.bench.faults.fault import BOUND_S
from automodel.config import SafetyConfig
from automodel.runtime import safety
from firmware_link.emulator import board, logic

SERVO_FRAME_S = board.SERVO_FRAME_NS * 1e-9
WIRE_S = 0.003  # a command of 17 bytes at 115200 baud takes 1.5 ms, the board's loop 1 ms
CONFIG = SafetyConfig()


def test_the_bound_is_150_ms() -> None:
    assert BOUND_S == 0.150


def test_a_camera_that_falls_silent_is_seen_in_time() -> None:
    assert CONFIG.frame_timeout_s + safety.CYCLE_S + WIRE_S + SERVO_FRAME_S <= BOUND_S


def test_a_vehicle_that_falls_silent_is_seen_in_time() -> None:
    assert safety.LINK_SILENCE_S + safety.CYCLE_S + WIRE_S + SERVO_FRAME_S <= BOUND_S


def test_the_last_command_of_a_host_that_falls_silent_ends_in_time() -> None:
    assert CONFIG.command_validity_s + WIRE_S + SERVO_FRAME_S <= BOUND_S
    assert logic.COMMAND_TIMEOUT_MS * 1e-3 + WIRE_S + SERVO_FRAME_S <= BOUND_S


def test_a_held_car_goes_on_by_itself_only_before_anybody_could_arm_it() -> None:
    assert CONFIG.hold_s < CONFIG.rearm_s
    assert CONFIG.hold_s >= safety.STALL_S


def test_host_and_board_hold_the_steering_of_a_stopped_car_for_the_time_that_it_rolls() -> None:
    assert judge.COAST_S[1] == safety.ROLL_OUT_S
    assert safety.ROLL_OUT_S * 1e3 == logic.ROLL_OUT_MS
