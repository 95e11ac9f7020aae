"""Simulated cars to be calibrated, and what is seen of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from automodel.assembly import calibration_rigs
from automodel.sim.plant import Plant
from calibration import drive
from firmware_link.emulator.logic import ROLL_OUT_MS

SIMULATED = '# mine\n[link]\nport = "sim"  # here\n'


@pytest.fixture
def car(tmp_path: Path) -> Path:
    path = tmp_path / "car.toml"
    path.write_text(SIMULATED)
    return path


@pytest.fixture
def pins(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, float, float]]:
    """Every (t_ns, servo_us, motor_us) that a simulated car gets; `at_rest` lets its time go on for a while."""
    seen: list[tuple[int, float, float]] = []
    set_pulses = Plant.set_pulses

    def noting(plant: Plant, t_ns: int, servo_us: float, motor_us: float) -> None:
        seen.append((t_ns, servo_us, motor_us))
        set_pulses(plant, t_ns, servo_us, motor_us)

    monkeypatch.setattr(Plant, "set_pulses", noting)
    return seen


@pytest.fixture
def at_rest(pins: list, monkeypatch: pytest.MonkeyPatch) -> Callable[[], bool]:
    """Whether the simulated car is neutral two servo frames after the command has ended, and straight once rolled out.

    The board's own timer would take five: it is the host that stopped the car.
    """
    rigs: list[drive.Rig] = []
    make = calibration_rigs.simulated_rig

    def keeping(*arguments, **named):
        rigs.append(make(*arguments, **named))
        return rigs[-1]

    monkeypatch.setattr(calibration_rigs, "simulated_rig", keeping)

    def look() -> bool:
        rigs[-1].clock.sleep(0.04)
        drove, motor_us = any(motor > 1500.0 for _, _, motor in pins), pins[-1][2]
        rigs[-1].clock.sleep(ROLL_OUT_MS * 1e-3)
        return drove and motor_us == 1500.0 and pins[-1][1:] == (1500.0, 1500.0)

    return look


def untouched(car: Path) -> bool:
    return car.read_text() == SIMULATED and [path.name for path in car.parent.iterdir()] == ["car.toml"]


def during(monkeypatch: pytest.MonkeyPatch, after_s: float, act: Callable[[], None]) -> None:
    """Call `act` once, so long after the drive's first turn, in the middle of a turn."""
    step, seen = drive.PlanFollower.step, []

    def acting(self, estimate, motion, state, t_ns):
        seen.append(t_ns)
        if t_ns - seen[0] > after_s * 1e9 and len(seen) > 1:
            seen[:] = [10**18]
            act()
        return step(self, estimate, motion, state, t_ns)

    monkeypatch.setattr(drive.PlanFollower, "step", acting)
