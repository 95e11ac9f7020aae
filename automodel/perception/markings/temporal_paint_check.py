"""Tells paint from reflections: paint stays where it is on the ground, a reflection goes with the car."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np

from automodel.geometry import SE2, View
from automodel.types import Image


@dataclass(slots=True)
class _Past:
    """Where a view was in sight and bare, 255, and where the car was then."""

    bare: Image
    start_from_then: SE2
    way_m: float


class GroundCheck:
    """Compares a filtered view with what was bright a lane's width of way ago.

    Lamps and windows mirrored in a shiny floor look like pieces of lines from above. The odometry says where a place
    was in the earlier view; if that was in sight and bare then, what is there now is not painted on the ground. Places
    that were not in sight then pass, and so does everything while the car has not gone far enough.
    """

    WAY_LANES = 1.0  # way between the two looks
    EVERY_LANES = 0.1  # way from one remembered view to the next
    TOLERANCE_MARKINGS = 1.0  # how far beside a line a point may lie

    def __init__(self, view: View, visible: Image, lane_width_m: float, marking_width_m: float) -> None:
        self.view, self._visible = view, visible
        self._way_m, self._every_m = self.WAY_LANES * lane_width_m, self.EVERY_LANES * lane_width_m
        across = 2 * round(self.TOLERANCE_MARKINGS * marking_width_m / view.m_per_px) + 1
        along = 2 * round(self.TOLERANCE_MARKINGS * marking_width_m / view.m_per_row) + 1
        self._kernel = np.ones((along, across), np.uint8)
        self._past: deque[_Past] = deque()
        self.forget()

    def forget(self) -> None:
        """Forget all views."""
        self._past.clear()
        self._start_from_now, self._driven_m = SE2(), 0.0

    def move(self, before_from_after: SE2, distance_m: float) -> None:
        """The car has moved."""
        self._start_from_now = self._start_from_now @ before_from_after
        self._driven_m += abs(distance_m)
        while len(self._past) > 1 and self._driven_m - self._past[1].way_m >= self._way_m:
            self._past.popleft()

    def remember(self, bright: Image) -> None:
        """Keep what is bright in this frame's view (h, w), if the car has gone on since the last that was kept."""
        if not self._past or self._driven_m - self._past[-1].way_m >= self._every_m:
            bare = cv2.subtract(self._visible, cv2.dilate(bright, self._kernel))
            self._past.append(_Past(np.asarray(bare, dtype=np.uint8), self._start_from_now, self._driven_m))

    def step(self, lines: Image) -> Image:
        """The part of a filtered view (h, w) that may be paint."""
        if not self._past or self._driven_m - self._past[0].way_m < self._way_m:
            return lines
        past = self._past[0]
        now = np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 100.0]])
        then_from_now = past.start_from_then.inverse() @ self._start_from_now
        then = self.view.to_px(then_from_now.apply(self.view.to_body(now)))
        affine = cv2.getAffineTransform(now.astype(np.float32), then.astype(np.float32))
        size = (self.view.width_px, self.view.height_px)
        bare = cv2.warpAffine(past.bare, affine, size, flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP, borderValue=[0])
        return np.asarray(cv2.subtract(lines, bare), dtype=np.uint8)
