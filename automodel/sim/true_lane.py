"""Perception without any error: the lane as the simulator knows it."""

from __future__ import annotations

import math

import numpy as np

from automodel.curves import TabulatedCurve
from automodel.geometry import SE2
from automodel.signals import Frame, LaneEstimate, LanePose, LaneStatus, Motion
from automodel.sim.track import Lane
from automodel.sim.world import Scene

BEHIND_LANES, AHEAD_LANES = 0.3, 3.5  # of the reference point
SEEN_LANES = 1.5  # a lane further aside is out of sight
_STEP_LANES = 0.1  # between two points


class TrueLane:
    """Implements `Pipeline` on what `on_scene` was told last: it belongs behind a simulated camera's truth.

    No picture is looked at. Lost where the lane is too far aside to be seen. The centerline's points are those of a
    table of the whole lane, so that a step costs little.
    """

    name = "truth"

    def __init__(self, lane: Lane) -> None:
        line, width_m = lane.centerline, float(lane.width_m(0.0))
        self._step_m = _STEP_LANES * width_m
        self._behind, self._ahead = round(BEHIND_LANES / _STEP_LANES), round(AHEAD_LANES / _STEP_LANES)
        count = math.ceil(line.length_m / self._step_m)
        s = np.arange(-self._behind, count + self._ahead + 1) * self._step_m
        self._points_m, self._headings_rad = line.position(s), line.heading(s)
        self._curvatures_per_m = line.curvature(s)
        self._scenes: dict[int, Scene] = {}

    def on_scene(self, scene: Scene) -> None:
        """The truth of a frame that is about to be delivered."""
        self._scenes[scene.index] = scene

    def step(self, frame: Frame, motion: Motion) -> LaneEstimate:
        """The lane in this frame."""
        scene = self._scenes.get(frame.index)
        self._scenes = {index: kept for index, kept in self._scenes.items() if index > frame.index}
        if scene is None or abs(scene.truth.offset_m) > SEEN_LANES * scene.truth.width_m:
            return LaneEstimate(t_ns=frame.t_ns, status=LaneStatus.LOST)
        truth, car = scene.truth, scene.car
        pose = LanePose(
            offset_m=truth.offset_m,
            heading_rad=truth.heading_rad,
            width_m=truth.width_m,
            curvature_per_m=truth.curvature_per_m,
            covariance=np.zeros((3, 3)),
        )
        first = int(truth.s_m / self._step_m)
        part = slice(first, first + self._behind + self._ahead + 1)
        headings = self._headings_rad[part] - car.yaw_rad
        centerline = TabulatedCurve(
            np.arange(len(headings)) * self._step_m,
            SE2(car.x_m, car.y_m, car.yaw_rad).inverse().apply(self._points_m[part]),
            headings - math.tau * round(float(headings[self._behind]) / math.tau),
            self._curvatures_per_m[part],
        )
        return LaneEstimate(t_ns=frame.t_ns, status=LaneStatus.TRACKING, centerline=centerline, pose=pose)

    def reset(self) -> None:
        """Nothing but the truth is kept."""
