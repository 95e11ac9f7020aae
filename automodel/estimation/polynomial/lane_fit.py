"""One lane fitted to the points of both its lines: a centerline of piecewise linear curvature, and a width.

The centerline is c(s) with c(0) = p_ref - d n(theta0), c' = (cos theta, sin theta), theta(s) = theta0 + int_0^s kappa,
and kappa piecewise linear between nodes: a chain of clothoids. A point of the line on side sigma (+1 left, -1 right)
should lie at the signed distance sigma (w + w' s) / 2 from it: a lane that narrows or widens has no parallel lines.
Gauss-Newton with an analytic Jacobian minimises the robust weighted sum of squared distances plus a prior, the last
solution moved by the odometry, over the parameters (d, theta0, kappa_0 .. kappa_m, w, w'). The loops over samples and
nodes are compiled.

Body frame: d is the car's offset (left positive) at the reference point, -theta0 its heading in the lane.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from automodel.compiled import compiled
from automodel.curves.foot import LEAST_STRETCH, newton_step
from automodel.curves.lanes import LaneShape
from automodel.estimation.road import BEHIND, NODE, OUTLIER
from automodel.geometry import SE2
from automodel.geometry.elimination import solve
from automodel.types import Bools, FloatArray

_newton_step = compiled(newton_step)


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneFitConfig:
    """Scales of the fit; lengths in lane widths, so that one set serves scale cars and highways."""

    lane_width_m: float
    reference_x_m: float
    behind_lanes: float = BEHIND  # reach of the centerline behind the reference point
    ahead_lanes: float = 4.0  # and ahead of it
    node_lanes: float = NODE  # spacing of the curvature's nodes
    sure_lanes: float = 1.0  # distance ahead up to which the prior is trusted
    outlier_lanes: float = OUTLIER


class LineSamples(NamedTuple):
    """Points (n, 2) [m] in the body frame, their side (n,) +1 left or -1 right, their standard deviation (n,) [m]."""

    points_m: FloatArray
    side: FloatArray
    sigma_m: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LanePrior:
    """Mean and standard deviation (m,) of each parameter."""

    mean: FloatArray
    sigma: FloatArray


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


class Grid(NamedTuple):
    """Where the centerline is computed: `s_m` (n,), evenly spaced, and at the `middle` (n - 1,) of its intervals.

    Of each node's hat function there (n, nodes): `hats` its values, `turn` and `turn_middle` its integral from s = 0,
    which is d theta / d kappa. `zero` is the index of s = 0; the reference point lies at x = `reference_x_m`.
    """

    s_m: FloatArray
    hats: FloatArray
    turn: FloatArray
    turn_middle: FloatArray
    zero: int
    reference_x_m: float


class Limits(NamedTuple):
    """Residuals that count: Tukey's `cut_m`, `far_cuts` times that beyond `sure_lanes` of `unit_m` at first."""

    cut_m: float
    far_cuts: float
    sure_lanes: float
    unit_m: float


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
        self.grid_m: FloatArray = np.arange(-4 * behind, 4 * ahead + 1, dtype=np.float64) * (spacing / 4.0)
        self._grid = Grid(
            s_m=self.grid_m,
            hats=_hats(self.nodes_m, self.grid_m),
            turn=_hat_integrals(self.nodes_m, self.grid_m),
            turn_middle=_hat_integrals(self.nodes_m, 0.5 * (self.grid_m[1:] + self.grid_m[:-1])),
            zero=4 * behind,
            reference_x_m=config.reference_x_m,
        )
        self._smooth = self._smoothness(spacing)
        self._warm_up()

    @property
    def size(self) -> int:
        """Number of parameters."""
        return len(self.nodes_m) + 4

    def start(self, offset_m: float, theta_rad: float, curvature_per_m: float, width_m: float) -> FloatArray:
        """Parameters (m,) of an arc."""
        return np.concatenate(([offset_m, theta_rad], np.full(len(self.nodes_m), curvature_per_m), [width_m, 0.0]))

    def shape(self, parameters: FloatArray) -> LaneShape:
        """The centerline of the parameters."""
        points, theta, kappa = _centerline(parameters, self._grid)
        return LaneShape(
            s_m=self.grid_m,
            points_m=points,
            theta_rad=theta,
            kappa_per_m=kappa,
            width_m=float(parameters[-2]),
            taper=float(parameters[-1]),
        )

    def moved(self, parameters: FloatArray, shape: LaneShape, after_from_before: SE2) -> FloatArray:
        """Parameters of the same lane after a motion of the car; `shape` is that of `parameters`.

        The origin moves along s to the new foot of the reference point, and the body frame turns.
        """
        there = after_from_before.inverse() @ SE2(self.config.reference_x_m, 0.0)
        x, y = there.x_m, there.y_m
        line = shape.points_m, shape.theta_rad, shape.kappa_per_m, self.grid_m
        return _moved(parameters, (x, y), after_from_before.yaw_rad, line, self.nodes_m)

    def solve(
        self,
        samples: LineSamples,
        prior: LanePrior,
        rounds: int = 3,
        guess: FloatArray | None = None,
    ) -> LaneSolution:
        """Fit `samples` with a prior; starts at `guess` or at the prior's mean."""
        unit = self.config.lane_width_m
        fixed, pull = _fixed(self._smooth, prior.mean, prior.sigma)
        config = self.config
        parameters, information, inliers = _robust_fit(
            prior.mean if guess is None else guess,
            samples,
            fixed,
            pull,
            self._grid,
            Limits(config.outlier_lanes * unit, self.FAR_CUTS, config.sure_lanes, unit),
            rounds,
        )
        return LaneSolution(parameters=parameters, information=information, inliers=inliers)

    def residuals(self, parameters: FloatArray, samples: LineSamples) -> tuple[FloatArray, FloatArray]:
        """Signed distance minus sigma w / 2 (n,) [m], to second order in the grid's step, and its Jacobian (n, m)."""
        return _residuals(parameters, samples, self._grid)

    def covariance(self, solution: LaneSolution) -> FloatArray:
        """Covariance (3, 3) of (offset, heading, width) [m, rad, m]."""
        return _pose_covariance(solution.information)

    def direction(self, parameters: FloatArray, s_m: float) -> float:
        """Direction [rad] of the centerline at s, body frame."""
        return float(parameters[1] + _hat_integrals(self.nodes_m, np.array([s_m]))[0] @ parameters[2:-2])

    def curvature(self, parameters: FloatArray, s_m: float = 0.0) -> float:
        """Curvature [1/m] of the centerline at s."""
        return float(np.interp(s_m, self.nodes_m, parameters[2:-2]))

    def _warm_up(self) -> None:
        """Compile everything that a frame calls, so that none waits for it."""
        lane = self.start(0.0, 0.0, 0.0, self.config.lane_width_m)
        nothing = LineSamples(points_m=np.empty((0, 2)), side=np.empty(0), sigma_m=np.empty(0))
        self.covariance(self.solve(nothing, LanePrior(mean=lane, sigma=np.ones(self.size)), rounds=1))
        self.moved(lane, self.shape(lane), SE2())

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


@compiled
def _centerline(p: FloatArray, grid: Grid) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points (n, 2) [m], headings (n,) [rad] and curvatures (n,) [1/m] of the centerline on the grid."""
    n, nodes = grid.turn.shape
    step = grid.s_m[1] - grid.s_m[0]
    points, theta, kappa = np.empty((n, 2)), np.empty(n), np.empty(n)
    for i in range(n):
        turn = bend = 0.0
        for j in range(nodes):
            turn += grid.turn[i, j] * p[2 + j]
            bend += grid.hats[i, j] * p[2 + j]
        theta[i], kappa[i] = p[1] + turn, bend
    points[grid.zero, 0] = grid.reference_x_m + p[0] * math.sin(p[1])
    points[grid.zero, 1] = -p[0] * math.cos(p[1])
    for i in range(grid.zero, n - 1):
        middle = _middle(p, grid, i)
        points[i + 1, 0] = points[i, 0] + step * math.cos(middle)
        points[i + 1, 1] = points[i, 1] + step * math.sin(middle)
    for i in range(grid.zero - 1, -1, -1):
        middle = _middle(p, grid, i)
        points[i, 0] = points[i + 1, 0] - step * math.cos(middle)
        points[i, 1] = points[i + 1, 1] - step * math.sin(middle)
    return points, theta, kappa


@compiled
def _foot(
    x_m: float, y_m: float, points_m: FloatArray, theta_rad: FloatArray, kappa_per_m: FloatArray, s_m: FloatArray
) -> tuple[float, float, float]:
    """Arc length [m] of a point's foot on a centerline, its distance to the left [m], and the heading [rad] there."""
    i, least = 0, math.inf
    for at in range(len(points_m)):
        square = (x_m - points_m[at, 0]) ** 2 + (y_m - points_m[at, 1]) ** 2
        if square < least:
            i, least = at, square
    ahead, _, left = _newton_step(
        x_m - points_m[i, 0],
        y_m - points_m[i, 1],
        math.cos(theta_rad[i]),
        math.sin(theta_rad[i]),
        kappa_per_m[i],
        LEAST_STRETCH,
    )
    s = s_m[i] + ahead
    return s, left - 0.5 * kappa_per_m[i] * ahead**2, np.interp(s, s_m, theta_rad)


@compiled
def _moved(
    p: FloatArray,
    reference_m: tuple[float, float],
    turn_rad: float,
    line: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    nodes_m: FloatArray,
) -> FloatArray:
    """Parameters (m,) of a lane with its origin at the foot of a point, in a frame that has turned.

    `line`: the centerline of the parameters, as `_foot` takes it.
    """
    points_m, theta_rad, kappa_per_m, s_m = line
    s, d, theta = _foot(reference_m[0], reference_m[1], points_m, theta_rad, kappa_per_m, s_m)
    after, size = p.copy(), len(p)
    after[0], after[1] = d, theta + turn_rad
    after[2 : size - 2] = np.interp(nodes_m + s, nodes_m, p[2 : size - 2])
    after[size - 2] = p[size - 2] + s * p[size - 1]
    return after


@compiled
def _fixed(smooth: FloatArray, mean: FloatArray, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A prior's information matrix (m, m), with that of the smoothness, and its product with the mean (m,)."""
    fixed, pull = smooth.copy(), np.empty(len(mean))
    for i in range(len(mean)):
        weight = 1.0 / (sigma[i] * sigma[i])
        fixed[i, i] += weight
        pull[i] = weight * mean[i]
    return fixed, pull


@compiled
def _pose_covariance(information: FloatArray) -> FloatArray:
    """Covariance (3, 3) of offset, -heading and width."""
    size = len(information)
    picked, covariance = np.zeros((size, 3)), np.empty((3, 3))
    picked[0, 0], picked[1, 1], picked[size - 2, 2] = 1.0, -1.0, 1.0
    spread = solve(information.copy(), picked)
    for j in range(3):
        covariance[0, j], covariance[1, j], covariance[2, j] = spread[0, j], -spread[1, j], spread[size - 2, j]
    return covariance


@compiled
def _middle(p: FloatArray, grid: Grid, i: int) -> float:
    """Heading [rad] in the middle of the grid's interval i."""
    turn = 0.0
    for j in range(grid.turn_middle.shape[1]):
        turn += grid.turn_middle[i, j] * p[2 + j]
    return float(p[1] + turn)


@compiled
def _bend_slopes(p: FloatArray, grid: Grid) -> FloatArray:
    """d position / d kappa of the centerline on the grid, (n, 2, nodes)."""
    n, nodes = grid.turn.shape
    step = grid.s_m[1] - grid.s_m[0]
    slopes = np.zeros((n, 2, nodes))
    for i in range(grid.zero, n - 1):
        middle = _middle(p, grid, i)
        dx, dy = -step * math.sin(middle), step * math.cos(middle)
        for j in range(nodes):
            slopes[i + 1, 0, j] = slopes[i, 0, j] + dx * grid.turn_middle[i, j]
            slopes[i + 1, 1, j] = slopes[i, 1, j] + dy * grid.turn_middle[i, j]
    for i in range(grid.zero - 1, -1, -1):
        middle = _middle(p, grid, i)
        dx, dy = -step * math.sin(middle), step * math.cos(middle)
        for j in range(nodes):
            slopes[i, 0, j] = slopes[i + 1, 0, j] - dx * grid.turn_middle[i, j]
            slopes[i, 1, j] = slopes[i + 1, 1, j] - dy * grid.turn_middle[i, j]
    return slopes


@compiled
def _residuals(p: FloatArray, samples: LineSamples, grid: Grid) -> tuple[FloatArray, FloatArray]:
    """As `LaneFit.residuals`."""
    points, theta, kappa = _centerline(p, grid)
    slopes = _bend_slopes(p, grid)
    count, nodes, size = len(samples.points_m), grid.turn.shape[1], len(p)
    residual, jacobian = np.empty(count), np.empty((count, size))
    sin0, cos0 = math.sin(p[1]), math.cos(p[1])
    for k in range(count):
        x, y, side = samples.points_m[k, 0], samples.points_m[k, 1], samples.side[k]
        i, least = 0, math.inf
        for at in range(len(points)):
            square = (x - points[at, 0]) ** 2 + (y - points[at, 1]) ** 2
            if square < least:
                i, least = at, square
        cos, sin = math.cos(theta[i]), math.sin(theta[i])
        dx, dy = x - points[i, 0], y - points[i, 1]
        ahead, _, left = _newton_step(dx, dy, cos, sin, kappa[i], LEAST_STRETCH)
        s = grid.s_m[i] + ahead
        half = 0.5 * (p[-2] + p[-1] * s)
        residual[k] = left - 0.5 * kappa[i] * ahead**2 * (1.0 - kappa[i] * left) - side * half
        # The foot moves along the lane, to where it is wider or narrower.
        share = 0.5 * p[-1] * side / max(1.0 - kappa[i] * left, 0.05)
        across_x, across_y = sin + share * cos, -cos + share * sin
        jacobian[k, 0] = across_x * sin0 - across_y * cos0
        jacobian[k, 1] = -across_x * points[i, 1] + across_y * (points[i, 0] - grid.reference_x_m) - ahead
        for j in range(nodes):
            bent = across_x * slopes[i, 0, j] + across_y * slopes[i, 1, j]
            jacobian[k, 2 + j] = bent - ahead * grid.turn[i, j]
        jacobian[k, size - 2], jacobian[k, size - 1] = -0.5 * side, -0.5 * side * s
    return residual, jacobian


@compiled
def _first_limits(
    jacobian: FloatArray, samples: LineSamples, fixed: FloatArray, grid: Grid, limits: Limits
) -> FloatArray:
    """Limits (n,) [m] of the residuals in the first iteration.

    Near the car they follow from the prior's covariance; far ahead they are wider, because a new bend contradicts
    the prior there.
    """
    spread = solve(fixed.copy(), jacobian.T.copy())
    wide = np.empty(len(jacobian))
    for k in range(len(jacobian)):
        variance = samples.sigma_m[k] ** 2
        for j in range(jacobian.shape[1]):
            variance += jacobian[k, j] * spread[j, k]
        beyond = (samples.points_m[k, 0] - grid.reference_x_m) / limits.unit_m - limits.sure_lanes
        far = min(max(beyond, 0.0), 1.0)
        wide[k] = max(limits.cut_m, 3.0 * math.sqrt(variance), limits.far_cuts * limits.cut_m * far)
    return wide


@compiled
def _robust_fit(
    start: FloatArray,
    samples: LineSamples,
    fixed: FloatArray,
    pull: FloatArray,
    grid: Grid,
    limits: Limits,
    rounds: int,
) -> tuple[FloatArray, FloatArray, Bools]:
    """Parameters (m,), their information (m, m), and which samples are inliers, after some Gauss-Newton steps.

    The prior's information matrix is `fixed` (m, m), and `fixed` times its mean is `pull` (m,).
    """
    p, size, count = start.copy(), len(start), len(samples.points_m)
    keep, wide = np.zeros(count), np.zeros(count)
    information, gradient = np.empty((size, size)), np.empty((size, 1))
    for turn in range(rounds):
        residual, jacobian = _residuals(p, samples, grid)
        if turn == 0:
            wide = _first_limits(jacobian, samples, fixed, grid, limits)
        for i in range(size):
            gradient[i, 0] = -pull[i]
            for j in range(size):
                information[i, j] = fixed[i, j]
                gradient[i, 0] += fixed[i, j] * p[j]
        for k in range(count):
            sigma = samples.sigma_m[k]
            limit = max(wide[k] * 0.5**turn, limits.cut_m, 3.0 * sigma)
            keep[k] = max(1.0 - (residual[k] / limit) ** 2, 0.0) ** 2
            if keep[k] == 0.0:
                continue
            weight = keep[k] / sigma**2
            for i in range(size):
                weighted = weight * jacobian[k, i]
                gradient[i, 0] += weighted * residual[k]
                for j in range(i + 1):
                    information[i, j] += weighted * jacobian[k, j]
        for i in range(size):
            for j in range(i):
                information[j, i] = information[i, j]
        step = solve(information.copy(), gradient.copy())
        for i in range(size):
            p[i] -= step[i, 0]
    return p, information, keep > 0.1
