"""What can go wrong with perception: hooks that take a right estimate and give a wrong one, or none."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from automodel.bench.faults.hooks import LaneHook
from automodel.curves import Curve, TabulatedCurve, line
from automodel.signals import LaneEstimate, LanePose, LaneStatus


def raising(estimate: LaneEstimate) -> LaneEstimate:
    """An exception."""
    raise RuntimeError("the pipeline has failed")


def lost(estimate: LaneEstimate) -> LaneEstimate:
    """No lane."""
    return LaneEstimate(t_ns=estimate.t_ns, status=LaneStatus.LOST)


def coasting(estimate: LaneEstimate) -> LaneEstimate:
    """No line seen, carried on by the car's motion."""
    return dataclasses.replace(estimate, status=LaneStatus.COASTING) if estimate.valid else estimate


def with_pose(**changes: Any) -> LaneHook:
    """Other values in fields of the pose."""

    def hook(estimate: LaneEstimate) -> LaneEstimate:
        if estimate.pose is None:
            return estimate
        return dataclasses.replace(estimate, pose=dataclasses.replace(estimate.pose, **changes))

    return hook


def without_pose(estimate: LaneEstimate) -> LaneEstimate:
    """An estimate that says to be valid and has no pose."""
    return dataclasses.replace(estimate, pose=None)


def decoy(aside_m: float) -> LaneHook:
    """Another line is taken for the lane's: all of the lane lies `aside_m` to the left."""

    def hook(estimate: LaneEstimate) -> LaneEstimate:
        pose, centerline = estimate.pose, estimate.centerline
        if pose is None or centerline is None:
            return estimate
        aside = dataclasses.replace(pose, offset_m=pose.offset_m - aside_m)
        return dataclasses.replace(estimate, pose=aside, centerline=_beside(centerline, aside_m))

    return hook


def crossing(turn_rad: float) -> LaneHook:
    """A line across the road is taken for the lane's: the lane turns by `turn_rad` to the left at the car."""

    def hook(estimate: LaneEstimate) -> LaneEstimate:
        if estimate.pose is None:
            return estimate
        pose = LanePose(
            offset_m=estimate.pose.offset_m,
            heading_rad=-turn_rad,
            width_m=estimate.pose.width_m,
            curvature_per_m=0.0,
            covariance=estimate.pose.covariance,
        )
        return dataclasses.replace(estimate, pose=pose, centerline=line(0.0, 0.0, turn_rad, 1.4))

    return hook


def for_first(count: int, spoil: LaneHook) -> LaneHook:
    """The first `count` estimates only."""
    seen = 0

    def hook(estimate: LaneEstimate) -> LaneEstimate:
        nonlocal seen
        seen += 1
        return spoil(estimate) if seen <= count else estimate

    return hook


def _beside(curve: Curve, aside_m: float) -> TabulatedCurve:
    s = np.linspace(0.0, curve.length_m, 31)
    return TabulatedCurve(s, curve.offset_position(s, aside_m), curve.heading(s), curve.curvature(s))
