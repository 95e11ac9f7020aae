"""Limits that a board can have in its EEPROM from the start: wide, so that tests see what they command."""

from __future__ import annotations

from firmware_link.messages import Limits

WIDE_LIMITS = Limits(
    servo_min_us=1000.0,
    servo_straight_us=1500.0,
    servo_max_us=2000.0,
    motor_min_us=1000.0,
    motor_neutral_us=1500.0,
    motor_max_us=2000.0,
    servo_slew_us=200.0,
    motor_slew_us=100.0,
)
