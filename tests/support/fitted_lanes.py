"""Lanes, and their points as a car sees them, for the tests of the fit."""

from __future__ import annotations

import numpy as np

from automodel.estimation.polynomial.lane_fit import LaneFit, LaneFitConfig, LanePrior, LineSamples
from automodel.geometry import SE2
from tests.support.world_lanes import WorldLane, arc

REFERENCE_M = 0.13
WIDTH_M = 0.4
S0 = 3.0  # where the car stands on its lane
CONFIG = LaneFitConfig(lane_width_m=WIDTH_M, reference_x_m=REFERENCE_M)
FIT = LaneFit(CONFIG)

LANES = {
    "straight": arc(0.0),
    "left": arc(0.8),
    "right": arc(-0.8),
    "clothoid": WorldLane(lambda s: 0.5 * (s - S0), 10.0, WIDTH_M),
    "s-bend": WorldLane(lambda s: 0.7 * np.cos(2.0 * (s - S0)), 10.0, WIDTH_M),
    "into a bend": WorldLane(lambda s: -0.8 * np.clip((s - S0 - 0.3) / 0.3, 0.0, 1.0), 10.0, WIDTH_M),
}


def samples_of(
    lane: WorldLane, car: SE2, sigma_m: float = 0.002, from_m: float = -0.4, to_m: float = 1.4
) -> LineSamples:
    s = np.linspace(S0 + from_m, S0 + to_m, 20)
    left, right = lane.seen_from(car, s, +1), lane.seen_from(car, s, -1)
    return LineSamples(
        points_m=np.concatenate((left, right)),
        side=np.repeat((1.0, -1.0), len(s)),
        sigma_m=np.full(2 * len(s), sigma_m),
    )


def loose_prior(fit: LaneFit, mean: np.ndarray) -> LanePrior:
    unit = fit.config.lane_width_m
    nodes = np.full(len(fit.nodes_m), 1.0 / unit)
    return LanePrior(mean=mean, sigma=np.concatenate(([0.3 * unit, 0.5], nodes, [0.1 * unit, 0.003])))


def true_parameters(fit: LaneFit, lane: WorldLane, s_m: float, offset_m: float, heading_rad: float) -> np.ndarray:
    return np.concatenate(([offset_m, -heading_rad], lane.curvature(s_m + fit.nodes_m), [lane.width_m, 0.0]))
