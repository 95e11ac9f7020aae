"""Whether a stopped car stands, as its own odometry says: then it needs its steering no longer."""

from __future__ import annotations

from automodel.signals import VehicleState

STAND_S = 0.2  # a car whose speed has been nothing for so long may stand
STAND_GAPS = 3.0  # and stands where that is so many times the last gap between two readings of a speed
STANDING_MPS = 0.02  # a speed below this is nothing
_NS_PER_S = 1_000_000_000


class Standstill:
    """Looks at the speeds that the vehicle reports; the board does the same with its wheel's ticks (`firmware_link`).

    A slow wheel ticks seldom, and between two ticks the speed reads nothing. At a constant deceleration the time from
    the last tick to standstill is at most 2.42 (1 + the root of 2) times the gap between the last two, however far
    apart they are on the floor. An odometry that read nothing while the car was driven says nothing, as none does: then
    the car may still roll.
    """

    def __init__(self) -> None:
        self._said_ns: int | None = None
        self._moved_ns: int | None = None
        self._gap_ns = 0
        self._counts = False  # whether a speed was read while the car was last driven, or since then

    def step(self, state: VehicleState | None, driven: bool) -> bool:
        """Process the newest state; `driven` is whether the car has throttle. Gives whether it stands."""
        if state is None or state.speed_mps is None:
            self._counts = False
            return False
        if state.t_ns != self._said_ns:
            self._said_ns = state.t_ns
            if abs(state.speed_mps) > STANDING_MPS:
                self._moved(state.t_ns)
        if self._moved_ns is None:
            return False
        quiet_ns = state.t_ns - self._moved_ns
        stands = quiet_ns >= max(STAND_S * _NS_PER_S, STAND_GAPS * self._gap_ns)
        if driven and stands:
            self._counts = False
        return self._counts and stands and not driven

    def _moved(self, t_ns: int) -> None:
        if self._moved_ns is not None:
            self._gap_ns = t_ns - self._moved_ns
            self._counts = True
        self._moved_ns = t_ns
