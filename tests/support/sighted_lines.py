"""Lines of a drawn road as the scan of a view would tell them, and beliefs of its lane."""

from __future__ import annotations

import numpy as np

from automodel.perception.line_scan import SightedLine
from automodel.tracking.belief import LaneBelief, RoadModel
from automodel.types import FloatArray
from tests.support.drawn_roads import LANE_M, MARKING_M, Road

ROAD_MODEL = RoadModel(lane_width_m=LANE_M, marking_width_m=MARKING_M)
DASHED = 0.55  # share of a dashed line that is painted


def sighted(points_m: FloatArray, painted: float = 1.0) -> SightedLine:
    """A line through points (n, 2) [m], of whose length a share is painted."""
    span_m = float(np.hypot(*(points_m[-1] - points_m[0])))
    return SightedLine(points_m=points_m, painted_m=painted * span_m, span_m=span_m)


def line_of(
    road: Road, lanes: float, from_m: float = 0.2, to_m: float = 1.2, painted: float = 1.0, count: int = 8
) -> SightedLine:
    """The line of a road that lies `lanes` lane widths to the left of its centre."""
    points = road.expected(lanes * LANE_M, -from_m, to_m).points_m
    return sighted(points[:: max(len(points) // count, 1)], painted)


def belief(
    road: Road,
    sigmas: tuple[float, float, float, float] = (0.1, 0.25, 0.5, 0.05),
    reference_x_m: float = 0.0,
    model: RoadModel = ROAD_MODEL,
) -> LaneBelief:
    """The truth of a road's lane, with standard deviations of offset [m], theta [rad], kappa [1/m] and width [m]."""
    x, y = np.array((reference_x_m,)), np.zeros(1)
    offset, along = float(road.beside(x, y)[0]), float(road.along(x, y)[0])
    theta = road.heading_rad + road.curvature_per_m * along
    mean = np.array((offset, theta, road.curvature_per_m, LANE_M))
    return LaneBelief.arc(mean, np.diag(np.square(sigmas)), model, reference_x_m)


def bending(role: float, begins_m: float, radius_m: float, from_m: float = 0.1) -> SightedLine:
    """A line of a lane that is straight from the car on, and bends to the left from `begins_m` on."""
    straight, turned = np.linspace(from_m, begins_m, 4), np.linspace(0.15, 0.9, 6)
    own_m = radius_m - role * LANE_M
    x = np.concatenate((straight, begins_m + own_m * np.sin(turned)))
    y = role * LANE_M + np.concatenate((np.zeros(len(straight)), own_m * (1.0 - np.cos(turned))))
    return sighted(np.column_stack((x, y)))
