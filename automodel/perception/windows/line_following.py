"""Window line following (Cudrano et al. 2020, section IV): the points of one line in a binary bird's-eye view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from automodel.geometry import View
from automodel.perception.windows.line_windows import LineWindows
from automodel.perception.windows.window_tracker import MISSED, ExpectedLine, track, track_scales
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

    def __init__(self, view: View, lane_width_m: float, marking_width_m: float, visible: Image | None = None) -> None:
        self.view, self._marking_m = view, marking_width_m
        self._layout = LineWindows(view, marking_width_m, visible).layout
        self._scales = track_scales(view, lane_width_m, marking_width_m)
        far = ExpectedLine(points_m=np.array([[-1e3, 0.0], [-2e3, 0.0]]), heading_rad=np.zeros(2))
        self.follow(np.zeros(self._layout.sight.shape, np.uint8), far)  # compiled now: no frame waits for it

    def follow(self, features: Image, expected: ExpectedLine, reach_m: float = 0.0) -> FollowedLine:
        """The points of one line in a binary view (h, w), from where `expected` comes into sight.

        `reach_m` is the lateral distance from the expectation in which the line may lie.
        """
        line, known_m = (expected.points_m, expected.heading_rad), float(expected.known_m)
        tracked, *lost_m = track(features, self._layout, self._scales, *line, known_m, reach_m)
        points = tracked[:, :2].copy()
        sigma = 0.12 * self._marking_m + 0.01 * np.hypot(points[:, 0] - self.view.x_near_m, points[:, 1])
        after_gap = tracked[:, MISSED] > 0.0
        for array in (points, sigma, after_gap):
            array.flags.writeable = False
        lost = (lost_m[0], lost_m[1]) if np.isfinite(lost_m[0]) else None
        return FollowedLine(points_m=points, sigma_m=sigma, after_gap=after_gap, lost_m=lost)
