"""The known delay between a frame and the wheels that turn for it, made good by prediction."""

from __future__ import annotations

from collections import deque

from automodel.control.vehicle_model import driven
from automodel.geometry.se2 import SE2

_FORGET_NS = 300_000_000  # after such a gap nothing is known of what the wheels do


class SteeringInFlight:
    """The steering that was commanded and does not show yet: a command for the frame at t acts from t + delay on.

    A pure delay stands for wire, servo frame, dead time and lag together (a Smith predictor on the bicycle model).
    """

    def __init__(self, delay_s: float, wheelbase_m: float) -> None:
        if not delay_s >= 0:
            raise ValueError(f"delay_s: {delay_s} where a number >= 0 is wanted")
        self._delay_ns = round(delay_s * 1e9)
        self._wheelbase_m = wheelbase_m
        self._commands: deque[tuple[int, float]] = deque()

    def add(self, frame_ns: int, steering_rad: float) -> None:
        """A command that was given for the frame at `frame_ns`."""
        if self._commands and not 0 < frame_ns - self._commands[-1][0] < _FORGET_NS:
            self._commands.clear()
        self._commands.append((frame_ns, steering_rad))
        while len(self._commands) > 1 and self._commands[1][0] <= frame_ns - self._delay_ns:
            self._commands.popleft()

    def drive(self, frame_ns: int, speed_mps: float, steering_before_rad: float) -> SE2:
        """`frame_from_then`: where the car of the frame at `frame_ns` is when its command acts.

        `steering_before_rad` is taken for the time before the first command that is remembered.
        """
        then = SE2()
        steering, since = steering_before_rad, frame_ns - self._delay_ns
        for begin, value in self._commands:
            until = min(max(begin, since), frame_ns)
            then = then @ driven(speed_mps, steering, self._wheelbase_m, (until - since) * 1e-9)
            steering, since = value, until
        return then @ driven(speed_mps, steering, self._wheelbase_m, (frame_ns - since) * 1e-9)

    def reset(self) -> None:
        """Forget every command."""
        self._commands.clear()
