"""Poses, line points and sampled lines as the estimators are given them, for their tests."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from automodel.estimation.theta.line_spline import SampledLine, smooth
from automodel.estimation.theta.pose_filter import LinePoint, PoseFilterConfig, predicted_measurement
from automodel.estimation.theta.theta_rls import ThetaRls, ThetaRlsConfig
from automodel.geometry import SE2
from tests.support.world_lanes import WorldLane

UNIT, REFERENCE_M = 0.4, 0.13
FILTER = PoseFilterConfig(lane_width_m=UNIT, reference_x_m=REFERENCE_M)
RLS = ThetaRlsConfig(lane_width_m=UNIT, reference_x_m=REFERENCE_M, memory_lanes=0.25, sight_lanes=0.6)


def pose_state(offset_m: float, heading_rad: float, width_m: float = UNIT) -> np.ndarray:
    return np.array((-heading_rad, 2.0 * offset_m / width_m, width_m))


def point(
    filter_state: np.ndarray, side: int, noise: np.random.Generator | None = None, sigma: float = 0.004
) -> LinePoint:
    """P_L (+1) or P_R (-1) of a true state, with isotropic noise."""
    h, _ = predicted_measurement(filter_state, REFERENCE_M)
    clean = h[:2] if side > 0 else h[2:4]
    drawn = clean if noise is None else clean + noise.normal(0.0, sigma, 2)
    return LinePoint(point_m=drawn, covariance_m2=np.eye(2) * sigma**2)


def see(
    lane: WorldLane, car: SE2, s_m: float, side: int, noise: np.random.Generator | None = None, from_m: float = -0.3
) -> SampledLine:
    points = lane.seen_from(car, np.linspace(s_m + from_m, s_m + 1.2, 50), side)
    if noise is not None:
        points = points + noise.normal(0.0, 0.003, points.shape)
    sampled = smooth(points, np.full(50, 0.003), 0.032, 0.24, 0.6 / UNIT**2)
    assert sampled is not None
    return sampled


def drive(
    rls: ThetaRls, lane: WorldLane, frames: int, noise: np.random.Generator | None = None, side: int = 1
) -> Iterator[tuple[float, SE2, float, float]]:
    """The car weaves along the lane; yields (s, car, offset, heading) after each frame."""
    s, before = 1.0, None
    for i in range(frames):
        offset, heading = 0.05 * math.sin(0.2 * i), 0.15 * math.cos(0.2 * i)
        car = lane.car(s, offset, heading, REFERENCE_M)
        if before is not None:
            motion = car.inverse() @ before
            rls.predict(motion, math.hypot(motion.x_m, motion.y_m), 0.033)
        rls.take(see(lane, car, s, side, noise))
        yield s, car, offset, heading
        before, s = car, s + 0.03
