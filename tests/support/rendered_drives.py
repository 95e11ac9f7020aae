"""Drives along simulated lanes, rendered and estimated frame by frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from automodel.assembly.parts import make_pipeline
from automodel.config import CameraConfig, CarConfig, Extrinsics, Intrinsics
from automodel.geometry import SE2, GroundCamera
from automodel.interfaces import Pipeline
from automodel.signals import Frame, LaneEstimate, LaneStatus, Motion, MotionSource
from automodel.sim.appearance import Appearance
from automodel.sim.renderer import Renderer
from automodel.sim.track import Lane, Track
from automodel.sim.truth import Truth, TruthFollower

CAR = CarConfig()


def camera(
    width_px: int = 640,
    height_px: int = 360,
    focal_px: float = 480.0,
    distortion: float = 0.0,
    colour: bool = False,
    **extrinsics: float,
) -> CameraConfig:
    return CameraConfig(
        width_px=width_px,
        height_px=height_px,
        colour=colour,
        intrinsics=Intrinsics(
            fx_px=focal_px,
            fy_px=focal_px,
            cx_px=0.5 * (width_px - 1),
            cy_px=0.5 * (height_px - 1),
            distortion=(distortion, 0.0, 0.0, 0.0, 0.0),
        ),
        extrinsics=Extrinsics(**extrinsics),
    )


def renderer(track: Track, car: CarConfig, look: Appearance | None = None) -> Renderer:
    eye = GroundCamera.from_config(car.camera)
    return Renderer(track.paint(), track.floor, track.obstacles, eye, look or Appearance(), colour=car.camera.colour)


@dataclass(frozen=True, kw_only=True)
class Seen:
    """One frame: what the pipeline was given and said, and what was true."""

    frame: Frame
    motion: Motion
    estimate: LaneEstimate
    truth: Truth

    @property
    def offset_error_m(self) -> float:
        assert self.estimate.pose is not None
        return self.estimate.pose.offset_m - self.truth.offset_m

    @property
    def heading_error_rad(self) -> float:
        assert self.estimate.pose is not None
        return math.remainder(self.estimate.pose.heading_rad - self.truth.heading_rad, math.tau)


@dataclass(kw_only=True)
class RenderedDrive:
    """A car that follows a lane with a swinging offset, its camera, and a pipeline.

    The motion reported is the true one, or unknown.
    """

    track: Track
    car: CarConfig = CAR
    direction: str = "forward"
    look: Appearance | None = None
    rate_hz: float = 30.0
    speed_mps: float = 1.0
    swing: float = 0.08  # of the lane's width
    source: MotionSource = MotionSource.MEASURED
    pipeline: Pipeline | None = None  # None: `windows`

    def __post_init__(self) -> None:
        self.lane: Lane = self.track.lane(self.direction)
        self.renderer = renderer(self.track, self.car, self.look)
        self.estimator: Pipeline = self.pipeline or make_pipeline("windows", self.car)
        self.follower = TruthFollower(self.lane, self.car.vehicle.reference_x_m)

    def pose(self, s_m: float) -> SE2:
        """World pose of the body; s counts at the rear axle."""
        width = float(self.lane.width_m(s_m))
        phase = s_m / (2.0 * width)
        return self.lane.pose(s_m, self.swing * width * math.sin(phase), math.atan(0.5 * self.swing * math.cos(phase)))

    def picture(self, pose: SE2, yaw_rate_radps: float, t_ns: int, index: int) -> Frame:
        image = self.renderer.render(pose.x_m, pose.y_m, pose.yaw_rad, self.speed_mps, yaw_rate_radps, index)
        return Frame(t_ns=t_ns, index=index, image=image)

    def run(self, from_m: float, to_m: float, t0_ns: int = 0) -> list[Seen]:
        period_s = 1.0 / self.rate_hz
        seen = []
        for index in range(round((to_m - from_m) / (self.speed_mps * period_s))):
            s_m = from_m + index * period_s * self.speed_mps
            pose, before = self.pose(s_m), self.pose(s_m - period_s * self.speed_mps)
            turn = math.remainder(pose.yaw_rad - before.yaw_rad, math.tau)
            way = math.hypot(pose.x_m - before.x_m, pose.y_m - before.y_m) / float(np.sinc(turn / math.tau))
            known = self.source is not MotionSource.NONE
            t_ns = t0_ns + round(index * period_s * 1e9)
            motion = Motion(
                t_ns=t_ns,
                speed_mps=way / period_s if known else 0.0,
                yaw_rate_radps=turn / period_s if known else 0.0,
                source=self.source,
            )
            frame = self.picture(pose, turn / period_s, t_ns, index)
            truth = self.follower.step(pose.x_m, pose.y_m, pose.yaw_rad)
            seen.append(Seen(frame=frame, motion=motion, estimate=self.estimator.step(frame, motion), truth=truth))
        return seen


def check_sound(estimate: LaneEstimate, t_ns: int) -> None:
    """What holds for every estimate, whatever the image: no NaN, and everything or nothing."""
    assert estimate.t_ns == t_ns
    assert estimate.frame_age_ns >= 0
    if estimate.status is LaneStatus.LOST:
        assert estimate.pose is None
        assert estimate.left is None
        assert estimate.right is None
        assert estimate.centerline is None
        assert estimate.crossing is None
        return
    assert estimate.pose is not None
    assert estimate.left is not None
    assert estimate.right is not None
    assert estimate.centerline is not None
    pose = estimate.pose
    assert np.isfinite([pose.offset_m, pose.heading_rad, pose.width_m, pose.curvature_per_m]).all()
    assert np.isfinite(pose.covariance).all()
    assert (np.linalg.eigvalsh(pose.covariance) > 0).all()
    for line in (estimate.left, estimate.right):
        assert np.isfinite(line.points_m).all()
        assert (len(line.points_m) > 0) == line.seen
        assert np.isfinite(line.curve.position(np.linspace(0.0, line.curve.length_m, 9))).all()
    assert np.isfinite(estimate.centerline.position(np.linspace(0.0, estimate.centerline.length_m, 9))).all()
    seen = int(estimate.left.seen) + int(estimate.right.seen)
    assert estimate.status is (LaneStatus.COASTING, LaneStatus.ONE_LINE, LaneStatus.TRACKING)[seen]
    assert (estimate.frame_age_ns == 0) == (seen > 0)
    if estimate.crossing is not None:
        assert np.isfinite([estimate.crossing.distance_m, estimate.crossing.angle_rad]).all()


def with_camera(seen_by: CameraConfig) -> CarConfig:
    return replace(CAR, camera=seen_by)
