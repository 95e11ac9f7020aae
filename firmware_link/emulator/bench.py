"""A board on the bench: nothing moves, the pulses are noted, the sensors read what they are told to."""

from __future__ import annotations

from collections import deque

from automodel.signals import BoardSensors


class BenchPeripherals:
    """Peripherals of a board on the bench.

    `pulses` has the (t_ns, servo_us, motor_us) of the newest 10,000 servo frames. `sensors` is what is read; assign to
    it.
    """

    def __init__(self) -> None:
        self.pulses: deque[tuple[int, float, float]] = deque(maxlen=10_000)
        self.sensors = BoardSensors(ranges_m=(None, None, None), wheel_ticks=0, battery_v=7.4, yaw_rate_radps=None)

    @property
    def at_pins(self) -> tuple[float, float]:
        """The pulses (servo_us, motor_us) at the pins now."""
        _, servo_us, motor_us = self.pulses[-1]
        return servo_us, motor_us

    def set_pulses(self, t_ns: int, servo_us: float, motor_us: float) -> None:
        """Note the pulses."""
        self.pulses.append((t_ns, servo_us, motor_us))

    def read_sensors(self, t_ns: int) -> BoardSensors:
        """`sensors`."""
        return self.sensors
