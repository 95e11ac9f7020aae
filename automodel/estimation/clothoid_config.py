"""What a clothoid tracker is told: the scales of its filter, and a lane to start with."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackerConfig:
    """Scales of the filter; lengths in lane widths, so that one set holds from scale car to highway.

    A random walk's sigma is that after one lane width of way; curvatures are in 1 / lane width.
    """

    lane_width_m: float
    law: str = "gauss_newton"
    offset_walk: float = 0.01
    heading_walk_rad: float = 0.012
    blind_offset: float = 0.03  # and these come on top while no line is seen
    blind_heading_rad: float = 0.03
    width_walk: float = 0.002
    radius_lanes: float = 1.1  # of the tightest bend; the two that follow are shares of its curvature
    curvature_walk: float = 0.03  # of a station's value: maps age
    curvature_step: float = 0.4  # from station to station, per root lane width of road
    straighten: float = 0.95  # what is left of a curvature half a lane width further on, where nothing was seen yet
    start_offset: float = 0.08  # how well a guess is known to start with
    start_heading_rad: float = 0.1
    start_width: float = 0.05
    unknown_offset: float = 0.05  # a frame without odometry
    unknown_heading_rad: float = 0.05
    unknown_curvature: float = 0.8  # what is left then of a curvature that is not seen: it may have been passed
    unknown_share: float = 0.1  # of the road's variety that may have come in its place
    yaw_rate_sigma_radps: float = 0.01
    agreed: float = 0.3  # of what a residual may be: when none is larger, weights are not renewed
    gate: float = 3.5  # sigmas of prediction and measurement together
    doubt: float = 0.03  # growth a frame of place and heading while a line lies where it is not believed
    doubt_nodes: int = 4  # that make such a line


@dataclass(frozen=True, slots=True, kw_only=True)
class RoughLane:
    """An arc to start with: offset [m] and the lane's heading [rad] in the body frame, at the reference point.

    It is right some way ahead of it, at `sure_m`; `share` is what is left there of the usual sigmas of place and
    heading.
    """

    offset_m: float
    heading_rad: float
    width_m: float
    curvature_per_m: float
    sure_m: float
    share: float = 1.0
