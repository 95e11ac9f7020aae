"""Rows of a picture by the ground that they show: where on a row a distance to the left lies."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from automodel.geometry import GroundCamera
from automodel.types import Floats, Ints


class LaidOutRows:
    """Rows evenly spaced in the picture between two distances ahead, `between_m` in body x.

    `rows` (r,) are their numbers, `ahead_m` (r,) body x of the ground on each, straight in front of the car.
    """

    _PLACES = 65

    def __init__(self, camera: GroundCamera, between_m: tuple[float, float], count: int) -> None:
        self._width = camera.camera.width_px
        x = np.linspace(*between_m, 2000)
        v = camera.ground_to_px(np.column_stack((x, np.zeros_like(x))))[:, 1]
        v = v[np.isfinite(v) & (v >= 0.0) & (v <= camera.camera.height_px - 1.0)]
        if len(v) < 2:
            raise ValueError("pitch_rad: the picture shows no ground where the lane's lines begin")
        rows = np.unique(np.rint(np.linspace(v.max(), v.min(), count)).astype(np.intp))
        u = np.linspace(0.0, self._width - 1.0, self._PLACES)
        self._ground: list[tuple[Floats, Floats, Floats]] = []  # y rising, and x and u there
        shown = []
        for row in rows:
            ground = camera.px_to_ground(np.column_stack((u, np.full_like(u, row))))
            known = np.isfinite(ground[:, 0])
            if known.any():  # else rounded to a row above the horizon, in a picture of a few rows
                self._ground.append((ground[known, 1][::-1], ground[known, 0][::-1], u[known][::-1]))
                shown.append(row)
        if not shown:
            raise ValueError("height_px: the picture has no row that shows where the lane's lines begin")
        self.rows: Ints = np.array(shown, np.intp)
        self.ahead_m: Floats = np.array([np.interp(0.0, y, x) for y, x, _ in self._ground])

    def columns(self, y_m: Floats) -> Floats:
        """Columns (r, n) [px] of distances to the left (r, n) on each row, NaN outside the picture."""
        parts = [
            np.interp(at, y, u, left=np.nan, right=np.nan) for at, (y, _, u) in zip(y_m, self._ground, strict=True)
        ]
        return np.array(parts)

    def pixels(self, y_m: Floats) -> tuple[Ints, NDArray[np.bool_]]:
        """Pixels (r, n), counted row by row, of distances to the left (r, n), and which of them lie in the picture."""
        columns = self.columns(y_m)
        inside = ~np.isnan(columns)
        column = np.rint(np.where(inside, columns, 0.0)).astype(np.intp)
        return self.rows[:, None] * self._width + column, inside

    def x_m(self, y_m: Floats) -> Floats:
        """Body x (r, n) [m] of the ground at distances to the left (r, n) on each row."""
        return np.array([np.interp(at, y, x) for at, (y, x, _) in zip(y_m, self._ground, strict=True)])
