"""Projection of lines on the ground into the image: pixel, tangent, and displacement by a lateral shift."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from automodel.compiled import compiled
from automodel.geometry.ground import GroundCamera
from automodel.types import Complexes, Floats

View = tuple[Floats, Floats, float, float]
_NEAREST = 1e-3  # [m] least depth; points nearer are behind the camera
_NOWHERE_PX = -1e6
_WIDEST = 4.0  # normalised radius, 76 degrees off the axis: the model does not hold beyond


@dataclass(slots=True, eq=False)
class ProjectedLine:
    """Points (n,) of lines in the image; `values` (5, n) holds `place`, `along` and `area`.

    A point beyond the fold of the lens model gets a place far outside the image. Values of points behind the camera are
    finite but have no meaning.
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

    A point that moves by delta to the left of its line and stays on its image row moves along that row by
    `-area / along_v * delta` pixels: after a shift by delta n + tau t the row is the same where
    v_n delta + v_t tau = 0, and then u_n delta + u_t tau = (u_n v_t - u_t v_n) / v_t * delta.

    `view` holds the camera's parameters for `project_lines`.
    """

    def __init__(self, camera: GroundCamera, dtype: type[np.floating[Any]] = np.float64) -> None:
        self.dtype = dtype
        rotation, matrix = camera.cam_from_body, camera.camera.matrix
        # (x, y, 1) on the ground in the body frame -> cam frame
        plane = np.column_stack((rotation[:, 0], rotation[:, 1], -rotation @ camera.centre_m))
        lens = [*camera.camera.distortion, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]
        fold2 = min(camera.camera.max_radius, _WIDEST) ** 2
        self.view: View = plane.astype(dtype), np.array(lens, dtype), float(np.linalg.det(plane)), fold2

    def project(self, place: Complexes, along: Complexes, lateral_m: float | Floats) -> ProjectedLine:
        """Project the two lines `lateral_m`, one or (n,), to the left and to the right of the points `place` (n,).

        `place` and the unit tangents `along` (n,) are complex numbers x + i y [m] in the body frame. The first n of the
        2 n results belong to the left line.
        """
        lateral = np.broadcast_to(np.asarray(lateral_m, self.dtype), len(place)).copy()
        return ProjectedLine(project_lines(self.view, place, along, lateral))


@compiled
def project_lines(view: View, place: Complexes, along: Complexes, lateral_m: Floats) -> Floats:
    """The values (5, 2 n) of `LineProjection.project`, with Brown's distortion.

    `view`: the matrix (3, 3) from the ground to the cam frame; k1, k2, p1, p2, k3, focal lengths and centre [px] (9,);
    the matrix's determinant; the squared normalised radius at which the lens model folds.
    """
    plane, lens, volume, fold2 = view
    k1, k2, p1, p2, k3, focal_x, focal_y, centre_x, centre_y = lens
    n = len(place)
    values = np.empty((5, 2 * n), plane.dtype)
    for i in range(2 * n):
        away = lateral_m[i % n] if i < n else -lateral_m[i % n]
        t = along[i % n]
        x0, y0 = place[i % n].real - away * t.imag, place[i % n].imag + away * t.real
        depth = plane[2, 0] * x0 + plane[2, 1] * y0 + plane[2, 2]
        nearness = 1.0 / max(depth, _NEAREST)
        x = (plane[0, 0] * x0 + plane[0, 1] * y0 + plane[0, 2]) * nearness
        y = (plane[1, 0] * x0 + plane[1, 1] * y0 + plane[1, 2]) * nearness
        receding = plane[2, 0] * t.real + plane[2, 1] * t.imag
        along_x = (plane[0, 0] * t.real + plane[0, 1] * t.imag - x * receding) * nearness
        along_y = (plane[1, 0] * t.real + plane[1, 1] * t.imag - y * receding) * nearness
        xx, xy, yy = x * x, x * y, y * y
        outside = xx + yy >= fold2
        r2 = min(xx + yy, fold2)
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * k1 + r2 * (4.0 * k2 + r2 * (6.0 * k3))
        across = 2.0 * (p1 * x + p2 * y)
        j_xx = radial + slope * xx + 2.0 * p1 * y + 6.0 * p2 * x
        j_xy = slope * xy + across
        j_yy = radial + slope * yy + 6.0 * p1 * y + 2.0 * p2 * x
        values[0, i] = (x * radial + p2 * (r2 + 2.0 * xx) + 2.0 * p1 * xy) * focal_x + centre_x
        values[1, i] = (y * radial + p1 * (r2 + 2.0 * yy) + 2.0 * p2 * xy) * focal_y + centre_y
        values[2, i] = (j_xx * along_x + j_xy * along_y) * focal_x
        values[3, i] = (j_xy * along_x + j_yy * along_y) * focal_y
        values[4, i] = volume * nearness**3 * (j_xx * j_yy - j_xy * j_xy) * focal_x * focal_y
        if outside:
            values[0, i] = values[1, i] = _NOWHERE_PX
    return values
