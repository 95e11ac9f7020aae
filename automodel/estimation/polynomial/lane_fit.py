"""One lane fitted to the points of both its lines: a centerline of piecewise linear curvature, and a width.

The centerline is c(s) with c(0) = p_ref - d n(theta0), c' = (cos theta, sin theta), theta(s) = theta0 + int_0^s kappa,
and kappa piecewise linear between nodes: a chain of clothoids. A point of the line on side sigma (+1 left, -1 right)
should lie at the signed distance sigma (w + w' s) / 2 from it: a lane that narrows or widens has no parallel lines.
Gauss-Newton with an analytic Jacobian minimises the robust weighted sum of squared distances plus a prior, the last
solution moved by the odometry, over the parameters (d, theta0, kappa_0 .. kappa_m, w, w').

Body frame: d is the car's offset (left positive) at the reference point, -theta0 its heading in the lane.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from automodel.curves.foot import nearest_samples, newton_steps
from automodel.curves.lanes import LaneShape
from automodel.estimation.road import BEHIND, NODE
from automodel.geometry import SE2
from automodel.types import Bools, FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneFitConfig:
    """Scales of the fit; lengths in lane widths, so that one set serves scale cars and highways."""

    lane_width_m: float
    reference_x_m: float
    behind_lanes: float = BEHIND  # reach of the centerline behind the reference point
    ahead_lanes: float = 4.0  # and ahead of it
    node_lanes: float = NODE  # spacing of the curvature's nodes
    sure_lanes: float = 1.0  # distance ahead up to which the prior is trusted
    outlier_lanes: float = 0.06  # distance at which Tukey's biweight becomes 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LineSamples:
    """Points (n, 2) [m] in the body frame, their side (n,) +1 left or -1 right, their standard deviation (n,) [m]."""

    points_m: FloatArray
    side: FloatArray
    sigma_m: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LanePrior:
    """Mean and standard deviation (m,) of each parameter."""

    mean: FloatArray
    sigma: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Bearing:
    """A measurement of the lane's direction [rad] in the body frame at arc length s from the reference point's foot."""

    s_m: float
    theta_rad: float
    sigma_rad: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LaneSolution:
    """Parameters (d, theta0, kappa.., w, w'), their information matrix, and which samples were inliers (n,)."""

    parameters: FloatArray
    information: FloatArray
    inliers: Bools

    @property
    def offset_m(self) -> float:
        """The car's distance to the left of the centerline [m]."""
        return float(self.parameters[0])

    @property
    def heading_rad(self) -> float:
        """The car's direction relative to the centerline [rad]."""
        return -float(self.parameters[1])

    @property
    def width_m(self) -> float:
        """The lane's width [m]."""
        return float(self.parameters[-2])


class LaneFit:
    """The fit on fixed grids of nodes and points: `solve` in each frame."""

    FAR_CUTS = 8.0  # [outlier distances] first limit of residuals far ahead

    def __init__(self, config: LaneFitConfig) -> None:
        self.config = config
        unit = config.lane_width_m
        spacing = max(config.node_lanes, (config.behind_lanes + config.ahead_lanes) / 12.0) * unit
        behind, ahead = (
            int(np.ceil(config.behind_lanes * unit / spacing)),
            int(np.ceil(config.ahead_lanes * unit / spacing)),
        )
        self.nodes_m: FloatArray = np.arange(-behind, ahead + 1, dtype=np.float64) * spacing
        self._fine = spacing / 4.0
        self.grid_m: FloatArray = np.arange(-4 * behind, 4 * ahead + 1, dtype=np.float64) * self._fine
        self._zero = 4 * behind  # the grid's index of s = 0
        middle = 0.5 * (self.grid_m[1:] + self.grid_m[:-1])
        self._hats = _hats(self.nodes_m, self.grid_m)
        self._turn = _hat_integrals(self.nodes_m, self.grid_m)  # d theta / d kappa on the grid
        self._turn_middle = _hat_integrals(self.nodes_m, middle)
        count = len(self.grid_m)
        below = np.tril(np.ones((count, count - 1)), -1)
        self._sum = (below - below[self._zero]) * self._fine  # int_0^s on the grid, of values at the middles
        self._smooth = self._smoothness(spacing)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return len(self.nodes_m) + 4

    def start(self, offset_m: float, theta_rad: float, curvature_per_m: float, width_m: float) -> FloatArray:
        """Parameters (m,) of an arc."""
        return np.concatenate(([offset_m, theta_rad], np.full(len(self.nodes_m), curvature_per_m), [width_m, 0.0]))

    def shape(self, parameters: FloatArray) -> LaneShape:
        """The centerline of the parameters."""
        points, theta, _ = self._curve(parameters)
        return LaneShape(
            s_m=self.grid_m,
            points_m=points,
            theta_rad=theta,
            kappa_per_m=self._hats @ parameters[2:-2],
            width_m=float(parameters[-2]),
            taper=float(parameters[-1]),
        )

    def moved(self, parameters: FloatArray, shape: LaneShape, after_from_before: SE2) -> FloatArray:
        """Parameters of the same lane after a motion of the car; `shape` is that of `parameters`.

        The origin moves along s to the new foot of the reference point, and the body frame turns.
        """
        reference = after_from_before.inverse().apply((self.config.reference_x_m, 0.0))[None]
        at = nearest_samples(shape.points_m, reference)
        ahead, left = newton_steps(reference - shape.points_m[at], shape.theta_rad[at], shape.kappa_per_m[at])
        s, d = float((shape.s_m[at] + ahead)[0]), float((left - 0.5 * shape.kappa_per_m[at] * ahead**2)[0])
        kappa = np.interp(self.nodes_m + s, self.nodes_m, parameters[2:-2])
        width = parameters[-2] + s * parameters[-1]
        heading = float(np.interp(s, self.grid_m, shape.theta_rad)) + after_from_before.yaw_rad
        return np.concatenate(([d, heading], kappa, [width, parameters[-1]]))

    def solve(
        self,
        samples: LineSamples,
        prior: LanePrior,
        rounds: int = 3,
        bearing: Bearing | None = None,
        guess: FloatArray | None = None,
    ) -> LaneSolution:
        """Fit `samples`, and a bearing of the lane, with a prior; starts at `guess` or at the prior's mean."""
        unit = self.config.lane_width_m
        weight_prior = 1.0 / prior.sigma**2
        fixed, pull = self._smooth.copy(), weight_prior * prior.mean
        fixed.flat[:: self.size + 1] += weight_prior
        if bearing is not None:
            row = np.zeros(self.size)
            row[1], row[2:-2] = 1.0, _hat_integrals(self.nodes_m, np.array([bearing.s_m]))[0]
            fixed = fixed + np.outer(row, row) / bearing.sigma_rad**2
            pull = pull + row * (bearing.theta_rad / bearing.sigma_rad**2)
        parameters = (prior.mean if guess is None else guess).copy()
        cut = self.config.outlier_lanes * unit
        for turn in range(rounds):
            residual, jacobian = self.residuals(parameters, samples)
            if turn == 0:
                wide = self._first_limits(jacobian, samples, fixed, cut)
            limit = np.maximum(wide * 0.5**turn, np.maximum(cut, 3.0 * samples.sigma_m))
            keep = np.maximum(1.0 - (residual / limit) ** 2, 0.0) ** 2
            weighted = jacobian * (keep / samples.sigma_m**2)[:, None]
            information = weighted.T @ jacobian + fixed
            gradient = weighted.T @ residual + fixed @ parameters - pull
            parameters = parameters - np.linalg.solve(information, gradient)
        return LaneSolution(parameters=parameters, information=information, inliers=keep > 0.1)

    def _first_limits(self, jacobian: FloatArray, samples: LineSamples, fixed: FloatArray, cut: float) -> FloatArray:
        """Limits (n,) [m] of the residuals in the first iteration.

        Near the car they follow from the prior's covariance; far ahead they are wider, because a new bend contradicts
        the prior there.
        """
        spread = np.linalg.solve(fixed, jacobian.T)
        open_m = np.sqrt(np.einsum("nm,mn->n", jacobian, spread) + samples.sigma_m**2)
        unit = self.config.lane_width_m
        far = np.clip((samples.points_m[:, 0] - self.config.reference_x_m) / unit - self.config.sure_lanes, 0.0, 1.0)
        return np.maximum(np.maximum(cut, 3.0 * open_m), self.FAR_CUTS * cut * far)

    def residuals(self, parameters: FloatArray, samples: LineSamples) -> tuple[FloatArray, FloatArray]:
        """Signed distance minus sigma w / 2 (n,) [m], to second order in the grid's step, and its Jacobian (n, m)."""
        points, theta, jacobian = self._curve(parameters, want_jacobian=True)
        q = samples.points_m
        nearest = nearest_samples(points, q)
        theta, kappa = theta[nearest], self._hats[nearest] @ parameters[2:-2]
        ahead, left = newton_steps(q - points[nearest], theta, kappa)
        s = self.grid_m[nearest] + ahead
        half = 0.5 * (parameters[-2] + parameters[-1] * s)
        residual = left - 0.5 * kappa * ahead**2 * (1.0 - kappa * left) - samples.side * half
        rows = jacobian[nearest]  # (n, 2, m - 2): d position / d (d, theta0, kappa)
        out = np.empty((len(q), self.size))
        np.einsum("nk,nkm->nm", np.column_stack((np.sin(theta), -np.cos(theta))), rows, out=out[:, :-2])
        out[:, 1] -= ahead
        out[:, 2:-2] -= ahead[:, None] * self._turn[nearest]
        if parameters[-1] != 0.0:  # the foot moves along the lane, to where it is wider or narrower
            slide = np.einsum("nk,nkm->nm", np.column_stack((np.cos(theta), np.sin(theta))), rows)
            share = 0.5 * parameters[-1] * samples.side / np.maximum(1.0 - kappa * left, 0.05)
            out[:, :-2] += share[:, None] * slide
        out[:, -2], out[:, -1] = -0.5 * samples.side, -0.5 * samples.side * s
        return residual, out

    def covariance(self, solution: LaneSolution) -> FloatArray:
        """Covariance (3, 3) of (offset, heading, width) [m, rad, m]."""
        picked = np.zeros((self.size, 3))
        picked[0, 0], picked[1, 1], picked[-2, 2] = 1.0, -1.0, 1.0
        return np.asarray(picked.T @ np.linalg.solve(solution.information, picked))

    def direction(self, parameters: FloatArray, s_m: float) -> float:
        """Direction [rad] of the centerline at s, body frame."""
        return float(parameters[1] + _hat_integrals(self.nodes_m, np.array([s_m]))[0] @ parameters[2:-2])

    def curvature(self, parameters: FloatArray, s_m: float = 0.0) -> float:
        """Curvature [1/m] of the centerline at s."""
        return float(np.interp(s_m, self.nodes_m, parameters[2:-2]))

    def _curve(self, p: FloatArray, want_jacobian: bool = False) -> tuple[FloatArray, FloatArray, FloatArray]:
        kappa = p[2:-2]
        theta = p[1] + self._turn @ kappa
        middle = p[1] + self._turn_middle @ kappa
        cos, sin = np.cos(middle), np.sin(middle)
        c0, s0 = np.cos(p[1]), np.sin(p[1])
        points = np.empty((len(theta), 2))
        points[:, 0] = self.config.reference_x_m + p[0] * s0 + self._sum @ cos
        points[:, 1] = -p[0] * c0 + self._sum @ sin
        jacobian = np.empty((0, 0, 0))
        if want_jacobian:
            jacobian = np.empty((len(theta), 2, self.size - 2))
            jacobian[:, :, 0] = s0, -c0
            jacobian[:, 0, 1] = -points[:, 1]
            jacobian[:, 1, 1] = points[:, 0] - self.config.reference_x_m
            jacobian[:, 0, 2:] = -self._sum @ (sin[:, None] * self._turn_middle)
            jacobian[:, 1, 2:] = self._sum @ (cos[:, None] * self._turn_middle)
        return points, theta, jacobian

    def _smoothness(self, spacing: float) -> FloatArray:
        """Information matrix of the prior that the curvature is a random walk along s."""
        unit = self.config.lane_width_m
        count = len(self.nodes_m)
        step_sigma = 0.35 / unit * np.sqrt(spacing / (0.6 * unit))
        difference = np.diff(np.eye(count), axis=0) / step_sigma
        information = np.zeros((count + 4, count + 4))
        information[2:-2, 2:-2] = difference.T @ difference
        return information


def _hats(nodes: FloatArray, s: FloatArray) -> FloatArray:
    """Values (len(s), len(nodes)) of the linear hat functions on evenly spaced nodes."""
    spacing = nodes[1] - nodes[0]
    return np.asarray(np.clip(1.0 - np.abs(s[:, None] - nodes) / spacing, 0.0, None))


def _hat_integrals(nodes: FloatArray, s: FloatArray) -> FloatArray:
    """int_0^s of each hat function, (len(s), len(nodes))."""
    spacing = nodes[1] - nodes[0]

    def primitive(x: FloatArray) -> FloatArray:
        t = np.clip((x[:, None] - nodes) / spacing, -1.0, 1.0)
        return np.asarray(spacing * np.where(t < 0, 0.5 * (1.0 + t) ** 2, 1.0 - 0.5 * (1.0 - t) ** 2))

    return primitive(s) - primitive(np.zeros(1))
