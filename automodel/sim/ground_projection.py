"""Projection of edges on the ground into the image of any calibrated camera."""

from __future__ import annotations

import numpy as np

from automodel.geometry import GroundCamera
from automodel.types import Bools, FloatArray

Edges = tuple[FloatArray, FloatArray]

PIECE_PX = 8.0  # with lens distortion, a straight edge is projected in pieces of about this length


class GroundProjection:
    """Projects closed rings of the ground plane into the image.

    Points that the camera cannot see are moved to the border of the visible region, so that rings stay closed. `row0`
    is the first row that shows ground, `shape` that of the rows from there on, `ground_m` (h, w, 2) [m] the ground
    point of each pixel in the body frame (NaN above the horizon).
    """

    def __init__(self, camera: GroundCamera) -> None:
        self.camera = camera
        model = camera.camera
        rows, columns = np.mgrid[0 : model.height_px, 0 : model.width_px]
        pixels = np.stack((columns, rows), axis=-1).astype(np.float64)
        self.ground_m: FloatArray = camera.px_to_ground(pixels)
        self.seen: Bools = np.isfinite(self.ground_m[..., 0])
        seen_rows = np.flatnonzero(self.seen.any(axis=1))
        # the row above may show ground in its lower half
        self.row0 = max(int(seen_rows[0]) - 1, 0) if len(seen_rows) else model.height_px
        self.shape = (model.height_px - self.row0, model.width_px)
        turn = camera.cam_from_body
        self._cam_from_ground = np.column_stack((turn[:, 0], turn[:, 1], -turn @ camera.centre_m))
        self._near_m = 0.3 * self._nearest_depth_m()
        self._box = self._seen_box() if model.distortion.any() else None

    def _nearest_depth_m(self) -> float:
        ground = self.ground_m[self.seen]
        if not len(ground):
            return 1.0
        return float((ground @ self._cam_from_ground[2, :2] + self._cam_from_ground[2, 2]).min())

    def _seen_box(self) -> tuple[FloatArray, FloatArray, float]:
        """Corners of the box around the image's rays with a margin, and the largest radius of a ray."""
        height, width = self.seen.shape
        corners = np.stack(np.meshgrid(np.arange(width + 1) - 0.5, np.arange(height + 1) - 0.5), axis=-1)
        rays = self.camera.camera.rays(corners)[..., :2]
        rays = rays[np.isfinite(rays[..., 0])]
        low, high = rays.min(axis=0), rays.max(axis=0)
        margin = 0.03 * (high - low)
        return low - margin, high + margin, float(np.hypot(rays[:, 0], rays[:, 1]).max())

    def edges_px(self, edges_m: Edges, ahead_m: FloatArray | None = None) -> Edges:
        """Edges (n, 2) [m] of the body frame as edges [px] for `covered`, rows counted from `row0`.

        `ahead_m` (n,) is the distance that the car has moved ahead of the body frame's origin.
        """
        shift = self._cam_from_ground[:, 2]
        if ahead_m is not None:
            shift = shift - ahead_m[:, None] * self._cam_from_ground[:, 0]
        start, end = (edge @ self._cam_from_ground[:, :2].T + shift for edge in edges_m)
        start, end = self._in_front(start, end)
        start, end = start[:, :2] / start[:, 2:], end[:, :2] / end[:, 2:]
        if self._box is None:
            return self._pinhole_px(start), self._pinhole_px(end)
        start, end = _into_box(start, end, self._box[0], self._box[1])
        start, end = _subdivided(start, end, PIECE_PX / float(self.camera.camera.matrix[0, 0]))
        return self._lens_px(start, self._box[2]), self._lens_px(end, self._box[2])

    def _in_front(self, start: FloatArray, end: FloatArray) -> Edges:
        """Edges in the camera frame; points behind the near line are moved onto it along the ground."""
        start, end = _split(start, end, start[:, 2] - self._near_m, end[:, 2] - self._near_m)
        normal = self._cam_from_ground[2, :2]
        steepness = float(normal @ normal)
        if steepness < 1e-12:
            return start, end
        push = self._cam_from_ground[:, :2] @ normal / steepness
        start = start + np.maximum(self._near_m - start[:, 2:], 0.0) * push
        end = end + np.maximum(self._near_m - end[:, 2:], 0.0) * push
        return start, end

    def _pinhole_px(self, points: FloatArray) -> FloatArray:
        m = self.camera.camera.matrix
        return np.column_stack(
            (m[0, 0] * points[:, 0] + (m[0, 2] + 0.5), m[1, 1] * points[:, 1] + (m[1, 2] + 0.5 - self.row0))
        )

    def _lens_px(self, points: FloatArray, radius: float) -> FloatArray:
        inwards = np.minimum(1.0, radius / np.maximum(np.hypot(points[:, 0], points[:, 1]), 1e-12))
        rays = np.column_stack((points * inwards[:, None], np.ones(len(points))))
        return self.camera.camera.project(rays) + np.array([0.5, 0.5 - self.row0])


def _split(start: FloatArray, end: FloatArray, side_start: FloatArray, side_end: FloatArray) -> Edges:
    """Edges, those whose ends lie on different sides cut in two where the side (n,) is 0."""
    crossing = np.flatnonzero(side_start * side_end < 0.0)
    if not len(crossing):
        return start, end
    t = side_start[crossing] / (side_start[crossing] - side_end[crossing])
    middle = start[crossing] + t[:, None] * (end[crossing] - start[crossing])
    first_end = end.copy()
    first_end[crossing] = middle
    return np.concatenate((start, middle)), np.concatenate((first_end, end[crossing]))


def _into_box(start: FloatArray, end: FloatArray, low: FloatArray, high: FloatArray) -> Edges:
    """Edges cut at the sides of a box; the parts outside are moved onto it."""
    for axis in (0, 1):
        for bound in (low[axis], high[axis]):
            start, end = _split(start, end, start[:, axis] - bound, end[:, axis] - bound)
    return np.clip(start, low, high), np.clip(end, low, high)


def _subdivided(start: FloatArray, end: FloatArray, length: float) -> Edges:
    """Edges cut into equal pieces no longer than `length`."""
    pieces = np.maximum(np.ceil(np.abs(end - start).max(axis=1, initial=0.0) / length), 1.0)
    owner = np.repeat(np.arange(len(start)), pieces.astype(np.intp))
    step = np.arange(len(owner)) - (np.cumsum(pieces) - pieces)[owner]
    along = (end - start)[owner] / pieces[owner, None]
    first = start[owner] + step[:, None] * along
    # the same arithmetic for the end of a piece and the start of the next: no hairline cracks
    last = np.where((step + 1 == pieces[owner])[:, None], end[owner], start[owner] + (step[:, None] + 1.0) * along)
    return first, last
