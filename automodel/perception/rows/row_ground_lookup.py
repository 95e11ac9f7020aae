"""Image rows and the ground that they show: pixels at lateral distances, without projecting anything in a step."""

from __future__ import annotations

import numpy as np

from automodel.geometry import GroundCamera
from automodel.types import Bools, Floats, Ints

GENTLE_LANES = 15.0  # radius of the tightest bend from which on lines are straight enough for `LineIntegralSearch`


class RowGroundLookup:
    """Rows evenly spaced in the image between two distances ahead, `between_m` in body x, and the ground they show.

    `rows` (r,) are their indices, `ahead_m` (r,) body x [m] of the ground on each straight ahead. Raises ValueError
    where the image does not show that ground.
    """

    def __init__(self, camera: GroundCamera, between_m: tuple[float, float], count: int) -> None:
        self._width = camera.camera.width_px
        x = np.linspace(*between_m, 2000)
        v = camera.ground_to_px(np.column_stack((x, np.zeros_like(x))))[:, 1]
        v = v[np.isfinite(v) & (v >= 0.0) & (v <= camera.camera.height_px - 1.0)]
        if len(v) < 2:
            raise ValueError("pitch_rad: the image shows no ground where the lane's lines start")
        rows = np.unique(np.rint(np.linspace(v.max(), v.min(), count)).astype(np.intp))
        u = np.arange(self._width, dtype=np.float64)
        self._ground: list[tuple[Floats, Floats]] = []  # increasing y, and u there
        shown, ahead = [], []
        for row in rows:
            ground = camera.px_to_ground(np.column_stack((u, np.full_like(u, row))))
            known = np.isfinite(ground[:, 0])
            if known.any():  # else rounded to a row above the horizon, in an image of a few rows
                y, x = ground[known, 1][::-1], ground[known, 0][::-1]
                self._ground.append((y, u[known][::-1]))
                shown.append(row)
                ahead.append(np.interp(0.0, y, x))
        if not shown:
            raise ValueError("height_px: the image has no row that shows where the lane's lines start")
        self.rows: Ints = np.array(shown, np.intp)
        self.ahead_m: Floats = np.array(ahead)

    def pixels(self, y_m: Floats) -> tuple[Ints, Bools]:
        """Pixels (r, n), flat indices, at lateral distances y (r, n) [m], and which of them lie in the image."""
        columns = np.array(
            [np.interp(at, y, u, left=np.nan, right=np.nan) for at, (y, u) in zip(y_m, self._ground, strict=True)]
        )
        inside = ~np.isnan(columns)
        column = np.rint(np.where(inside, columns, 0.0)).astype(np.intp)
        return self.rows[:, None] * self._width + column, inside
