"""Pinhole camera with Brown's distortion (OpenCV's model: k1 k2 p1 p2 k3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from automodel.config import CameraConfig, Intrinsics
from automodel.types import FloatArray


class CameraModel:
    """Projects points of the cam frame (x right, y down, z ahead) to pixels, integers at pixel centres.

    `max_radius` is the normalised radius at which the lens model folds: beyond it two rays share a pixel.
    """

    def __init__(self, intrinsics: Intrinsics, width_px: int, height_px: int) -> None:
        self.width_px, self.height_px = width_px, height_px
        self.matrix: FloatArray = np.array(
            [
                [intrinsics.fx_px, 0.0, intrinsics.cx_px],
                [0.0, intrinsics.fy_px, intrinsics.cy_px],
                [0.0, 0.0, 1.0],
            ]
        )
        self.distortion: FloatArray = np.array(intrinsics.distortion, dtype=np.float64)
        self.max_radius = self._fold_radius()

    @classmethod
    def from_config(cls, camera: CameraConfig) -> CameraModel:
        """The camera of car.toml."""
        return cls(camera.intrinsics, camera.width_px, camera.height_px)

    def project(self, points_cam: ArrayLike) -> FloatArray:
        """Points (..., 3) [m] -> pixels (..., 2); NaN behind the camera and beyond where the lens model folds back."""
        points = np.asarray(points_cam, dtype=np.float64)
        z = points[..., 2]
        ahead = z > 1e-6
        safe = np.where(ahead, z, 1.0)
        xn, yn = points[..., 0] / safe, points[..., 1] / safe
        radius2 = xn * xn + yn * yn
        seen = ahead & (radius2 <= self.max_radius**2)
        xn, yn = np.where(seen, xn, 0.0), np.where(seen, yn, 0.0)
        xd, yd = self._distort(xn, yn)
        m = self.matrix
        pixels = np.stack((m[0, 0] * xd + m[0, 2], m[1, 1] * yd + m[1, 2]), axis=-1)
        return np.where(seen[..., None], pixels, np.nan)

    def rays(self, pixels: ArrayLike) -> FloatArray:
        """Pixels (..., 2) -> rays (..., 3) in the cam frame with z = 1; NaN where the lens model has no ray."""
        p = np.asarray(pixels, dtype=np.float64)
        m = self.matrix
        xd, yd = (p[..., 0] - m[0, 2]) / m[0, 0], (p[..., 1] - m[1, 2]) / m[1, 1]
        x, y = xd, yd
        if self.distortion.any():
            x, y = self._undistort(xd, yd)
        return np.stack((x, y, np.where(np.isnan(x), np.nan, 1.0)), axis=-1)

    def _distort(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        k1, k2, p1, p2, k3 = self.distortion
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return (
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        )

    def _undistort(self, xd: FloatArray, yd: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The inverse of `_distort` by Newton's method within the fold radius; NaN elsewhere."""
        k1, k2, p1, p2, k3 = self.distortion
        found_x, found_y = xd.flatten(), yd.flatten()
        left = np.arange(found_x.size)  # places that still move
        for _ in range(20):
            x, y = found_x[left], found_y[left]
            r2 = x * x + y * y
            radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
            slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2))  # d radial / d r2 * 2
            ex, ey = self._distort(x, y)
            ex, ey = ex - xd.flat[left], ey - yd.flat[left]
            jxx = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
            jxy = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
            jyy = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
            det = jxx * jyy - jxy * jxy
            det = np.where(np.abs(det) > 1e-9, det, 1e-9)
            x_next, y_next = x - (jyy * ex - jxy * ey) / det, y - (jxx * ey - jxy * ex) / det
            shrink = np.minimum(1.0, self.max_radius / np.maximum(np.hypot(x_next, y_next), 1e-12))
            found_x[left], found_y[left] = x_next, y_next = x_next * shrink, y_next * shrink
            left = left[np.maximum(np.abs(x_next - x), np.abs(y_next - y)) > 1e-15]  # rounding
            if not len(left):
                break
        x, y = found_x.reshape(xd.shape), found_y.reshape(yd.shape)
        ex, ey = self._distort(x, y)
        found = np.hypot(ex - xd, ey - yd) < 1e-7
        return np.where(found, x, np.nan), np.where(found, y, np.nan)

    def inside(self, pixels: ArrayLike, margin_px: float = 0.0) -> NDArray[np.bool_]:
        """Which pixels (..., 2) lie in the image, at least `margin_px` from its edge; False for NaN."""
        p = np.asarray(pixels, dtype=np.float64)
        u, v = p[..., 0], p[..., 1]
        return (
            (u >= margin_px - 0.5)
            & (u <= self.width_px - 0.5 - margin_px)
            & (v >= margin_px - 0.5)
            & (v <= self.height_px - 0.5 - margin_px)
        )

    def _fold_radius(self) -> float:
        """The normalised radius up to which the radial polynomial rises, infinite where it always does."""
        k1, k2, _, _, k3 = self.distortion
        radius = np.linspace(0.0, 10.0, 2001)
        r2 = radius * radius
        slope = 1.0 + r2 * (3.0 * k1 + r2 * (5.0 * k2 + r2 * 7.0 * k3))
        falling = np.flatnonzero(slope <= 0.0)
        return float(radius[falling[0]]) * 0.99 if len(falling) else np.inf
