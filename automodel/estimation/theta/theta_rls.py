"""Recursive least squares with forgetting on theta(s), and a Kalman filter on the line's distance.

Cudrano et al. 2020, eq. (3)-(13). The paper's recursion over the points of a frame, with the forgetting factor mu at
the first of them, is one step in information form (L is the inverse of the paper's R):

    L <- mu L + Phi^T W Phi,   b <- mu b + Phi^T W theta,   w <- L^-1 b

Beyond the paper: the origin s = 0 is the foot of the perpendicular from the car's reference point and moves with the
car, which is a linear map on w and the congruent one on L. The line's distance from the reference point is filtered
separately. A weak prior draws the curvature and its rates to zero where few points are seen; it is added to L and b
when w is solved for and not kept in them, so that it stays weak against all points together.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from automodel.curves.foot import LEAST_STRETCH, foot_on_circle, nearest_samples
from automodel.estimation.road import NODE, WALK
from automodel.estimation.theta.heading_polynomial import ORDER, HeadingPolynomial, shift_matrix
from automodel.estimation.theta.line_spline import SampledLine
from automodel.geometry import SE2
from automodel.types import FloatArray

_IDENTITY: FloatArray = np.eye(ORDER)


@dataclass(frozen=True, slots=True, kw_only=True)
class ThetaRlsConfig:
    """Scales of the filter; lengths in lane widths, so that one set serves scale cars and highways.

    The weight of a point falls by e within a distance of `memory_lanes`; a second counts as a lane width. `prior_rad`:
    standard deviation of the second to fourth coefficient at `scale_lanes`; infinity switches the prior off. The
    cubic's own error at s is `model_rad` (1 + (s / `sight_lanes`)^2).
    """

    lane_width_m: float
    reference_x_m: float
    scale_lanes: float = 2.0
    memory_lanes: float = 0.1
    prior_rad: float = 2.5
    model_rad: float = 0.02
    sight_lanes: float = NODE

    def __post_init__(self) -> None:
        lengths = (self.lane_width_m, self.scale_lanes, self.memory_lanes, self.sight_lanes)
        if not all(value > 0.0 for value in (*lengths, self.model_rad, self.prior_rad)):
            raise ValueError("ThetaRlsConfig: lane width, scales, memories and priors must be positive")


class ThetaRls:
    """One line over time. `line` is None until `start` or `take`; all values are finite.

    `information` (4, 4) [1/rad^2] is L, of the coefficients of (s / scale)^k, lowest power first;
    `lateral_variance_m2` is that of `line.lateral_m`.
    """

    _DAMPING = 1e-10  # [1/rad^2] keeps the system regular without points; holds the coefficients where they are

    def __init__(self, config: ThetaRlsConfig) -> None:
        self.config = config
        self.scale_m = config.scale_lanes * config.lane_width_m
        self._reference_m = (config.reference_x_m, 0.0)
        self._prior = np.diag((0.0, 1.0, 1.0, 1.0)) / config.prior_rad**2
        self._held = self._prior + self._DAMPING * _IDENTITY
        self._solved: FloatArray | None = None
        self.forget()

    def forget(self) -> None:
        """Drop the line."""
        self.line: HeadingPolynomial | None = None
        self.lateral_variance_m2 = math.inf
        self._learn(np.zeros((ORDER, ORDER)), np.zeros(ORDER))
        self._kept = 1.0  # share of the weight of the last update's points that is left

    def start(
        self, s_m: FloatArray, theta_rad: FloatArray, weight: FloatArray, lateral_m: float, lateral_variance_m2: float
    ) -> None:
        """Start again from one frame's points (n,) and the line's distance, as in `update`.

        Without points, or with one that is not finite, there is no line afterwards. The variance of the distance is
        bounded by a squared lane width.
        """
        self.forget()
        if not len(s_m) or not (_finite(s_m, theta_rad, weight) and math.isfinite(lateral_m)):
            return
        self.lateral_variance_m2 = min(lateral_variance_m2, self.config.lane_width_m**2)
        theta = float(theta_rad[np.abs(s_m).argmin()])
        self.line = HeadingPolynomial(
            coefficients_rad=(theta, 0.0, 0.0, 0.0),
            scale_m=self.scale_m,
            reference_m=self._reference_m,
            lateral_m=lateral_m,
            s_min_m=float(s_m.min()),
            s_max_m=float(s_m.max()),
            max_curvature_per_m=2.0 / self.config.lane_width_m,  # about a point on the lane's other line
        )
        self.update(s_m, theta_rad, weight)

    def predict(self, after_from_before: SE2, distance_m: float, dt_s: float) -> None:
        """Move the line into the body frame after a motion of `distance_m` in `dt_s`, and forget accordingly.

        A motion that is not finite is ignored.
        """
        motion = (after_from_before.x_m, after_from_before.y_m, after_from_before.yaw_rad, distance_m, dt_s)
        if self.line is None or not all(map(math.isfinite, motion)):
            return
        config, unit = self.config, self.config.lane_width_m
        self.line, advance = self.line.moved(after_from_before)
        way = abs(distance_m) / unit + max(dt_s, 0.0)  # noise and light are new to a car that stands
        keep = math.exp(-way / config.memory_lanes)
        back = shift_matrix(-advance / self.scale_m)
        moved = back.T @ self.information @ back
        moved = 0.5 * (moved + moved.T)
        self._learn(keep * moved, keep * (back.T @ self._pull + after_from_before.yaw_rad * moved[:, 0]))
        self._kept *= keep
        self.lateral_variance_m2 += WALK**2 * way * unit * unit

    def update(
        self,
        s_m: FloatArray,
        theta_rad: FloatArray,
        weight: FloatArray,
        lateral_m: float | None = None,
        lateral_variance_m2: float = 0.0,
    ) -> None:
        """Add points (n,) of weights [1/rad^2], and the line's distance [m] where it was measured.

        Values that are not finite are ignored; theta may differ by whole turns. Nothing happens without a line.
        """
        if self.line is None:
            return
        if len(s_m) and _finite(s_m, theta_rad, weight):
            phi = design(s_m / self.scale_m)
            nearest = int(np.abs(s_m).argmin())
            off = self.line.heading_at(float(s_m[nearest])) - float(theta_rad[nearest])
            theta = theta_rad + (off - math.remainder(off, math.tau))
            before = np.array(self.line.coefficients_rad)
            w, *learnt = self._solve(before, phi, theta, weight)
            self._learn(*learnt)
            low, high = float(s_m.min()), float(s_m.max())
            # the cubic is valid where points are, and where points were as long as these have weight
            low = min(low, low + self._kept * (self.line.s_min_m - low))
            high = max(high, high + self._kept * (self.line.s_max_m - high))
            self._kept = 1.0
            w0, w1, w2, w3 = w.tolist()
            self.line = replace(self.line, coefficients_rad=(w0, w1, w2, w3), s_min_m=low, s_max_m=high)
        if lateral_m is not None:
            self._place(lateral_m, lateral_variance_m2)

    def take(self, sampled: SampledLine) -> None:
        """Add one frame's line: its directions update the shape, its points near the car the distance.

        Starts with it where there is no line yet.
        """
        place = project_foot(sampled, self._reference_m, self.line)
        model = self._model_error(place.s_m)
        weight = sampled.independence / (sampled.theta_sigma_rad**2 + model * model)
        if self.line is None:
            self.start(place.s_m, sampled.theta_rad, weight, place.lateral_m, math.inf)
        else:
            self.update(place.s_m, sampled.theta_rad, weight)
        if self.line is None:
            return
        if place.beside:
            self._place(place.lateral_m, float(sampled.lateral_sigma_m[place.nearest]) ** 2)
        else:
            self._place(*self._lateral(self.line, sampled, place.s_m))

    def heading_variance_here(self) -> float:
        """Variance [rad^2] of the direction at the foot, s = 0."""
        return float(self._covariance()[0, 0])

    def samples(self, s_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Direction [rad] and weight [1/rad^2] (n,) at s (n,), for a fit to all of them.

        The directions depend on four unknowns, so together they weigh as four. Raises ValueError without a line.
        """
        if self.line is None:
            raise ValueError("samples: there is no line; call start first")
        phi = design(s_m / self.scale_m)
        variance = np.einsum("ij,ij->i", phi @ self._covariance(), phi) + self._model_error(s_m) ** 2
        return phi @ self.line.coefficients_rad, ORDER / len(s_m) / variance

    def _covariance(self) -> FloatArray:
        if self._solved is None:
            self._solved = np.asarray(np.linalg.solve(self.information + self._held, _IDENTITY), dtype=np.float64)
        return self._solved

    def _model_error(self, s_m: FloatArray) -> FloatArray:
        far = s_m / (self.config.sight_lanes * self.config.lane_width_m)
        return self.config.model_rad * (1.0 + far * far)

    def _solve(
        self, w: FloatArray, phi: FloatArray, theta: FloatArray, weight: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Coefficients, information and its vector b with these points added."""
        weighted = (phi * weight[:, None]).T
        information, pull = self.information + weighted @ phi, self._pull + weighted @ theta
        step = np.linalg.solve(information + self._held, pull - (information + self._prior) @ w)
        return w + step, information, pull

    def _learn(self, information: FloatArray, pull: FloatArray) -> None:
        self.information, self._pull = information, pull
        self._solved = None

    def _place(self, lateral_m: float, variance_m2: float) -> None:
        """Update the distance by one measurement: a scalar Kalman filter."""
        if self.line is None or not (math.isfinite(lateral_m) and 0.0 <= variance_m2 < math.inf):
            return
        line = self.line
        gain = self.lateral_variance_m2 / max(self.lateral_variance_m2 + variance_m2, 1e-12)
        self.lateral_variance_m2 *= 1.0 - gain
        self.line = replace(line, lateral_m=line.lateral_m + gain * (lateral_m - line.lateral_m))

    def _lateral(self, line: HeadingPolynomial, sampled: SampledLine, s: FloatArray) -> tuple[float, float]:
        """Distance [m] and its variance [m^2] of a line that does not reach the foot.

        They follow through theta(s) from the samples, with less weight the farther these are.
        """
        theta = sampled.theta_rad
        away = sampled.points_m - line.points(s)
        residual = away[:, 1] * np.cos(theta) - away[:, 0] * np.sin(theta)
        share = np.cos(theta - line.heading_at(0.0))
        bearing = self.heading_variance_here()
        weighted = share / (sampled.lateral_sigma_m**2 + bearing * s * s)
        total = float(weighted @ share)
        if not total > 0.0:
            return math.nan, math.inf
        step = float(weighted @ residual) / total
        return line.lateral_m + step, 1.0 / (total * max(sampled.independence, 1.0 / len(s)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FootProjection:
    """Samples of a line beside the car: arc lengths (n,) from the foot of the reference point, the line's distance [m].

    `nearest` is the index of the sample nearest to the foot; `beside` is whether the samples reach the foot.
    """

    s_m: FloatArray
    lateral_m: float
    nearest: int
    beside: bool


def project_foot(
    sampled: SampledLine, reference_m: tuple[float, float], known: HeadingPolynomial | None
) -> FootProjection:
    """Project the reference point onto samples of a line.

    Where they start beyond the foot, the known line bridges the gap, or else the arc of all samples.
    """
    i = int(nearest_samples(sampled.points_m, np.array([reference_m]))[0])
    last = len(sampled.s_m) - 1
    s, theta = float(sampled.s_m[i]), float(sampled.theta_rad[i])
    cos, sin = math.cos(theta), math.sin(theta)
    x, y = (reference_m - sampled.points_m[i]).tolist()
    ahead, left = x * cos + y * sin, y * cos - x * sin
    beside = not ((i == 0 and ahead < 0.0) or (i == last and ahead > 0.0))
    if not beside and known is not None:
        start = sampled.points_m[i].tolist()
        foot_m, _ = known.foot((start[0], start[1]), near_s_m=-ahead)
        return FootProjection(s_m=sampled.s_m + (foot_m - s), lateral_m=known.lateral_m, nearest=i, beside=False)
    low, high = (max(i - 1, 0), min(i + 1, last)) if beside else (0, last)
    kappa = float((sampled.theta_rad[high] - sampled.theta_rad[low]) / (sampled.s_m[high] - sampled.s_m[low]))
    step, left = foot_on_circle(ahead, left, kappa, LEAST_STRETCH)
    return FootProjection(s_m=sampled.s_m - (s + step), lateral_m=-left, nearest=i, beside=beside)


def design(u: FloatArray) -> FloatArray:
    """Phi (n, 4), eq. (6), lowest power first."""
    phi = np.empty((len(u), ORDER))
    phi[:, 0] = 1.0
    phi[:, 1] = u
    phi[:, 2] = u * u
    phi[:, 3] = phi[:, 2] * u
    return phi


def _finite(s: FloatArray, theta: FloatArray, weight: FloatArray) -> bool:
    with np.errstate(invalid="ignore"):
        return math.isfinite(float((s + theta * weight).sum()))
