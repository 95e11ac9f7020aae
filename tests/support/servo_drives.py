"""Drives of a plant with known pulses, logged without board, wire or clock."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from automodel.sim.plant import Plant, PlantConfig
from calibration.drive import DrivePlan, servo_plan
from calibration.servo import ServoLog

FRAME_NS = 20_000_000
WHEELBASE_M = 0.26
LOW_US, HIGH_US = 1050.0, 1950.0


def driven(config: PlantConfig, plan: DrivePlan | None = None) -> ServoLog:
    """The log of a plan: pulses at each servo frame, yaw rate halfway between, the plant's own speed."""
    plan = plan or servo_plan(LOW_US, HIGH_US, 0.5)
    plant = Plant(config, start_ns=0)
    pulses, yaw_rates, speeds = [], [], []
    times = np.arange(int(plan.duration_s * 1e9) // FRAME_NS) * FRAME_NS
    for t_ns in times.tolist():
        leg = plan.at(t_ns * 1e-9)
        assert leg is not None
        plant.set_pulses(t_ns, leg.steering, 1500.0 + 100.0 * leg.speed_mps)
        pulses.append(leg.steering)
        sensors = plant.read_sensors(t_ns + FRAME_NS // 2)
        yaw_rates.append(sensors.yaw_rate_radps)
        speeds.append(plant.state.speed_mps)
    return ServoLog(
        pulse_t_ns=times,
        pulse_us=np.array(pulses),
        t_ns=times + FRAME_NS // 2,
        yaw_rate_radps=np.array(yaw_rates),
        speed_mps=np.array(speeds),
    )


def changed(log: ServoLog, **values: Any) -> ServoLog:
    """The log with other columns."""
    return dataclasses.replace(log, **values)
