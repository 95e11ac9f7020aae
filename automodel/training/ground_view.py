"""The ground as a camera sees it, pixel by pixel: where each pixel looks, and tiled pictures laid on the ground."""

from __future__ import annotations

import math

import cv2
import numpy as np

from automodel.geometry import GroundCamera
from automodel.types import FloatImage, Image

_CELL_PX = 8  # rays are computed this far apart and interpolated between
_TILE_PX = 512
_LEVELS = 6  # a tile and its halvings


class GroundView:
    """What each pixel (h, w) of a camera looks at.

    `share` is how much of the pixel is ground (1 below the horizon), `distance` how far away it is along the ground and
    `rise` the tangent of the ray's elevation. Lengths in the camera's own unit.
    """

    def __init__(self, camera: GroundCamera, farthest: float) -> None:
        width, height = camera.camera.width_px, camera.camera.height_px
        self.height = float(camera.centre_m[2])
        rays = _ray_grid(camera, width, height)
        level = cv2.magnitude(rays[..., 0], rays[..., 1])
        self.rise: FloatImage = np.asarray(rays[..., 2] / np.maximum(level, 1e-6), dtype=np.float32)
        focal = float(camera.camera.matrix[1, 1])
        lowest = np.float32(self.height / farthest)
        self.share: FloatImage = np.clip(0.5 - (self.rise + lowest) * focal, 0.0, 1.0)
        down = np.maximum(-self.rise, lowest)
        self.distance: FloatImage = self.height / down
        scale = self.distance / np.maximum(level, 1e-6)
        self._x: FloatImage = rays[..., 0] * scale
        self._y: FloatImage = rays[..., 1] * scale
        across = math.sqrt(float(camera.camera.matrix[0, 0]) * focal)
        # the ground under a pixel: distance / f across and distance^2 / (height f) along, here their mean
        self._log_size: FloatImage = np.log2(
            np.maximum(self.distance, self.height) ** 1.5 / (math.sqrt(self.height) * across)
        )

    def laid(self, atlas: Image, size: float, turn_rad: float, shift: tuple[float, float]) -> Image:
        """An `atlas` of a tile whose side is `size` long, repeated over the ground, as the camera sees it (h, w)."""
        cos, sin = math.cos(turn_rad) / size, math.sin(turn_rad) / size
        u = self._x * np.float32(cos) + self._y * np.float32(sin) + np.float32(shift[0])
        v = self._y * np.float32(cos) - self._x * np.float32(sin) + np.float32(shift[1])
        level = np.clip(self._log_size + np.float32(math.log2(_TILE_PX / size) + 0.3), 0.0, _LEVELS - 1)
        index = level.astype(np.intp)
        side = _SIDES[index]
        u = (u - np.floor(u)) * side + _LEFTS[index]
        v = (v - np.floor(v)) * side + _TOPS[index]
        return np.asarray(cv2.remap(atlas, u, v, cv2.INTER_LINEAR), dtype=np.uint8)


def _ray_grid(camera: GroundCamera, width: int, height: int) -> FloatImage:
    """Directions (h, w, 3) of the body frame in which the pixels look, not of unit length."""
    columns = np.arange(-1, width // _CELL_PX + 3) * float(_CELL_PX)
    rows = np.arange(-1, height // _CELL_PX + 3) * float(_CELL_PX)
    grid = np.stack(np.meshgrid(columns, rows), axis=-1)
    rays = camera.camera.rays(grid)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    body = np.nan_to_num(rays @ camera.cam_from_body, nan=1e-3).astype(np.float32)
    back = np.array([[1 / _CELL_PX, 0.0, 1.0], [0.0, 1 / _CELL_PX, 1.0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(body, back, (width, height), flags=flags), dtype=np.float32)


def _layout() -> tuple[list[int], list[int], list[int]]:
    sides = [_TILE_PX >> k for k in range(_LEVELS)]
    lefts = [0] + [_TILE_PX + 2] * (_LEVELS - 1)
    tops = [0, 0]
    for side in sides[1:-1]:
        tops.append(tops[-1] + side + 2)
    return sides, lefts, tops


_SIDES, _LEFTS, _TOPS = (np.array(values, dtype=np.float32) for values in _layout())


def atlas(tile: Image) -> Image:
    """A tile (512, 512) and its halvings in one picture, each with a border that repeats it."""
    picture = np.empty((_TILE_PX + 2, _TILE_PX + 2 + _TILE_PX // 2 + 2), dtype=np.uint8)
    level = tile
    for left, top in zip(_LEFTS.astype(int), _TOPS.astype(int), strict=True):
        side = level.shape[0]
        picture[top : top + side, left : left + side] = level
        picture[top + side, left : left + side] = level[0]
        picture[top : top + side, left + side] = level[:, 0]
        picture[top + side, left + side] = level[0, 0]
        level = np.asarray(cv2.resize(level, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return picture
