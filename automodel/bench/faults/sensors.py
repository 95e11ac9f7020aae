"""What can go wrong with the sensors on the board: hooks that take a right reading and give a wrong one."""

from __future__ import annotations

import dataclasses
from random import Random

from automodel.bench.faults.hooks import SensorHook
from automodel.signals import BoardSensors


def battery(voltage_v: float) -> SensorHook:
    """A battery of this voltage."""
    return lambda sensors: dataclasses.replace(sensors, battery_v=voltage_v)


def dropouts(random: Random, share: float) -> SensorHook:
    """Each range is missing in this share of the readings."""

    def hook(sensors: BoardSensors) -> BoardSensors:
        left, centre, right = (None if random.random() < share else range_m for range_m in sensors.ranges_m)
        return dataclasses.replace(sensors, ranges_m=(left, centre, right))

    return hook


def spikes(random: Random, every: int) -> SensorHook:
    """A short echo from nowhere, once in `every` readings."""
    seen = random.randrange(every)

    def hook(sensors: BoardSensors) -> BoardSensors:
        nonlocal seen
        seen += 1
        if seen % every:
            return sensors
        return dataclasses.replace(sensors, ranges_m=(0.1, random.uniform(0.02, 0.3), 0.1))

    return hook


def stuck_echo(range_m: float) -> SensorHook:
    """All three sensors read the same, whatever is ahead."""
    return lambda sensors: dataclasses.replace(sensors, ranges_m=(range_m, range_m, range_m))
