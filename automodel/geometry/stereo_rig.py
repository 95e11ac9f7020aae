"""Two cameras over a ground plane that is not quite where the calibration puts it: the car pitches, rolls and bounces.

A plane is the cameras' pose over it: their height [m], pitch [rad] (positive: they look further down) and roll [rad]
(positive: the right side is down), as increments of the calibrated ones. They turn about the middle between them.
"""

from __future__ import annotations

import copy
import math
from typing import NamedTuple

import numpy as np

from automodel.compiled import compiled
from automodel.geometry.ground import GroundCamera
from automodel.types import FloatArray

_NEWTON, _EXACT = 20, 1e-9  # iterations at most; normalised error at which they end
_LEVEL = 1e-6  # a direction that falls by less per unit of depth does not meet the ground


class Plane(NamedTuple):
    """The cameras' height [m] and attitude [rad] over the ground, beyond the calibrated ones."""

    height_m: float = 0.0
    pitch_rad: float = 0.0
    roll_rad: float = 0.0

    @property
    def level_from_body(self) -> FloatArray:
        """Rotation (3, 3) from the body frame of the car as it stands to one whose z axis is the plane's normal."""
        cp, sp = math.cos(self.pitch_rad), math.sin(self.pitch_rad)
        cr, sr = math.cos(self.roll_rad), math.sin(self.roll_rad)
        pitch = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
        roll = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
        return np.asarray(pitch @ roll)


class Eye(NamedTuple):
    """A camera as compiled functions take it.

    `rotation` (3, 3) from the level body frame to the cam frame, `centre_m` (3,) in the level body frame; `lens` (9,):
    k1, k2, p1, p2, k3, focal lengths and centre [px]; `fold2`: squared normalised radius at which the lens model folds.
    """

    rotation: FloatArray
    centre_m: FloatArray
    lens: FloatArray
    fold2: float

    @classmethod
    def of(cls, camera: GroundCamera) -> Eye:
        """That of a camera over the ground z = 0."""
        matrix = camera.camera.matrix
        lens = np.array([*camera.camera.distortion, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
        rotation = np.ascontiguousarray(camera.cam_from_body)
        return cls(rotation, camera.centre_m.copy(), lens, min(camera.camera.max_radius, 1e3) ** 2)


class StereoRig:
    """The calibrated cameras of a pair, in the body frame of a car at rest."""

    def __init__(self, left: GroundCamera, right: GroundCamera) -> None:
        self.left, self.right = left, right
        self.middle_m: FloatArray = 0.5 * (left.centre_m + right.centre_m)

    @property
    def baseline_m(self) -> float:
        """Distance between the optical centres [m]."""
        return float(np.linalg.norm(self.right.centre_m - self.left.centre_m))

    def over(self, plane: Plane) -> tuple[GroundCamera, GroundCamera]:
        """Both cameras over a plane, as if that were the ground z = 0 of the body frame."""
        return self._over(self.left, plane), self._over(self.right, plane)

    def _over(self, camera: GroundCamera, plane: Plane) -> GroundCamera:
        turn = plane.level_from_body
        there = copy.copy(camera)
        there.cam_from_body = camera.cam_from_body @ turn.T
        there.centre_m = turn @ (camera.centre_m - self.middle_m) + self.middle_m
        there.centre_m[2] += plane.height_m
        return there


@compiled
def bearings(eye: Eye, pixels: FloatArray) -> FloatArray:
    """Pixels (n, 2) -> directions (n, 3) in the level body frame, of depth 1 along the optical axis.

    Brown's distortion is inverted by Newton's method; a pixel outside the lens model gets NaN.
    """
    k1, k2, p1, p2, k3, focal_x, focal_y, centre_x, centre_y = eye.lens
    found = np.empty((len(pixels), 3))
    for i in range(len(pixels)):
        xd, yd = (pixels[i, 0] - centre_x) / focal_x, (pixels[i, 1] - centre_y) / focal_y
        x, y, error = xd, yd, math.inf
        for _ in range(_NEWTON):
            xx, xy, yy = x * x, x * y, y * y
            r2 = xx + yy
            radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
            slope = 2.0 * k1 + r2 * (4.0 * k2 + r2 * (6.0 * k3))
            across = 2.0 * (p1 * x + p2 * y)
            error_x = x * radial + p2 * (r2 + 2.0 * xx) + 2.0 * p1 * xy - xd
            error_y = y * radial + p1 * (r2 + 2.0 * yy) + 2.0 * p2 * xy - yd
            error = math.hypot(error_x, error_y)
            if error < _EXACT:
                break
            j_xx = radial + slope * xx + 2.0 * p1 * y + 6.0 * p2 * x
            j_xy = slope * xy + across
            j_yy = radial + slope * yy + 6.0 * p1 * y + 2.0 * p2 * x
            volume = j_xx * j_yy - j_xy * j_xy
            x -= (j_yy * error_x - j_xy * error_y) / volume
            y -= (j_xx * error_y - j_xy * error_x) / volume
        if not (error < _EXACT and x * x + y * y < eye.fold2):
            x = y = math.nan
        for k in range(3):
            found[i, k] = x * eye.rotation[0, k] + y * eye.rotation[1, k] + eye.rotation[2, k]
    return found


@compiled
def image_of(eye: Eye, x: float, y: float, z: float) -> tuple[float, float]:
    """The pixel of a point [m] of the level body frame; NaN behind the camera and beyond the lens model."""
    k1, k2, p1, p2, k3, focal_x, focal_y, centre_x, centre_y = eye.lens
    dx, dy, dz = x - eye.centre_m[0], y - eye.centre_m[1], z - eye.centre_m[2]
    turn = eye.rotation
    depth = turn[2, 0] * dx + turn[2, 1] * dy + turn[2, 2] * dz
    if depth <= 0.0:
        return math.nan, math.nan
    a = (turn[0, 0] * dx + turn[0, 1] * dy + turn[0, 2] * dz) / depth
    b = (turn[1, 0] * dx + turn[1, 1] * dy + turn[1, 2] * dz) / depth
    aa, ab, bb = a * a, a * b, b * b
    r2 = aa + bb
    if r2 >= eye.fold2:
        return math.nan, math.nan
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = (a * radial + p2 * (r2 + 2.0 * aa) + 2.0 * p1 * ab) * focal_x + centre_x
    v = (b * radial + p1 * (r2 + 2.0 * bb) + 2.0 * p2 * ab) * focal_y + centre_y
    return u, v


@compiled
def images_of_ground(eye: Eye, points: FloatArray) -> FloatArray:
    """The pixels (n, 2) of points (n, 2) [m] on the ground z = 0; NaN behind the camera and beyond the lens model."""
    found = np.empty(points.shape)
    for i in range(len(points)):
        found[i, 0], found[i, 1] = image_of(eye, points[i, 0], points[i, 1], 0.0)
    return found


@compiled
def on_ground(eye: Eye, directions: FloatArray) -> FloatArray:
    """Where directions (n, 3) of the level body frame meet the ground z = 0: (n, 2) [m]; NaN above the horizon."""
    found = np.full((len(directions), 2), math.nan)
    for i in range(len(directions)):
        if directions[i, 2] < -_LEVEL:
            away = -eye.centre_m[2] / directions[i, 2]
            found[i, 0] = eye.centre_m[0] + away * directions[i, 0]
            found[i, 1] = eye.centre_m[1] + away * directions[i, 1]
    return found
