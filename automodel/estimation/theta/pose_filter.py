"""The car's pose in the lane by an extended Kalman filter (Cudrano et al. 2020, eq. (22)-(25), on filterpy's).

State (theta, rho, w): the centerline's direction seen from the car [rad], the car's offset in half lane widths (left
positive), the lane's width [m]. Measured are the points P_L, P_R in which the lane's lines meet the perpendicular to
the centerline through the reference point.

The paper's state is a random walk, which lags in every turn. Here the car's motion is the control input: relative to
the foot of the perpendicular the reference point moves from (0, d) to (X, Y), and on a centerline of curvature kappa

    d'     = (2 Y - kappa (X^2 + Y^2)) / (1 + h),   h = |(kappa X, 1 - kappa Y)|
    theta' = theta + atan2(kappa X, 1 - kappa Y) - dpsi

which is exact on arcs and needs no special case for the straight. Also beyond the paper: a gate for each measurement,
updates with one line, and the centerline's direction, and the width ahead, as measurements of their own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from statistics import NormalDist
from typing import Any

import numpy as np

from automodel.curves.foot import LEAST_STRETCH, foot_on_circle
from automodel.estimation.road import LOST_STEP, LOST_TURN_RAD, WALK
from automodel.geometry import SE2
from automodel.geometry.se2 import wrap_angle
from automodel.signals import EXCEEDED
from automodel.types import FloatArray

_LINES = (slice(0, 2), slice(2, 4))  # rows of the measurement, eq. (22)
_DIRECTION, _WIDTH = slice(4, 5), slice(5, 6)
LEAST_WIDTH = 0.4  # lane widths: two lines that are closer are one; the inverse bounds a lane's width from above


class State(IntEnum):
    """Indices of the state vector."""

    THETA = 0  # [rad]
    RHO = 1  # [half lane widths]
    WIDTH = 2  # [m]


def predicted_measurement(state: FloatArray, reference_x_m: float) -> tuple[FloatArray, FloatArray]:
    """h (6,), eq. (25), and its Jacobian (6, 3): P_L and P_R in the body frame, the lane's direction, its width."""
    theta, rho, width = (float(value) for value in state)
    cos, sin, half = math.cos(theta), math.sin(theta), 0.5 * width
    left, right = 0.5 * (1.0 - rho), 0.5 * (1.0 + rho)  # [lane widths]
    a, b = width * left, width * right
    h = np.array((reference_x_m - a * sin, a * cos, reference_x_m + b * sin, -b * cos, theta, width))
    jacobian = np.array(
        (
            (-a * cos, half * sin, -left * sin),
            (-a * sin, -half * cos, left * cos),
            (b * cos, half * sin, right * sin),
            (b * sin, -half * cos, -right * cos),
            (1.0, 0.0, 0.0),
            (0.0, 0.0, 1.0),
        )
    )
    return h, jacobian


def predicted_state(
    state: FloatArray, shift_m: tuple[float, float], turn_rad: float, kappa_per_m: float
) -> tuple[FloatArray, FloatArray]:
    """State (3,) after a motion, and its Jacobian (3, 3).

    `shift_m`: displacement of the reference point in the body frame before the motion, `turn_rad`: the body's turn.
    """
    theta, rho, width = (float(value) for value in state)
    cos, sin, kappa = math.cos(theta), math.sin(theta), kappa_per_m
    along, left = shift_m[0] * cos + shift_m[1] * sin, shift_m[1] * cos - shift_m[0] * sin
    y = 0.5 * rho * width + left
    u, v = 1.0 - kappa * y, kappa * along
    h = max(math.hypot(u, v), LEAST_STRETCH)
    foot, offset = foot_on_circle(along, y, kappa)
    offset_along, offset_left = -v / h, u / h
    turn_along, turn_left = kappa * u / (h * h), kappa * v / (h * h)
    jacobian = np.array(
        (
            (1.0 + turn_along * left - turn_left * along, 0.5 * width * turn_left, 0.5 * rho * turn_left),
            (
                2.0 / width * (offset_along * left - offset_left * along),
                offset_left,
                rho / width * offset_left - 2.0 * offset / width**2,
            ),
            (0.0, 0.0, 1.0),
        )
    )
    return np.array((wrap_angle(theta + kappa * foot - turn_rad), 2.0 * offset / width, width)), jacobian


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseFilterConfig:
    """Noise of the lane's pose; offsets and widths in lane widths.

    `rejected`: share of good measurements that fail their gate. Heading, offset and width gain `WALK` over a lane width
    of distance, and over a second.
    """

    lane_width_m: float
    reference_x_m: float
    rejected: float = EXCEEDED

    def __post_init__(self) -> None:
        if not (self.lane_width_m > 0.0 and 0.0 < self.rejected < 1.0):
            raise ValueError("PoseFilterConfig: lane_width_m must be positive, rejected between 0 and 1")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LinePoint:
    """A measured point (2,) [m] of the left or right line in the body frame, and its covariance (2, 2) [m^2]."""

    point_m: FloatArray
    covariance_m2: FloatArray

    @staticmethod
    def beside(
        reference_m: tuple[float, float],
        theta_rad: float,
        distance_m: float,
        distance_variance_m2: float,
        theta_variance_rad2: float,
    ) -> LinePoint:
        """The point at a distance to the left of the reference point, perpendicular to a direction theta.

        Its variance across the line is that of the distance, along the line that due to the direction.
        """
        cos, sin = math.cos(theta_rad), math.sin(theta_rad)
        across, along = distance_variance_m2, distance_m * distance_m * theta_variance_rad2
        x, y = reference_m
        mixed = sin * cos * (along - across)
        return LinePoint(
            point_m=np.array((x - distance_m * sin, y + distance_m * cos)),
            covariance_m2=np.array(
                ((along * cos * cos + across * sin * sin, mixed), (mixed, along * sin * sin + across * cos * cos))
            ),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseUpdate:
    """Which measurements passed their gates, and their normalised innovation squared.

    In a consistent filter `nis` is chi-square distributed with `dimensions` degrees of freedom.
    """

    left: bool
    right: bool
    heading: bool
    nis: float
    dimensions: int


class LanePoseFilter:
    """Heading, offset and width over time; on the centerline until `start`.

    `rejected` counts the measurements that failed their gate since `start`.
    """

    _FLOOR = 1e-4  # [lane widths] least standard deviation of a point

    def __init__(self, config: PoseFilterConfig) -> None:
        from filterpy.kalman import ExtendedKalmanFilter  # imports scipy, which takes most of a second

        self.config = config
        self._pair_gate = -2.0 * math.log(config.rejected)  # chi-square with two degrees of freedom
        self._single_gate = NormalDist().inv_cdf(1.0 - 0.5 * config.rejected) ** 2
        self._floor = (self._FLOOR * config.lane_width_m) ** 2 * np.eye(2)
        self._ekf: Any = ExtendedKalmanFilter(dim_x=len(State), dim_z=4)
        self._ekf.predict_x = self._predict_x
        self._next: FloatArray = np.zeros(len(State))
        self.start(0.0, 0.0, config.lane_width_m, (1.0, 1.0, 1.0))

    def start(
        self,
        offset_m: float,
        heading_rad: float,
        width_m: float,
        sigma: tuple[float, float, float],
    ) -> None:
        """Start at a pose; `sigma`: of heading [rad], offset and width [lane widths]."""
        width = self._bounded_width(width_m)
        self._ekf.x = np.array((-heading_rad, 2.0 * offset_m / width, width))
        self._ekf.P = self._spread(sigma)
        self.rejected = 0

    @property
    def state(self) -> FloatArray:
        """(theta, rho, w) in the paper's signs."""
        return np.array(self._ekf.x)

    @property
    def offset_m(self) -> float:
        """The car's distance to the left of the centerline [m]."""
        return 0.5 * float(self._ekf.x[State.RHO] * self._ekf.x[State.WIDTH])

    @property
    def heading_rad(self) -> float:
        """The car's direction relative to the centerline, left positive [rad]."""
        return -float(self._ekf.x[State.THETA])

    @property
    def width_m(self) -> float:
        """The lane's width [m]."""
        return float(self._ekf.x[State.WIDTH])

    @property
    def covariance(self) -> FloatArray:
        """Covariance (3, 3) of (offset, heading, width) [m, rad, m]."""
        _, rho, width = self._ekf.x
        to_pose = np.array(((0.0, 0.5 * width, 0.5 * rho), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
        return np.asarray(to_pose @ self._ekf.P @ to_pose.T)

    def predict(self, after_from_before: SE2, curvature_per_m: float, dt_s: float, motion_known: bool = True) -> None:
        """Predict the pose after a motion of the body in `dt_s`, on a centerline of that curvature.

        An unknown motion counts as none, with a large process noise.
        """
        config, width = self.config, self.width_m
        before = after_from_before.inverse() if motion_known else SE2()
        if not all(map(math.isfinite, (before.x_m, before.y_m, before.yaw_rad, curvature_per_m, dt_s))):
            before, motion_known, curvature_per_m, dt_s = SE2(), False, 0.0, 0.0
        reference = config.reference_x_m
        cos, sin = math.cos(before.yaw_rad), math.sin(before.yaw_rad)
        shift = (before.x_m + reference * (cos - 1.0), before.y_m + reference * sin)
        limit = 2.0 / width
        kappa = min(max(curvature_per_m, -limit), limit)
        self._next, self._ekf.F = predicted_state(self._ekf.x, shift, before.yaw_rad, kappa)
        distance, time = math.hypot(*shift) / config.lane_width_m, max(dt_s, 0.0)
        heading = offset = width_noise = (distance + time) * WALK**2
        if not motion_known:
            heading, offset = heading + time * LOST_TURN_RAD**2, offset + time * LOST_STEP**2
        self._ekf.Q = np.diag(
            (heading, offset * (2.0 * config.lane_width_m / width) ** 2, width_noise * config.lane_width_m**2)
        )
        self._ekf.predict()
        self._ekf.P = 0.5 * (self._ekf.P + self._ekf.P.T)

    def update(
        self,
        left: LinePoint | None,
        right: LinePoint | None,
        theta: tuple[float, float] | None = None,
        width: tuple[float, float] | None = None,
    ) -> PoseUpdate:
        """Update by this frame's measurements; one that is None, not finite or outside its gate is ignored.

        `theta`: the centerline's direction [rad], eq. (20), and its variance [rad^2], a measurement beyond the paper's
        four for one line, or two lines seen in one point each. `width`: the lane's width [m], and its variance [m^2],
        measured ahead of the car.
        """
        h, jacobian = predicted_measurement(self._ekf.x, self.config.reference_x_m)
        measured = [
            (which, rows, point.point_m - h[rows], point.covariance_m2 + self._floor)
            for which, (rows, point) in enumerate(zip(_LINES, (left, right), strict=True))
            if point is not None
        ]
        if theta is not None and math.isfinite(theta[0]):
            off = wrap_angle(theta[0] - float(h[_DIRECTION][0]))
            measured.append((2, _DIRECTION, np.array((off,)), np.array(((theta[1],),))))
        if width is not None and math.isfinite(width[0]):
            measured.append((3, _WIDTH, np.array((width[0] - h[_WIDTH][0],)), np.array(((width[1],),))))
        good = [part for part in measured if self._passes(part[2], jacobian[part[1]], part[3])]
        used = {which for which, *_ in good}
        if not good:
            return PoseUpdate(left=False, right=False, heading=False, nis=0.0, dimensions=0)
        _, rows, innovations, noises = zip(*good, strict=True)
        nis = self._correct(
            np.concatenate(innovations),
            np.concatenate([jacobian[block] for block in rows]),
            _diagonal(noises),
        )
        return PoseUpdate(left=0 in used, right=1 in used, heading=2 in used, nis=nis, dimensions=sum(map(len, noises)))

    def _passes(self, innovation: FloatArray, jacobian: FloatArray, noise: FloatArray) -> bool:
        """Whether a measurement is finite, has a positive definite covariance, and lies within its gate."""
        spread = (jacobian @ self._ekf.P @ jacobian.T + noise).tolist()
        if len(innovation) == 1:
            ((determinant,),), limit = spread, self._single_gate
            inside = float(innovation[0]) ** 2
            possible = noise[0, 0] > 0.0
        else:
            ((a, b), (c, d)), limit = spread, self._pair_gate
            y0, y1 = innovation.tolist()
            determinant, inside = a * d - b * c, d * y0 * y0 - (b + c) * y0 * y1 + a * y1 * y1
            possible = noise[0, 0] > 0.0 and noise[0, 0] * noise[1, 1] > noise[0, 1] * noise[1, 0]
        good = bool(possible) and math.isfinite(determinant) and 0.0 <= inside <= limit * determinant
        self.rejected += not good
        return good

    def _correct(self, innovation: FloatArray, jacobian: FloatArray, noise: FloatArray) -> float:
        """The filter's update; returns the normalised innovation squared."""
        ekf = self._ekf
        # filterpy gets the innovation itself, because directions wrap
        ekf.update(innovation, lambda _: jacobian, lambda _: 0.0, R=noise)
        nis = float(innovation @ ekf.SI @ innovation)
        ekf.P = 0.5 * (ekf.P + ekf.P.T)
        ekf.x[State.THETA] = wrap_angle(float(ekf.x[State.THETA]))
        width = self._bounded_width(float(ekf.x[State.WIDTH]))
        ekf.x[State.RHO] *= ekf.x[State.WIDTH] / width
        ekf.x[State.WIDTH] = width
        return nis

    def _bounded_width(self, width_m: float) -> float:
        unit = self.config.lane_width_m
        return min(max(width_m, LEAST_WIDTH * unit), unit / LEAST_WIDTH)

    def _spread(self, sigma: tuple[float, float, float]) -> FloatArray:
        heading, offset, width = sigma
        unit = self.config.lane_width_m
        return np.diag((heading**2, (2.0 * offset * unit / self.width_m) ** 2, (width * unit) ** 2))

    def _predict_x(self, _: object = None) -> None:
        self._ekf.x = self._next


def _diagonal(blocks: Sequence[FloatArray]) -> FloatArray:
    ends = np.cumsum([len(block) for block in blocks])
    out = np.zeros((ends[-1], ends[-1]))
    for block, end in zip(blocks, ends, strict=True):
        out[end - len(block) : end, end - len(block) : end] = block
    return out
