"""Steering by torque: a closed loop on the measured road-wheel angle, for cars that take no angle."""

from __future__ import annotations

import math

from automodel.config import CanConfig
from firmware_link.can_limits import lateral_accel_mps2, limited_torque_nm


class TorqueSteering:
    """PI on the angle's error, and feed-forward of the torque that turns the tyres back at the lateral acceleration.

    The integral stops where the torque is limited. `step` gives the torque [Nm], positive to the left.
    """

    def __init__(self, config: CanConfig, wheelbase_m: float) -> None:
        self._config, self._wheelbase_m = config, wheelbase_m
        self._integral_nm = 0.0
        self.torque_nm = 0.0

    def reset(self) -> None:
        """No torque: nobody steers."""
        self._integral_nm = self.torque_nm = 0.0

    def step(self, wanted_rad: float, measured_rad: float, speed_mps: float, dt_s: float) -> float:
        """The torque that brings the wheels from the measured to the wanted angle; limited in size and rate."""
        config, error_rad = self._config, wanted_rad - measured_rad
        integral_nm = self._integral_nm + config.torque_integral_nmprads * error_rad * dt_s
        integral_nm = min(max(integral_nm, -config.torque_max_nm), config.torque_max_nm)
        accel_mps2 = lateral_accel_mps2(wanted_rad, speed_mps, self._wheelbase_m)
        ahead_nm = config.torque_per_accel_nms2pm * accel_mps2 + config.torque_gain_nmprad * error_rad
        asked_nm = ahead_nm + integral_nm
        self.torque_nm = limited_torque_nm(
            asked_nm, self.torque_nm, dt_s, config.torque_max_nm, config.torque_rate_max_nmps
        )
        if math.isfinite(asked_nm) and (self.torque_nm == asked_nm or error_rad * (self.torque_nm - asked_nm) > 0):
            self._integral_nm = integral_nm
        return self.torque_nm
