"""An expected line: last frame's model, moved by the odometry, as the line following reads it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from automodel.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ExpectedLine:
    """Points (n, 2) [m] of a line in the body frame, the nearest along the line first, and its headings (n,) [rad].

    Headings go on steadily, past pi too. Beyond the arc length `known_m` from its beginning the line is a guess, which
    a line that is seen without a gap may leave. Raises ValueError for less than two points, for one that is not finite
    and for headings that are not as many.
    """

    points_m: FloatArray
    heading_rad: FloatArray
    known_m: float = math.inf

    def __post_init__(self) -> None:
        points, heading = (np.array(a, dtype=np.float64) for a in (self.points_m, self.heading_rad))
        if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2 or heading.shape != points.shape[:1]:
            raise ValueError(
                f"ExpectedLine: points {points.shape} and headings {heading.shape}; (n, 2) and (n,) wanted"
            )
        if not (np.isfinite(points).all() and np.isfinite(heading).all()):
            raise ValueError("ExpectedLine: points and headings must be finite")
        points.flags.writeable = heading.flags.writeable = False
        object.__setattr__(self, "points_m", points)
        object.__setattr__(self, "heading_rad", heading)


class Guide:
    """An expected line at equal steps, and the place on it where the following has come to.

    `x_m`, `y_m`, `heading_rad` are the line's there, `way_m` is the arc length to there from the line's beginning,
    `turn_rad` how much the line turns on the next step, `ended` says that there is no next one, and `known` that the
    line is no guess there.
    """

    MOST = 4096  # steps; a line that is longer is cut

    __slots__ = (
        "_at", "_cos", "_known_m", "_nodes", "_sin", "_step_m", "ended", "heading_rad", "known", "turn_rad", "way_m",
        "x_m", "y_m",
    )  # fmt: skip

    def __init__(self, expected: ExpectedLine, step_m: float) -> None:
        points, heading = expected.points_m, expected.heading_rad
        s = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))
        places = np.arange(0.0, min(max(float(s[-1]), 1e-9), self.MOST * step_m), step_m)
        columns = (np.interp(places, s, column) for column in (points[:, 0], points[:, 1], heading))
        self._nodes: list[tuple[float, float, float]] = list(zip(*(c.tolist() for c in columns), strict=True))
        self._step_m, self._known_m = step_m, expected.known_m
        self._go(0)

    def _go(self, at: int) -> None:
        self._at = at
        self.x_m, self.y_m, self.heading_rad = self._nodes[at]
        self.way_m = at * self._step_m
        self.known = self.way_m <= self._known_m
        self.ended = at + 1 >= len(self._nodes)
        self.turn_rad = 0.0 if self.ended else self._nodes[at + 1][2] - self.heading_rad
        self._cos, self._sin = math.cos(self.heading_rad), math.sin(self.heading_rad)

    def next(self) -> None:
        """Go on by a step; does nothing at the end."""
        if not self.ended:
            self._go(self._at + 1)

    def come(self, x_m: float, y_m: float) -> None:
        """Go on to where (x, y) lies beside the line."""
        half = 0.5 * self._step_m
        while not self.ended and (x_m - self.x_m) * self._cos + (y_m - self.y_m) * self._sin > half:
            self._go(self._at + 1)

    def aside(self, x_m: float, y_m: float) -> float:
        """How far [m] (x, y) lies to the left of the line at the place."""
        return (y_m - self.y_m) * self._cos - (x_m - self.x_m) * self._sin
