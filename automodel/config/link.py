"""[link]: the vehicle's controller."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

from automodel.config.can import CanConfig
from automodel.config.parts import LINKS
from automodel.config.toml_reader import positive


def _check_pulses(name: str, pulses_us: tuple[float, ...]) -> None:
    if any(b <= a for a, b in itertools.pairwise(pulses_us)):
        raise ValueError(f"{name}: must rise from entry to entry")
    if not all(500 <= p <= 2500 for p in pulses_us):
        raise ValueError(f"{name}: servo pulses lie between 500 and 2500 us")


def _check_table(name: str, pulses_us: tuple[float, ...], values: tuple[float, ...]) -> None:
    if len(pulses_us) != len(values) or len(pulses_us) < 2:
        raise ValueError(
            f"{name}: expected a value for each of at least two pulses, got {len(values)} for {len(pulses_us)}"
        )
    _check_pulses("pulse_us", pulses_us)
    steps = [b - a for a, b in itertools.pairwise(values)]
    if not (all(d > 0 for d in steps) or all(d < 0 for d in steps)):
        raise ValueError(f"{name}: must rise throughout or fall throughout")
    if not min(values) <= 0 <= max(values):
        raise ValueError(f"{name}: must span 0, the neutral position")


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoConfig:
    """Pulse width -> road-wheel angle: piecewise linear through (pulse_us[i], steering_rad[i])."""

    pulse_us: tuple[float, ...] = (1050.0, 1500.0, 1950.0)
    steering_rad: tuple[float, ...] = (0.45, 0.0, -0.45)

    def __post_init__(self) -> None:
        _check_table("steering_rad", self.pulse_us, self.steering_rad)


@dataclass(frozen=True, slots=True, kw_only=True)
class MotorConfig:
    """Pulse width -> speed: piecewise linear through (pulse_us[i], speed_mps[i])."""

    pulse_us: tuple[float, ...] = (1100.0, 1500.0, 1900.0)
    speed_mps: tuple[float, ...] = (-4.0, 0.0, 4.0)

    def __post_init__(self) -> None:
        _check_table("speed_mps", self.pulse_us, self.speed_mps)


@dataclass(frozen=True, slots=True, kw_only=True)
class AutonomosConfig:
    """What the AutoNOMOS cars have of their own (`kind = "autonomos"`); [link.motor] is not used, its place is here.

    The steering number 0 .. 180 of their text stands for a pulse, and [link.servo] says what angle that makes. The
    motor's number is one a speed: `at_1000_mps` is the speed [m/s] that +1000 makes, below 0 where + is backwards.
    """

    motor_port: str = ""  # of the cars with a motor controller on a line of its own (2015, 2016); else empty
    servo_us: tuple[float, ...] = (900.0, 1900.0)  # the pulses that 0 and 180 make
    at_1000_mps: float = -4.0

    def __post_init__(self) -> None:
        if len(self.servo_us) != 2:
            raise ValueError(f"servo_us: expected two pulses, of 0 and of 180, got {len(self.servo_us)}")
        _check_pulses("servo_us", self.servo_us)
        if self.at_1000_mps == 0:
            raise ValueError("at_1000_mps: expected a speed, got 0")


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkConfig:
    """The vehicle's controller: `port` is "sim" or a serial port, `kind` the language that it speaks."""

    kind: str = "arduino"
    port: str = "sim"
    baud: int = 115200
    servo: ServoConfig = field(default_factory=ServoConfig)
    motor: MotorConfig = field(default_factory=MotorConfig)
    autonomos: AutonomosConfig = field(default_factory=AutonomosConfig)
    can: CanConfig = field(default_factory=CanConfig)

    def __post_init__(self) -> None:
        LINKS.check("kind", self.kind)
        positive(self, "baud")
