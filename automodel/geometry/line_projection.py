"""Lines on the ground in the picture: where a point of one lies, how it runs there, and what a shift of it moves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from automodel.geometry.ground import GroundCamera

Floats = NDArray[np.floating[Any]]
Complexes = NDArray[np.complexfloating[Any, Any]]
_NEAREST = 1e-3  # [m] of depth: what is less counts as behind the camera
_NOWHERE_PX = -1e6
_WIDEST = 4.0  # normalised radius, 76 degrees off the axis: no lens model of this kind reaches further


@dataclass(slots=True, eq=False)
class ProjectedLine:
    """Points (n,) of lines in the picture; `values` (5, n) holds `place`, `along` and `area`.

    A point beyond where the lens model folds back lies far outside the picture. What lies behind the camera has no
    meaning, but is finite.
    """

    values: Floats

    @property
    def place(self) -> Floats:
        """Pixels (2, n)."""
        return self.values[:2]

    @property
    def along(self) -> Floats:
        """The image (2, n) of the line's unit tangent [px/m]."""
        return self.values[2:4]

    @property
    def area(self) -> Floats:
        """The image (n,) of a unit square [px^2/m^2], the Jacobian's determinant; below 0: v runs down."""
        return self.values[4]


class LineProjection:
    """Projects ground points and directions of the body frame, with the lens's distortion.

    A point that moves by delta to the left of its line, while it stays on its row of the picture, moves by
    `-area / along_v * delta` pixels along that row: shifted by delta n + tau t its row stays where
    v_n delta + v_t tau = 0, and then u_n delta + u_t tau = (u_n v_t - u_t v_n) / v_t * delta.
    """

    def __init__(self, camera: GroundCamera, dtype: type[np.floating[Any]] = np.float64) -> None:
        self.dtype = dtype
        self._lens = [float(k) for k in camera.camera.distortion] if camera.camera.distortion.any() else None
        matrix = np.eye(3) if self._lens else camera.camera.matrix
        rotation = camera.cam_from_body
        plane = matrix @ np.column_stack((rotation[:, 0], rotation[:, 1], -rotation @ camera.centre_m))
        rows = np.zeros((6, 5))  # of x, y of a point, x, y of its tangent, 1: both in homogeneous coordinates
        rows[:3, :2], rows[3:, 2:4], rows[:3, 4] = plane[:, :2], plane[:, :2], plane[:, 2]
        aside = np.zeros((5, 5))  # to the left of a point: (x - sin, y + cos)
        aside[0, 3], aside[1, 2] = -1.0, 1.0
        shift = rows @ aside
        self._rows: Floats = np.repeat(rows, 2, axis=0).astype(dtype)  # left line, right line, row by row
        self._aside: Floats = np.stack((shift, -shift), axis=1).reshape(12, 5).astype(dtype)
        self._volume = float(np.linalg.det(plane))
        m = camera.camera.matrix
        self._focal: Floats = m.diagonal()[:2, None].astype(dtype)
        self._centre: Floats = m[:2, 2:].astype(dtype)
        self._fold2 = min(camera.camera.max_radius, _WIDEST) ** 2

    def project(self, place: Complexes, along: Complexes, aside_m: float) -> ProjectedLine:
        """Two lines `aside_m` to the left and to the right of the one at `place` (n,) with unit tangents `along`.

        Both as complex numbers x + i y [m]. The first n of the 2 n points are the left line's.
        """
        frame = np.ones((5, len(place)), self.dtype)
        frame[0], frame[1], frame[2], frame[3] = place.real, place.imag, along.real, along.imag
        rows = ((self._aside * aside_m + self._rows) @ frame).reshape(6, -1)
        values = np.empty((5, rows.shape[1]), self.dtype)
        nearness = 1.0 / np.maximum(rows[2], _NEAREST)
        pixels = np.multiply(rows[:2], nearness, out=values[:2])
        tangents = np.multiply(pixels, rows[5], out=values[2:4])
        np.subtract(rows[3:5], tangents, out=tangents)
        tangents *= nearness
        area = np.multiply(nearness, nearness, out=values[4])
        nearness *= self._volume
        area *= nearness
        if self._lens is not None:
            self._bend(values, *self._lens)
        return ProjectedLine(values)

    def _bend(self, values: Floats, k1: float, k2: float, p1: float, p2: float, k3: float) -> None:
        """Brown's distortion of a line in normalised coordinates, and the camera matrix; in place."""
        x, y, along_x, along_y, area = values
        xx, xy, yy = x * x, x * y, y * y
        r2 = xx + yy
        outside = r2 >= self._fold2
        r2 = np.minimum(r2, self._fold2)
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * k1 + r2 * (4.0 * k2 + r2 * (6.0 * k3))
        across = 2.0 * (p1 * x + p2 * y)
        j_xx = radial + slope * xx + 2.0 * p1 * y + 6.0 * p2 * x
        j_xy = slope * xy + across
        j_yy = radial + slope * yy + 6.0 * p1 * y + 2.0 * p2 * x
        area *= (j_xx * j_yy - j_xy * j_xy) * float(self._focal.prod())
        skew_x, skew_y = p2 * (r2 + 2.0 * xx) + 2.0 * p1 * xy, p1 * (r2 + 2.0 * yy) + 2.0 * p2 * xy
        values[:2] = x * radial + skew_x, y * radial + skew_y
        values[2:4] = j_xx * along_x + j_xy * along_y, j_xy * along_x + j_yy * along_y
        values[:4].reshape(2, 2, -1)[:] *= self._focal
        values[:2] += self._centre
        values[:2, outside] = _NOWHERE_PX
