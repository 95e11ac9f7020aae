"""Whether the car turns as it is steered: by the gyro, where there is one."""

from __future__ import annotations

import math

from automodel.signals import Motion, MotionSource, VehicleState

MIN_MPS = 0.4  # a slower car turns too little to tell
APART_RADPS = 0.5  # between the yaw rates measured and expected: what a servo a few degrees off its table makes
APART_SHARE = 0.4  # and this share of the expected one: tyres slip
LASTING_S = 0.25  # a servo's lag is over in a fifth of this
KEPT_S = 0.5  # the fault outlives the moment: a car that is held slows down, and then turns too little to tell


class SteeringCheck:
    """Compares the gyro's yaw rate with that of a bicycle, v tan(delta) / L (Rajamani 2012, section 2.2).

    delta [rad] is the steering that the vehicle says it was told last, v [m/s] its speed, L the wheelbase [m]. A servo
    that is stuck, or a linkage that has come off, shows wherever the road is not as straight as the wheels stand.
    """

    def __init__(self, wheelbase_m: float) -> None:
        self._wheelbase_m = wheelbase_m
        self._apart_since_ns: int | None = None
        self._wrong_ns: int | None = None

    def step(self, motion: Motion, state: VehicleState | None) -> str | None:
        """What is wrong at the motion's time; None while all is well, or nothing can be said."""
        t_ns = motion.t_ns
        if not self._apart(motion, state):
            self._apart_since_ns = None
        elif self._apart_since_ns is None:
            self._apart_since_ns = t_ns
        if self._apart_since_ns is not None and t_ns - self._apart_since_ns >= LASTING_S * 1e9:
            self._wrong_ns = t_ns
        if self._wrong_ns is None or t_ns - self._wrong_ns >= KEPT_S * 1e9:
            return None
        return "the car does not turn as it is steered; look at the servo and its linkage"

    def _apart(self, motion: Motion, state: VehicleState | None) -> bool:
        if motion.source is not MotionSource.MEASURED or abs(motion.speed_mps) < MIN_MPS:
            return False
        if state is None or state.steering_rad is None:
            return False
        expected = motion.speed_mps * math.tan(state.steering_rad) / self._wheelbase_m
        return abs(motion.yaw_rate_radps - expected) > APART_RADPS + APART_SHARE * abs(expected)
