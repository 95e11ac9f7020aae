"""Window line following (seed 001, section IV): one line's points in a binary bird's-eye view, from near to far."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from automodel.geometry import View
from automodel.perception.windows.line_initialisation import LineStart, LineStarts
from automodel.perception.windows.line_windows import LineWindows
from automodel.perception.windows.window_tracker import ExpectedLine, Guide, LineWalk, Walker, WalkPoint, WalkSettings
from automodel.types import FloatArray, Image

__all__ = ["ExpectedLine", "FollowedLine", "LineFollowing", "LineStart"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FollowedLine:
    """Points of one line's middle, the nearest along the line first.

    `points_m` (n, 2) in the body frame; `sigma_m` (n,) their standard deviation across the line, which grows with the
    distance, for there the calibration counts; `after_gap` (n,) whether nothing of the line was seen just before the
    point. `lost_m` is where the search for more was given up, None where the line runs out of sight.
    """

    points_m: FloatArray
    sigma_m: FloatArray
    after_gap: NDArray[np.bool_]
    lost_m: tuple[float, float] | None

    def __len__(self) -> int:
        return len(self.points_m)


class LineFollowing:
    """Finds the lane's two lines near the car, and follows each with windows that step along its own direction.

    A window is re-centred on what it shows. One without a line starts the recovery: the windows go on along the
    expected line, if there is one, else as they went, and search to both sides; what is found after a gap must run in
    the expected direction. Points that turn away from the expected line (a kerb into a crossing road) are given up.

    `visible` (h, w) is nonzero where the view shows what the camera sees; None: everywhere. `reference_x_m` is the
    point of the car between the two lines.
    """

    STEP_LANES = 0.1  # way between windows, if a window is not longer
    MAX_GAP_LANES, MAX_BLIND_GAP_LANES = 4.0, 1.25  # with an expected line, and without
    WIDE_GAP_LANES = 0.6  # a junction's, not one between two dashes
    MIN_RADIUS_LANES = 1.0
    MAX_BREADTH_LANES = 0.35

    def __init__(
        self,
        view: View,
        lane_width_m: float,
        marking_width_m: float,
        visible: Image | None = None,
        reference_x_m: float = 0.0,
    ) -> None:
        self.view, self._lane_m, self._marking_m = view, lane_width_m, marking_width_m
        self._windows = LineWindows(view, marking_width_m, visible)
        self._starts = LineStarts(view, lane_width_m, marking_width_m, reference_x_m)
        step = max(LineWindows.ALONG * marking_width_m, self.STEP_LANES * lane_width_m)
        length = view.x_far_m - view.x_near_m + 2.0 * view.half_width_m
        max_turn = step / (self.MIN_RADIUS_LANES * lane_width_m)
        self._settings = WalkSettings(
            step_m=step,
            spacing_m=0.6 * LineWindows.ACROSS * marking_width_m,
            marking_m=marking_width_m,
            max_gap_m=self.MAX_GAP_LANES * lane_width_m,
            max_blind_gap_m=self.MAX_BLIND_GAP_LANES * lane_width_m,
            max_turn_rad=max_turn,
            max_leap_m=0.5 * (step * max_turn + marking_width_m),
            wide_gap=math.ceil(self.WIDE_GAP_LANES * lane_width_m / step),
            max_steps=math.ceil(1.5 * length / step),
        )

    def start(self, features: Image) -> tuple[LineStart | None, LineStart | None]:
        """Where the left and the right line begin in a binary view (h, w), None for a line that is not found."""
        return self._starts.step(features)

    def follow(
        self,
        features: Image,
        start: LineStart | None = None,
        expected: ExpectedLine | None = None,
        breadth_m: float = 0.0,
    ) -> FollowedLine:
        """The points of one line in a binary view (h, w), from `start` or from where `expected` comes into sight.

        `breadth_m` is how far beside the expectation the line may lie. Raises ValueError without either.
        """
        guide = Guide(expected, self._settings.step_m) if expected is not None else None
        if start is not None:
            walker = Walker(*start.point_m, start.direction_rad, start.curvature_per_m)
        elif guide is not None:
            while not (guide.ended or self._windows.in_sight(guide.x_m, guide.y_m)):
                guide.next()
            if guide.ended:
                return self._followed([], None)
            walker = Walker(guide.x_m, guide.y_m, guide.heading_rad)
        else:
            raise ValueError("follow: neither a start nor an expected line")
        breadth = min(breadth_m, self.MAX_BREADTH_LANES * self._lane_m)
        walk = LineWalk(self._settings, self._windows, features, walker, guide, breadth)
        walk.run()
        return self._followed(walk.points, walk.lost_m)

    def _followed(self, walked: list[WalkPoint], lost_m: tuple[float, float] | None) -> FollowedLine:
        points = np.array([(p.x_m, p.y_m) for p in walked]).reshape(-1, 2)
        sigma = 0.12 * self._marking_m + 0.01 * np.hypot(points[:, 0] - self.view.x_near_m, points[:, 1])
        after_gap = np.array([p.missed > 0 for p in walked], dtype=np.bool_)
        for array in (points, sigma, after_gap):
            array.flags.writeable = False
        return FollowedLine(points_m=points, sigma_m=sigma, after_gap=after_gap, lost_m=lost_m)
