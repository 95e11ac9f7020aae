"""[calibration]: what vouches for the calibrated sections."""

from __future__ import annotations

import datetime
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationRecord:
    """What vouches for a calibrated section: when, how, and how large its error was (a text with units)."""

    date: datetime.date
    method: str
    residual: str


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationRecords:
    """The records that the calibration commands leave; None: never calibrated."""

    camera: CalibrationRecord | None = None  # [camera.intrinsics]
    ground: CalibrationRecord | None = None  # [camera.extrinsics]
    servo: CalibrationRecord | None = None  # [link.servo]
    odometry: CalibrationRecord | None = None  # [vehicle] ticks_per_m, [link.motor]
    stereo: CalibrationRecord | None = None  # [camera.right]
