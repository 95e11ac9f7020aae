"""The motion between two frames, checked: a gap ends what was followed, and a motion that no car makes is unknown."""

from __future__ import annotations

from dataclasses import dataclass

from automodel.estimation.road import MAX_GAP_S
from automodel.geometry import SE2
from automodel.signals import Motion

MAX_LANES = 6.0  # lane widths driven between two frames: 300 m/s on a full-size lane at 15 Hz; more is a broken sensor
MAX_TURN_RAD = 1.5  # turned between two frames: a car that spins has lost its lane anyway


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameMotion:
    """The body's motion between two frames: distance [m] along an arc, turn [rad], time [s].

    Where it is not `known`, distance and turn are 0 and say nothing.
    """

    distance_m: float
    turn_rad: float
    dt_s: float
    known: bool

    @property
    def before_from_after(self) -> SE2:
        """The pose of the body after the motion in the body frame before it."""
        return SE2.arc(self.distance_m, self.turn_rad)

    @property
    def after_from_before(self) -> SE2:
        """The inverse: what moves points into the new body frame."""
        return self.before_from_after.inverse()


class FrameMotions:
    """From frame to frame: `step` gives the motion since the last one, None for the first and after a gap."""

    def __init__(self, lane_width_m: float) -> None:
        self._most_m = MAX_LANES * lane_width_m
        self.reset()

    def reset(self) -> None:
        """Forget the last frame."""
        self._last_ns: int | None = None

    def step(self, t_ns: int, motion: Motion, trusted: bool = True) -> FrameMotion | None:
        """The motion up to a frame; None where there is no frame before it, a long gap, or time went back."""
        last, self._last_ns = self._last_ns, t_ns
        if last is None or not 0 < t_ns - last <= MAX_GAP_S * 1e9:
            return None
        dt_s = (t_ns - last) * 1e-9
        distance, turn = motion.speed_mps * dt_s, motion.yaw_rate_radps * dt_s
        known = motion.known and trusted and abs(distance) < self._most_m and abs(turn) < MAX_TURN_RAD  # not NaN
        return FrameMotion(
            distance_m=distance if known else 0.0, turn_rad=turn if known else 0.0, dt_s=dt_s, known=known
        )
