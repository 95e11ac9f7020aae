"""Window line following (Cudrano et al. 2020, section IV): the points of one line in a binary bird's-eye view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from automodel.geometry import View
from automodel.perception.windows.line_windows import LineWindows
from automodel.perception.windows.window_tracker import (
    ExpectedLine,
    PathCursor,
    TrackedPoint,
    TrackerSettings,
    WindowPose,
    WindowTracker,
)
from automodel.types import Bools, FloatArray, Image


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FollowedLine:
    """Points on the middle of one line, the nearest along the line first.

    `points_m` (n, 2), body frame; `sigma_m` (n,) their standard deviation across the line, which grows with the
    distance, where the calibration's error dominates; `after_gap` (n,) whether the line was not visible just before
    the point. `lost_m` is where the search ended without the line, None where the line runs out of sight.
    """

    points_m: FloatArray
    sigma_m: FloatArray
    after_gap: Bools
    lost_m: tuple[float, float] | None

    def __len__(self) -> int:
        return len(self.points_m)


class LineFollowing:
    """Follows a line with windows that step along its own direction.

    A window is re-centred on its content. One without a line starts the recovery: the windows continue along the
    expected line and search to both sides; a line found after a gap must have the expected direction. Beyond the end of
    the expected line, the line is followed while it is visible. Points that turn away from the expected line (a kerb
    into a crossing road) are dropped.

    `visible` (h, w) is nonzero where the view shows ground that the camera sees; None: everywhere.
    """

    MAX_REACH_LANES = 0.35

    def __init__(self, view: View, lane_width_m: float, marking_width_m: float, visible: Image | None = None) -> None:
        self.view, self._lane_m, self._marking_m = view, lane_width_m, marking_width_m
        self._windows = LineWindows(view, marking_width_m, visible)
        self._settings = TrackerSettings(view, lane_width_m, marking_width_m)

    def follow(self, features: Image, expected: ExpectedLine, reach_m: float = 0.0) -> FollowedLine:
        """The points of one line in a binary view (h, w), from where `expected` comes into sight.

        `reach_m` is the lateral distance from the expectation in which the line may lie.
        """
        path = PathCursor(expected, self._settings.step_m, self._settings.max_steps)
        while not (path.ended or self._windows.in_sight(path.x_m, path.y_m)):
            path.next()
        if path.ended:
            return self._followed([], None)
        pose = WindowPose(path.x_m, path.y_m, path.heading_rad)
        reach = min(reach_m, self.MAX_REACH_LANES * self._lane_m)
        tracker = WindowTracker(self._settings, self._windows, features, pose, path, reach)
        tracker.run()
        return self._followed(tracker.points, tracker.lost_m)

    def _followed(self, tracked: list[TrackedPoint], lost_m: tuple[float, float] | None) -> FollowedLine:
        points = np.array([(p.x_m, p.y_m) for p in tracked]).reshape(-1, 2)
        sigma = 0.12 * self._marking_m + 0.01 * np.hypot(points[:, 0] - self.view.x_near_m, points[:, 1])
        after_gap = np.array([p.missed > 0 for p in tracked], dtype=np.bool_)
        for array in (points, sigma, after_gap):
            array.flags.writeable = False
        return FollowedLine(points_m=points, sigma_m=sigma, after_gap=after_gap, lost_m=lost_m)
