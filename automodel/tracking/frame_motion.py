"""The motion between two frames, checked: a gap ends what was followed, and a motion that no car makes is unknown."""

from __future__ import annotations

from dataclasses import dataclass

from automodel.estimation.road import LOST_PACE, LOST_TURN_RAD, MAX_GAP_S, MOST_SIGMAS
from automodel.geometry import SE2
from automodel.signals import Motion


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
        self._most_mps, self._most_radps = MOST_SIGMAS * LOST_PACE * lane_width_m, MOST_SIGMAS * LOST_TURN_RAD
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
        speed, yaw_rate = motion.speed_mps, motion.yaw_rate_radps
        known = motion.known and trusted and abs(speed) < self._most_mps and abs(yaw_rate) < self._most_radps  # not NaN
        return FrameMotion(
            distance_m=speed * dt_s if known else 0.0,
            turn_rad=yaw_rate * dt_s if known else 0.0,
            dt_s=dt_s,
            known=known,
        )
