"""motion.csv: the car's motion beside a video or a folder of pictures."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from automodel.config.toml_reader import ConfigError
from automodel.signals import Motion, MotionSource

HEADER = ("t_s", "speed_mps", "yaw_rate_radps")


class MotionTable:
    """Speed [m/s] and yaw rate [rad/s] over time, linear in between; outside the table nothing is known."""

    def __init__(self, t_s: NDArray[np.float64], speed_mps: NDArray[np.float64], yaw_rate_radps: NDArray[np.float64]):
        self._t_s, self._speed_mps, self._yaw_rate_radps = t_s, speed_mps, yaw_rate_radps

    def at(self, t_ns: int) -> Motion:
        """The motion at a frame's time; its source is RECORDED, or NONE before the first row and after the last."""
        t_s = t_ns * 1e-9
        if not self._t_s[0] - 1e-9 <= t_s <= self._t_s[-1] + 1e-9:
            return Motion(t_ns=t_ns, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)
        return Motion(
            t_ns=t_ns,
            speed_mps=float(np.interp(t_s, self._t_s, self._speed_mps)),
            yaw_rate_radps=float(np.interp(t_s, self._t_s, self._yaw_rate_radps)),
            source=MotionSource.RECORDED,
        )


def read_motion_csv(path: str | Path) -> MotionTable:
    """Read `t_s,speed_mps,yaw_rate_radps`; t_s counts from the first frame. Raises ConfigError with file and line."""
    try:
        with open(path, encoding="utf-8-sig", newline="") as file:
            rows = list(csv.reader(file))
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    if not rows or tuple(cell.strip() for cell in rows[0]) != HEADER:
        raise ConfigError(f"{path}:1: the first line must be {','.join(HEADER)}")
    table = [_numbers(path, line, row) for line, row in enumerate(rows[1:], 2) if row]
    if not table:
        raise ConfigError(f"{path}: no rows below the header")
    values = np.array(table, dtype=np.float64)
    backwards = np.flatnonzero(np.diff(values[:, 0]) <= 0)
    if len(backwards):
        raise ConfigError(f"{path}:{int(backwards[0]) + 3}: t_s must rise from row to row")
    return MotionTable(values[:, 0], values[:, 1], values[:, 2])


def _numbers(path: str | Path, line: int, row: list[str]) -> list[float]:
    if len(row) != len(HEADER):
        raise ConfigError(f"{path}:{line}: {len(row)} values where {len(HEADER)} are wanted")
    values = []
    for name, cell in zip(HEADER, row, strict=True):
        try:
            value = float(cell)
        except ValueError:
            value = float("nan")
        if not np.isfinite(value):
            raise ConfigError(f"{path}:{line}: {name} is {cell.strip()!r} where a finite number is wanted")
        values.append(value)
    return values
