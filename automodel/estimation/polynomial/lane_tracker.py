"""The lane over time: remembered points that move with the odometry, and one `LaneFit` per frame."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from automodel.compiled import compiled
from automodel.curves.lanes import LaneShape
from automodel.estimation.polynomial.lane_fit import (
    LaneFit,
    LaneFitConfig,
    LanePrior,
    LaneSolution,
    LineSamples,
)
from automodel.estimation.road import ANY_BEND, TAPER, TAPER_LANES, WALK
from automodel.geometry import SE2
from automodel.signals import Observation
from automodel.types import Bools, FloatArray

NO_MEMORY: FloatArray = np.empty((0, 4))  # x, y, side, sigma


@dataclass(frozen=True, slots=True, kw_only=True)
class Support:
    """Number of a frame's points that support the lane, by line."""

    left: int
    right: int


class LaneTracker:
    """One lane, tracked from frame to frame.

    The camera sees the ground only ahead of the car. So that points lie beside the car too, the nearest ones are
    remembered and moved by the odometry. The last solution, moved, is the prior of the next. `parameters` is None while
    there is no lane; `shape` is theirs. `blind_m` is the distance driven since a line was seen.
    """

    KEEP_EVERY_LANES = 0.06  # distance between two rounds of remembering
    KEEP_DEPTH_LANES = 0.7  # length of the near zone whose points are remembered
    ROUNDS = 3  # iterations of the fit in a frame
    # Sigmas that the curvature [1 / lane width] gains over a lane width: near the car, where it was seen before, and
    # far ahead.
    KAPPA_NEAR, KAPPA_FAR = ANY_BEND, 1.5

    def __init__(self, config: LaneFitConfig, near_x_m: float) -> None:
        self.fit = LaneFit(config)
        self.unit = config.lane_width_m
        self.near_x_m = near_x_m
        nodes = len(self.fit.nodes_m)
        u = self.unit
        far = self.fit.config.ahead_lanes * u
        sure = config.sure_lanes * u
        reach = np.clip((self.fit.nodes_m - sure) / (far - sure), 0.0, 1.0)
        kappa = (self.KAPPA_NEAR + (self.KAPPA_FAR - self.KAPPA_NEAR) * reach) / u
        self._sigma = np.concatenate(
            (
                [WALK * u, WALK],
                kappa,
                [WALK * u, TAPER * math.sqrt(2.0 / TAPER_LANES)],
            )
        )
        self._loose_sigma = np.concatenate(([0.05 * u, 0.05], np.full(nodes, 0.25 / u), [0.004 * u, 0.1 * TAPER]))
        self._nothing = self.fit.start(0.0, 0.0, 0.0, u)
        self._warm_up()
        self.parameters: FloatArray | None = None
        self.shape: LaneShape = self.fit.shape(self._nothing)
        self.forget()

    def forget(self) -> None:
        """Drop the lane and all remembered points."""
        self._take(None)
        self._memory = NO_MEMORY
        self._since_kept = np.inf
        self._motion_known = False
        self._step_m = 0.0
        self.blind_m = 0.0

    def move(self, after_from_before: SE2, distance_m: float, known: bool) -> None:
        """Move lane and points into the body frame after a motion; an unknown motion drops the points."""
        if self.parameters is not None:
            self.parameters = self.fit.moved(self.parameters, self.shape, after_from_before)
            self.shape = self.fit.shape(self.parameters)
        self._motion_known = known
        self._step_m = abs(distance_m)
        self.blind_m += abs(distance_m)
        if not known:
            self._memory = self._memory[:0]
            return
        self._since_kept += abs(distance_m)
        if len(self._memory):
            behind = self.fit.config.reference_x_m - self.fit.config.behind_lanes * self.unit
            motion = after_from_before.x_m, after_from_before.y_m, after_from_before.yaw_rad
            self._memory = _carried(self._memory, motion, WALK * abs(distance_m), behind)

    def place(self, parameters: FloatArray) -> None:
        """Believe the lane to have these parameters, without any points yet."""
        self.forget()
        self._take(parameters)

    def restart(self, seen: Observation, arc: FloatArray, sigma: FloatArray) -> tuple[LaneSolution, Support]:
        """Start near an arc (m,) that is known up to `sigma` (4,): of offset, heading, curvature, width."""
        samples = _samples(seen, NO_MEMORY)
        offset, heading, curvature, width = sigma.tolist()
        spread = np.concatenate(([offset, heading], np.full(len(self.fit.nodes_m), curvature), [width, TAPER]))
        solution = self.fit.solve(samples, LanePrior(mean=arc, sigma=np.maximum(spread, 0.1 * self._sigma)), rounds=6)
        self._take(solution.parameters)
        self._keep(samples, solution.inliers)
        return solution, _support(seen, solution.inliers)

    def update(self, seen: Observation) -> tuple[LaneSolution, Support]:
        """Update the lane by one frame's points; raises ValueError without a lane."""
        if self.parameters is None:
            raise ValueError("update: nothing is tracked; call start first")
        samples, fresh = _samples(seen, self._memory), slice(len(seen.left_m) + len(seen.right_m))
        solution = self.fit.solve(samples, self._prior(self.parameters), self.ROUNDS)
        self._take(solution.parameters)
        self._keep(samples, solution.inliers[fresh])
        support = _support(seen, solution.inliers)
        if max(support.left, support.right) >= 2:
            self.blind_m = 0.0
        return solution, support

    def _prior(self, parameters: FloatArray) -> LanePrior:
        mean, sigma = parameters.copy(), self._loose_sigma
        if self._motion_known:  # a random walk over the distance
            sigma = self._sigma * min(max(math.sqrt(self._step_m / self.unit), 0.1), 1.0)
        mean[-1] *= math.exp(-self._step_m / (TAPER_LANES * self.unit))
        return LanePrior(mean=mean, sigma=sigma)

    def _take(self, parameters: FloatArray | None) -> None:
        self.parameters = parameters
        self.shape = self.fit.shape(self._nothing if parameters is None else parameters)

    def _warm_up(self) -> None:
        """Compile everything that a frame calls, so that none waits for it."""
        memory = _carried(np.zeros((1, 4)), (0.0, 0.0, 0.0), 0.0, 0.0)
        nothing = _gathered(
            memory[:, :2].copy(), memory[:, :2].copy(), memory[:, 0].copy(), memory[:, 0].copy(), memory
        )
        _with_near(memory, nothing, np.ones(0, np.bool_), 0.0)

    def _keep(self, samples: LineSamples, good: Bools) -> None:
        """Remember the good ones of the first samples, if they are near and the car has driven on enough."""
        if self._since_kept < self.KEEP_EVERY_LANES * self.unit:
            return
        before = len(self._memory)
        self._memory = _with_near(self._memory, samples, good, self.near_x_m + self.KEEP_DEPTH_LANES * self.unit)
        if len(self._memory) > before:
            self._since_kept = 0.0


@compiled
def _carried(memory: FloatArray, motion: tuple[float, float, float], walk: float, behind_m: float) -> FloatArray:
    """Points (n, 4) after a motion (x, y, yaw) with a `walk` more of sigma; those beyond `behind_m` are dropped."""
    x0, y0, yaw = motion
    cos, sin = math.cos(yaw), math.sin(yaw)
    after, count = np.empty_like(memory), 0
    for x, y, side, sigma in memory:
        ahead = x0 + cos * x - sin * y
        if ahead > behind_m:
            after[count, 0], after[count, 1] = ahead, y0 + sin * x + cos * y
            after[count, 2], after[count, 3] = side, sigma + walk
            count += 1
    return after[:count]


def _samples(seen: Observation, memory: FloatArray) -> LineSamples:
    return _gathered(seen.left_m, seen.right_m, seen.left_sigma_m, seen.right_sigma_m, memory)


@compiled
def _gathered(
    left_m: FloatArray, right_m: FloatArray, left_sigma_m: FloatArray, right_sigma_m: FloatArray, memory: FloatArray
) -> LineSamples:
    """A frame's points, those of the left line first, and after them remembered ones (n, 4)."""
    left, both = len(left_m), len(left_m) + len(right_m)
    points_m, side, sigma_m = (
        np.empty((both + len(memory), 2)),
        np.empty(both + len(memory)),
        np.empty(both + len(memory)),
    )
    points_m[:left], side[:left], sigma_m[:left] = left_m, 1.0, left_sigma_m
    points_m[left:both], side[left:both], sigma_m[left:both] = right_m, -1.0, right_sigma_m
    points_m[both:], side[both:], sigma_m[both:] = memory[:, :2], memory[:, 2], memory[:, 3]
    return LineSamples(points_m, side, sigma_m)


@compiled
def _with_near(memory: FloatArray, samples: LineSamples, good: Bools, far_m: float) -> FloatArray:
    """Remembered points (n, 4), and after them those of the first samples that are `good` and nearer than `far_m`."""
    count, kept = len(memory), np.empty((len(memory) + len(good), 4))
    kept[:count] = memory
    for k in range(len(good)):
        if good[k] and samples.points_m[k, 0] < far_m:
            kept[count, :2], kept[count, 2], kept[count, 3] = samples.points_m[k], samples.side[k], samples.sigma_m[k]
            count += 1
    return kept[:count]


def _support(seen: Observation, inliers: Bools) -> Support:
    left, right = len(seen.left_m), len(seen.right_m)
    return Support(
        left=int(np.count_nonzero(inliers[:left])), right=int(np.count_nonzero(inliers[left : left + right]))
    )
