"""Steering onto the centerline: pure pursuit and Stanley, both with curvature feed-forward.

Both hold the vehicle's *reference point* on the centerline, whose pose pipelines report and metrics judge, so the rear
axle runs `rear_offset_m` to the inside of a bend. With feed-forward the steering for the lane's curvature is added, and
the feedback law sees the errors as on a straight lane: bends are not cut, and an arc is held without error. Without
feed-forward both are the laws of the textbook.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from automodel.config import ControlConfig, VehicleConfig
from automodel.control.path import LanePath
from automodel.control.vehicle_model import rear_offset_m, steering_rad
from automodel.geometry.se2 import SE2, wrap_angle

# The curvature is averaged over the distance driven in this time, because the lateral jerk limit makes a ramp of every
# step: 0.2 s from a bend at 1.5 m/s^2 into the opposite one at 16 m/s^3. Centred, the ramp costs millimetres.
FEED_FORWARD_WINDOW_S = 0.2
_MIN_WINDOW_WHEELBASES = 0.4
_MIN_STRETCH = 0.3


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneError:
    """The rear axle's offset from its desired path and its heading relative to the lane, left positive.

    `curvature_per_m` is the curvature of a path that keeps both constant.
    """

    offset_m: float
    heading_rad: float
    curvature_per_m: float


def lane_error(lane: LanePath, car: SE2, speed_mps: float, vehicle: VehicleConfig) -> LaneError:
    """The error of a car whose rear axle has the pose `car` in the frame of `lane`.

    A path at distance d to the left of a curve has the curvature kappa / (1 - kappa d).
    """
    s, d = lane.foot(car.x_m, car.y_m)
    half = 0.5 * max(speed_mps * FEED_FORWARD_WINDOW_S, _MIN_WINDOW_WHEELBASES * vehicle.wheelbase_m)
    kappa = lane.mean_curvature(s - half, s + half)
    return LaneError(
        offset_m=d - rear_offset_m(kappa, vehicle.reference_x_m),
        heading_rad=wrap_angle(car.yaw_rad - lane.heading(s)),
        curvature_per_m=kappa / max(1.0 - kappa * d, _MIN_STRETCH),
    )


class PurePursuit:
    """Pure pursuit (Coulter 1992): steer along the arc through the point of the path at the distance l.

    In the car's frame this target lies at the lateral distance y: kappa = 2 y / l^2. With feed-forward this is added to
    the lane's curvature, and y is that of a target on a straight lane: with offset e and heading psi,
    y = -(e cos psi + sqrt(l^2 - e^2) sin psi).
    """

    def __init__(self, control: ControlConfig, vehicle: VehicleConfig) -> None:
        self._control, self._vehicle = control, vehicle

    def steer(self, lane: LanePath, car: SE2, speed_mps: float) -> float:
        """Road-wheel angle [rad] for the rear axle at `car`, a pose in the frame of `lane`."""
        lookahead = max(self._control.lookahead_min_m, speed_mps * self._control.lookahead_s)
        if not self._control.feed_forward:
            y = _target_left_m(lane, car, lookahead)
            return steering_rad(2.0 * y / lookahead**2, self._vehicle.wheelbase_m)
        error = lane_error(lane, car, speed_mps, self._vehicle)
        e = min(max(error.offset_m, -lookahead), lookahead)
        psi = min(
            max(error.heading_rad, -0.5 * math.pi), 0.5 * math.pi
        )  # beyond a right angle the sine decreases again
        y = -(e * math.cos(psi) + math.sqrt(lookahead**2 - e * e) * math.sin(psi))
        return steering_rad(error.curvature_per_m + 2.0 * y / lookahead**2, self._vehicle.wheelbase_m)


def _target_left_m(lane: LanePath, car: SE2, lookahead_m: float) -> float:
    """Lateral distance [m] in the car's frame of the lane's point at the distance `lookahead_m`."""
    s, d = lane.foot(car.x_m, car.y_m)
    s += lookahead_m if abs(d) >= lookahead_m else math.sqrt(lookahead_m**2 - d * d)
    for _ in range(6):  # the path is nearly straight: the error shrinks fast
        x, y = lane.position(s)
        s += lookahead_m - math.hypot(x - car.x_m, y - car.y_m)
    x, y = lane.position(s)
    left = math.cos(car.yaw_rad) * (y - car.y_m) - math.sin(car.yaw_rad) * (x - car.x_m)
    return min(max(left, -lookahead_m), lookahead_m)


class Stanley:
    """Stanley (Hoffmann et al. 2007, eq. (5)): at the front axle, delta = -psi - atan(k e / (v + v0)).

    psi is the car's heading relative to the lane and e the front axle's offset; e decays at the rate k v / (v + v0).
    Without feed-forward both are taken at the front axle's foot, and the front axle is held on the centerline. With it
    they are those on a straight lane, e = e_rear + L sin psi, and atan(L kappa) is added.
    """

    def __init__(self, control: ControlConfig, vehicle: VehicleConfig) -> None:
        self._control, self._vehicle = control, vehicle

    def steer(self, lane: LanePath, car: SE2, speed_mps: float) -> float:
        """Road-wheel angle [rad] for the rear axle at `car`, a pose in the frame of `lane`."""
        wheelbase = self._vehicle.wheelbase_m
        if self._control.feed_forward:
            error = lane_error(lane, car, speed_mps, self._vehicle)
            front = error.offset_m + wheelbase * math.sin(error.heading_rad)
            return steering_rad(error.curvature_per_m, wheelbase) + self._law(error.heading_rad, front, speed_mps)
        axle = car @ SE2(wheelbase, 0.0, 0.0)
        s, d = lane.foot(axle.x_m, axle.y_m)
        return self._law(wrap_angle(car.yaw_rad - lane.heading(s)), d, speed_mps)

    def _law(self, heading_rad: float, offset_m: float, speed_mps: float) -> float:
        softened = abs(speed_mps) + self._control.stanley_softening_mps
        return -heading_rad - math.atan(self._control.stanley_gain_per_s * offset_m / softened)


def lateral_controller(control: ControlConfig, vehicle: VehicleConfig) -> PurePursuit | Stanley:
    """The controller named by `control.controller`."""
    return Stanley(control, vehicle) if control.controller == "stanley" else PurePursuit(control, vehicle)
