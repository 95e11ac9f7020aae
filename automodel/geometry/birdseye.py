"""The bird's-eye view: the ground seen from above, by bilinear interpolation with fixed-point weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from automodel.compiled import compiled
from automodel.geometry.ground import GroundCamera
from automodel.types import FloatArray, Image, Int32Array

_BITS = 5  # of a place between two pixels


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """The part of the ground in a bird's-eye view; rows run towards the car, columns to the right.

    Raises ValueError for an empty view.
    """

    x_near_m: float
    x_far_m: float
    half_width_m: float
    m_per_px: float  # across, from column to column
    m_per_row: float = 0.0  # along, from row to row; 0: as across

    def __post_init__(self) -> None:
        if self.m_per_row == 0.0:
            object.__setattr__(self, "m_per_row", self.m_per_px)
        positive = min(self.half_width_m, self.m_per_px, self.m_per_row) > 0
        if not (self.x_far_m > self.x_near_m and positive):
            raise ValueError(f"View: expected x_far_m > x_near_m and positive sizes, got {self}")

    @property
    def height_px(self) -> int:
        """Rows of the view."""
        return max(round((self.x_far_m - self.x_near_m) / self.m_per_row), 1)

    @property
    def width_px(self) -> int:
        """Columns of the view."""
        return max(round(2.0 * self.half_width_m / self.m_per_px), 1)

    def to_px(self, points_m: ArrayLike) -> FloatArray:
        """Body points (..., 2) [m] -> view pixels (..., 2) as (column, row)."""
        p = np.asarray(points_m, dtype=np.float64)
        return np.stack((self.columns(p[..., 1]), self.rows(p[..., 0])), axis=-1)

    def columns(self, y_m: FloatArray) -> FloatArray:
        """Columns (...,) of body y [m]."""
        return (self.half_width_m - y_m) / self.m_per_px - 0.5

    def rows(self, x_m: FloatArray) -> FloatArray:
        """Rows (...,) of body x [m]."""
        return (self.x_far_m - x_m) / self.m_per_row - 0.5

    def to_body(self, pixels: ArrayLike) -> FloatArray:
        """View pixels (..., 2) as (column, row) -> body points (..., 2) [m]."""
        p = np.asarray(pixels, dtype=np.float64)
        x = self.x_far_m - (p[..., 1] + 0.5) * self.m_per_row
        y = self.half_width_m - (p[..., 0] + 0.5) * self.m_per_px
        return np.stack((x, y), axis=-1)


class BirdsEye:
    """Warps images of one calibrated camera into a `View`.

    `mask` (h, w) is 255 where the view's ground lies inside the image, else 0. `rows_per_row` (h,) is how many rows of
    the view show the same row of the image, far away; at least 1.
    """

    def __init__(self, camera: GroundCamera, view: View) -> None:
        self.view, self._shape = view, (camera.camera.height_px, camera.camera.width_px)
        rows, columns = np.mgrid[0 : view.height_px, 0 : view.width_px]
        pixels = camera.ground_to_px(view.to_body(np.stack((columns, rows), axis=-1)))
        inside = camera.camera.inside(pixels)
        self.mask: Image = np.where(inside, 255, 0).astype(np.uint8)
        self.rows_per_row = _rows_per_row(camera, view)
        self._foot = (float(camera.centre_m[0]), float(camera.centre_m[1]))
        size = np.array(self._shape[::-1])
        source = np.clip(np.where(np.isnan(pixels), 0.0, pixels), 0.0, size - 1.0).astype(np.float32)
        self._repeated = np.maximum(2 - np.array(self._shape), 0)  # a single row or column has itself as neighbour
        size = size + self._repeated[::-1]
        fixed = np.rint(source * 2**_BITS).astype(np.int32)
        corner = np.minimum(fixed >> _BITS, size - 2)  # the upper left one of the four pixels about a place
        self._stride = np.uint32(size[0])
        self._corner = (corner[..., 1] * size[0] + corner[..., 0]).astype(np.uint32)
        self._right, self._down = np.moveaxis((fixed - (corner << _BITS)).astype(np.uint8), -1, 0).copy()
        self.warp(np.zeros(self._shape, np.uint8))  # compiled now: no frame waits for it

    def warp(self, image: Image) -> Image:
        """The view (h, w) of a grey image; ground outside the image repeats the image's edge.

        Raises ValueError for an image that is not of the camera's size.
        """
        if image.shape != self._shape:
            raise ValueError(f"BirdsEye: expected an image {self._shape}, got {image.shape}")
        if self._repeated.any():
            image = np.pad(image, [(0, more) for more in self._repeated], mode="edge")
        pixels = image.reshape(-1)
        pixels.flags.writeable = False  # of the one kind that is compiled
        return _warped(pixels, self._stride, self._corner, self._right, self._down)

    def along_rays(self, side: int, least_m: float, rows: float) -> Int32Array:
        """For each pixel (h, w) that which lies on the same ray from the ground below the camera: farther away, or
        nearer for a `side` of -1.

        It is `least_m` [m] away, or `rows` rows of the image where those are longer. Indices of the flat view; -1
        where there is none, or either is outside the image.
        """
        view = self.view
        grid_rows, columns = np.mgrid[0 : view.height_px, 0 : view.width_px]
        ground = view.to_body(np.stack((columns, grid_rows), axis=-1))
        away = ground - self._foot
        step_m = side * np.maximum(rows * self.rows_per_row * view.m_per_row, least_m)[:, None]
        there = np.rint(view.to_px(ground + (step_m / np.hypot(*np.moveaxis(away, -1, 0)))[..., None] * away))
        column, row = np.moveaxis(there.astype(np.intp), -1, 0)
        inside = (row >= 0) & (row < view.height_px) & (column >= 0) & (column < view.width_px) & (self.mask > 0)
        index = row * view.width_px + column
        inside[inside] = self.mask.reshape(-1)[index[inside]] > 0
        return np.where(inside, index, -1).astype(np.int32)


@compiled
def _warped(pixels: Image, stride: np.uint32, corner: NDArray[np.uint32], right: Image, down: Image) -> Image:
    """Between the pixels of an image, flat, at `corner` (h, w), right of it, and in the row of `stride` pixels below.

    `right`, `down` (h, w): the shares of the right and of the lower pixels, in 1 / 2^`_BITS`.
    """
    view = np.empty(corner.shape, np.uint8)
    for i in range(corner.shape[0]):
        for j in range(corner.shape[1]):
            at = corner[i, j]
            below = at + stride
            first, second = np.int32(pixels[at]), np.int32(pixels[at + np.uint32(1)])
            upper = (first << _BITS) + (second - first) * np.int32(right[i, j])
            first, second = np.int32(pixels[below]), np.int32(pixels[below + np.uint32(1)])
            lower = (first << _BITS) + (second - first) * np.int32(right[i, j])
            rounded = (upper << _BITS) + (lower - upper) * np.int32(down[i, j]) + (1 << (2 * _BITS - 1))
            view[i, j] = rounded >> (2 * _BITS)
    return view


def _rows_per_row(camera: GroundCamera, view: View) -> FloatArray:
    """How many rows of a view (h,) show the same row of the image."""
    rows = np.arange(view.height_px)
    middle = view.to_body(np.column_stack((np.full(len(rows), 0.5 * view.width_px), rows)))
    step = np.array((0.5 * view.m_per_row, 0.0))
    moved_px = np.hypot(*(camera.ground_to_px(middle + step) - camera.ground_to_px(middle - step)).T)
    return np.asarray(np.where(moved_px > 0.0, 1.0 / np.maximum(moved_px, 1.0 / len(rows)), 1.0).clip(1.0))
