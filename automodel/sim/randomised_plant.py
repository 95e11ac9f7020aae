"""Simulated cars with random servo and motor parameters, for testing calibrations."""

from __future__ import annotations

import dataclasses
import random

from automodel.config import MotorConfig, ServoConfig
from automodel.sim.plant import PlantConfig

FULL_US = 400.0  # from the motor's neutral to full speed


def randomised_servo(seed: int, plant: PlantConfig) -> PlantConfig:
    """`plant` with a random servo and gyro bias.

    The centre is within 80 us of 1500 us. Each side has its own stop and gain, with a slightly smaller gain in its
    outer half. The play is 2 deg, the dead time 40 to 120 ms; lag, rate limit and direction are random too.
    """
    draw = random.Random(f"servo {seed}")
    centre_us = 1500.0 + draw.uniform(-80.0, 80.0)
    low_side = draw.choice((1.0, -1.0))  # 1: short pulses turn left
    points = [(centre_us, 0.0)]
    for sign in (-1.0, 1.0):
        stop_us, stop_rad = draw.uniform(380.0, 470.0), draw.uniform(0.34, 0.48)
        for us, rad in ((0.5 * stop_us, draw.uniform(0.50, 0.53) * stop_rad), (stop_us, stop_rad)):
            points.append((centre_us + sign * us, -sign * low_side * rad))
    points.sort()
    return dataclasses.replace(
        plant,
        servo=ServoConfig(pulse_us=tuple(us for us, _ in points), steering_rad=tuple(rad for _, rad in points)),
        servo_play_rad=0.0349,
        servo_dead_s=draw.uniform(0.040, 0.120),
        servo_lag_s=draw.uniform(0.010, 0.040),
        servo_rate_max_radps=draw.uniform(3.0, 9.0),
        gyro_bias_radps=draw.uniform(-0.05, 0.05),
    )


def randomised_motor(seed: int, plant: PlantConfig) -> PlantConfig:
    """`plant` with a random motor (gain, lag, dead band around neutral) and a random number of ticks per metre."""
    draw = random.Random(f"motor {seed}")
    band_us = draw.uniform(5.0, 40.0)
    full_mps = draw.uniform(2.5, 5.0)
    creep_mps = 1e-6  # a table rises throughout
    return dataclasses.replace(
        plant,
        motor=MotorConfig(
            pulse_us=(1500.0 - FULL_US, 1500.0 - band_us, 1500.0, 1500.0 + band_us, 1500.0 + FULL_US),
            speed_mps=(-full_mps, -creep_mps, 0.0, creep_mps, full_mps),
        ),
        motor_lag_s=draw.uniform(0.08, 0.20),
        ticks_per_m=draw.uniform(120.0, 320.0),
    )
