"""A lane to start with on a road with large radii, of whose lines a single image shows worn dashes and dots."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from automodel.config import CarConfig
from automodel.geometry import GroundCamera
from automodel.perception.rows.brightness import Brightness
from automodel.perception.rows.lane_pair_search import LaneSearchConfig, LineIntegralSearch
from automodel.perception.rows.row_ground_lookup import GENTLE_LANES
from automodel.tracking.belief import STATION, LaneBelief, RoadModel
from automodel.tracking.integrity import ANGLE_RAD
from automodel.types import FloatArray, Image


class GentleLane(NamedTuple):
    """A lane, and points (n, 2) [m] on its left and right line, near to far, with their sigmas (n,) [m]."""

    belief: LaneBelief
    left_m: FloatArray
    right_m: FloatArray
    left_sigma_m: FloatArray
    right_sigma_m: FloatArray


class GentleStart:
    """Finds a lane by line integrals over the whole image; nothing where the road may have tight bends.

    How tight they may be is what car.toml's `[pipeline.contour] radius_lanes` says of the road.
    """

    def __init__(self, car: CarConfig, camera: GroundCamera, ahead_lanes: float) -> None:
        unit, lane, radius = car.lane.width_m, car.lane, car.pipeline.contour.radius_lanes
        self._unit, self._radius, self._reference_x_m = unit, radius, car.vehicle.reference_x_m
        self._camera, self._lane = camera, lane
        near = max(camera.first_visible_x_m() - self._reference_x_m, 0.0)
        self._s = np.arange(near, near + ahead_lanes * unit, STATION * unit)
        light = Brightness("grey", lane.markings == "dark")
        self._polarities = (light, light.negative())[: 1 + (lane.markings == "both")]
        self._search: LineIntegralSearch | None = None
        self.look_for(lane.marking_width_m)

    def look_for(self, marking_m: float) -> None:
        """Look for markings of this width from now on."""
        self._road = RoadModel(lane_width_m=self._unit, marking_width_m=marking_m)
        if self._radius < GENTLE_LANES:
            return
        searched = LaneSearchConfig(
            lane_width_m=self._unit,
            marking_m=marking_m,
            reference_x_m=self._reference_x_m,
            radius_lanes=self._radius,
            taper=ANGLE_RAD * self._unit / float(self._camera.centre_m[2]),
        )
        self._search = LineIntegralSearch(self._camera, searched)

    def step(self, image: Image) -> GentleLane | None:
        """The lane in an image of the camera's size; None where there is none, or another search is better."""
        if self._search is None:
            return None
        for brightness in self._polarities:
            lane = self._search.step(image, brightness)
            if lane is None:
                continue
            belief = LaneBelief.arc(lane.mean, lane.covariance, self._road, self._reference_x_m)
            (left, _, left_sigma), (right, _, right_sigma) = (belief.beside(self._s, side) for side in (+0.5, -0.5))
            return GentleLane(belief, left, right, left_sigma, right_sigma)
        return None
