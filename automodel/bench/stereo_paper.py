"""`bench stereo-paper`: the highway sequence of the paper behind `stereo`, simulated, beside the paper's figures.

The paper's sequence is 25 s long, driven at 95 km/h with yaw rates up to 2 deg/s, and has one lane change. Here it is
driven by day and by night, by a level car and by one that pitches by up to a degree at 1.5 Hz, over hills and in
traffic, on a road of `sim.highway`; the monocular pipelines see the left camera's frames.

How far they can be compared:

- The paper gives no truth: its figures are the scatter of the lane's width and how far plane and lane reach. Errors
  here are those against the simulator's truth.
- Its cameras' data are not given. Here two of different lenses look outwards from the mirrors, 1.9 m apart.
- An estimate counts as one of the lane whose truth it is nearest to; a lane change is where that is another lane.
- Over hills the pitch is that against the slope under the car, and the plane is one of ground that bends away.
- Its rate is that of MATLAB on one core of 2008; ours that of one thread of this machine.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from automodel.assembly.parts import make_pipeline
from automodel.assembly.simulated_car import renderers
from automodel.bench.accuracy import AccuracyMeter, Row
from automodel.config import CameraConfig, CarConfig, Extrinsics, Intrinsics, LaneConfig, PipelineConfig, VehicleConfig
from automodel.config.camera import SecondCamera
from automodel.config.pipelines import CenterlineConfig, ContourConfig, StereoConfig, WindowsConfig
from automodel.console.messages import say
from automodel.console.workers import Sweep, Tick, spread
from automodel.geometry.stereo_rig import Plane
from automodel.interfaces import Pipeline, cameras_of
from automodel.pipelines.stereo import Stereo
from automodel.signals import Frame, LaneEstimate, LaneStatus, Motion, StereoFrame
from automodel.sim.appearance import Appearance
from automodel.sim.highway import HILLS, Highway, HighwayDrive, LaneChange, traffic
from automodel.sim.random_worlds import Nod
from automodel.sim.renderer import Standing
from automodel.sim.trajectory import Odometer
from automodel.sim.truth import Truth, TruthFollower

PAPER: Row = {
    "ride": "the paper", "pipeline": "stereo", "width_m": 3.5, "width_sd_m": 0.2, "lane_reach_m": 54.0,
    "plane_reach_m": 42.0, "changes": 1, "change_at_pct": 75.0, "pairs_per_s": 0.85,
}  # fmt: skip
COLUMNS = (
    "ride", "pipeline", "width_m", "width_sd_m", "offset_mae_m", "heading_mae_deg", "pitch_mae_deg", "lane_reach_m",
    "plane_reach_m", "availability_pct", "changes", "change_at_pct", "misled_pct", "pairs_per_s", "frames",
)  # fmt: skip
SPEED_MPS = 95.0 / 3.6
SECONDS, RATE_HZ = 25.0, 20.0
LANE_CHANGE = LaneChange(from_s=12.5)  # on the second straight
RUN_IN_S = 0.5  # until a lane is found
LIGHTS = {  # by day and by night: headlights on wet-dark asphalt, a camera at the end of its gain
    "day": Appearance(
        floor_grey=95.0, floor_texture="asphalt", floor_contrast=0.3, marking_grey=210.0, wear=0.1, defocus_px=0.6,
        read_noise=1.5, shot_noise=0.05, background="outdoor", background_grey=150.0,
    ),
    "night": Appearance(
        floor_grey=60.0, floor_texture="asphalt", floor_contrast=0.4, marking_grey=210.0, wear=0.2, light=0.4,
        gradient=-0.02, defocus_px=0.8, read_noise=4.0, shot_noise=0.1, background_grey=15.0,
    ),
}  # fmt: skip
BOUNCES_DEG = (0.0, 1.0)
BEND_RAD = 0.035  # by which the ground turns upwards or down at the far end of the view, at most
HEAVE_M_PER_RAD = 1.15  # of a body that rolls: 2 cm for each degree, at a rate of its own


def mirror_car() -> CarConfig:
    """A car with a camera in each mirror, 1.9 m apart; neither parallel nor alike."""
    width_px, height_px = 640, 480

    def lens(f_px: float, k1: float) -> Intrinsics:
        centre = {"cx_px": 0.5 * (width_px - 1), "cy_px": 0.5 * (height_px - 1)}
        return Intrinsics(fx_px=f_px, fy_px=f_px, distortion=(k1, 0.0, 0.0, 0.0, 0.0), **centre)

    right = SecondCamera(
        intrinsics=lens(600.0, -0.03),
        extrinsics=Extrinsics(x_m=1.75, y_m=-0.95, z_m=1.05, pitch_rad=0.10, yaw_rad=0.05, roll_rad=-0.04),
    )
    return CarConfig(
        vehicle=VehicleConfig(
            wheelbase_m=2.65, reference_x_m=1.25, width_m=1.8, front_overhang_m=0.9, rear_overhang_m=0.8
        ),
        camera=CameraConfig(
            width_px=width_px,
            height_px=height_px,
            rate_hz=RATE_HZ,
            intrinsics=lens(560.0, -0.05),
            extrinsics=Extrinsics(x_m=1.7, y_m=0.95, z_m=1.15, pitch_rad=0.12, yaw_rad=-0.06, roll_rad=0.03),
            right=right,
        ),
        lane=LaneConfig(width_m=3.6, marking_width_m=0.15),
        pipeline=PipelineConfig(  # a highway's bends are wide, and its dashes 18 m apart
            centerline=CenterlineConfig(view_ahead_lanes=8.0),
            contour=ContourConfig(look_ahead_lanes=8.0, radius_lanes=50.0),
            stereo=StereoConfig(look_ahead_lanes=20.0, rows=128, lane_changes=True),
            windows=WindowsConfig(view_ahead_lanes=8.0),
        ),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Ride:
    """One drive along the sequence, or its first `seconds`.

    `bounce_deg`: pitch of the body, either way; `sway_deg`: its roll, with some heave. `hills`, `traffic`: whether
    there are any.
    """

    light: str
    bounce_deg: float
    pipelines: tuple[str, ...]
    seed: int = 0
    seconds: float = SECONDS
    sway_deg: float = 0.0
    hills: bool = False
    traffic: bool = False

    @property
    def words(self) -> str:
        """In a few words."""
        words = [self.light]
        words += [f"{name} +-{deg:g} deg" for name, deg in (("pitch", self.bounce_deg), ("roll", self.sway_deg)) if deg]
        words += [name for name, there in (("hills", self.hills), ("traffic", self.traffic)) if there]
        return ", ".join(words)

    def body(self, t_s: float) -> Plane:
        """How the car's body stands over the road."""
        bounce_rad, sway_rad = math.radians(self.bounce_deg), math.radians(self.sway_deg)
        pitch = Nod(amplitude_rad=bounce_rad, rate_hz=1.5, phase_rad=0.0).at(t_s)
        roll = Nod(amplitude_rad=sway_rad, rate_hz=1.1, phase_rad=1.0).at(t_s)
        lift = Nod(amplitude_rad=sway_rad, rate_hz=1.3, phase_rad=2.0).at(t_s)
        return Plane(HEAVE_M_PER_RAD * lift, pitch, roll)


@dataclass(slots=True)
class Watched:
    """What a pipeline made of a ride."""

    pipeline: Pipeline
    accuracy: AccuracyMeter = field(default_factory=AccuracyMeter)
    width_m: list[float] = field(default_factory=list)  # where both lines are seen
    pitch_deg: list[float] = field(default_factory=list)  # errors
    lane_reach_m: list[float] = field(default_factory=list)
    plane_reach_m: list[float] = field(default_factory=list)
    change_at: list[float] = field(default_factory=list)  # shares of half a lane, from the middle of the lane left
    took_s: list[float] = field(default_factory=list)
    lane: int = 0

    @property
    def pairs(self) -> bool:
        """Whether it sees with both eyes."""
        return cameras_of(self.pipeline) > 1

    def see(self, pair: StereoFrame, motion: Motion, truths: Sequence[Truth], pitch_rad: float) -> None:
        """One pair, of which a monocular pipeline gets the left image; `truths`: of each lane, the rightmost first."""
        frame = pair if self.pairs else Frame(t_ns=pair.t_ns, index=pair.index, image=pair.left)
        step: Callable[..., LaneEstimate] = self.pipeline.step
        started = time.perf_counter()
        estimate = step(frame, motion)
        self.took_s.append(time.perf_counter() - started)
        if estimate.t_ns * 1e-9 < RUN_IN_S:
            return
        self._follow(estimate, truths)
        self.accuracy.add(estimate.t_ns * 1e-9, estimate, truths[self.lane])
        if estimate.pose is None or estimate.status is not LaneStatus.TRACKING:
            return
        self.width_m.append(estimate.pose.width_m)
        seen = [line.points_m for line in (estimate.left, estimate.right) if line is not None and len(line.points_m)]
        if seen:
            self.lane_reach_m.append(max(float(points[:, 0].max()) for points in seen))
        if isinstance(self.pipeline, Stereo):
            self.pitch_deg.append(math.degrees(abs(self.pipeline.plane.pitch_rad - pitch_rad)))
            if self.pipeline.plane_reach_m > 0.0:
                self.plane_reach_m.append(self.pipeline.plane_reach_m)

    def _follow(self, estimate: LaneEstimate, truths: Sequence[Truth]) -> None:
        """Which lane the estimate is of."""
        if estimate.pose is None:
            return
        off = [abs(estimate.pose.offset_m - truth.offset_m) for truth in truths]
        lane = int(np.argmin(off))
        if lane != self.lane:
            truth = truths[self.lane]
            self.change_at.append(abs(truth.offset_m) / (0.5 * truth.width_m))
            self.lane = lane

    def row(self) -> Row:
        """The metrics; None where no frame gives one."""
        row = self.accuracy.row()
        return {
            "width_m": _mean(self.width_m),
            "width_sd_m": float(np.std(self.width_m)) if self.width_m else None,
            "offset_mae_m": row["offset_mae_m"],
            "heading_mae_deg": row["heading_mae_deg"],
            "pitch_mae_deg": _mean(self.pitch_deg),
            "lane_reach_m": _mean(self.lane_reach_m),
            "plane_reach_m": _mean(self.plane_reach_m),
            "availability_pct": row["availability_pct"],
            "changes": len(self.change_at),
            "change_at_pct": 100.0 * self.change_at[0] if len(self.change_at) == 1 else None,
            "misled_pct": row["misled_pct"],
            "pairs_per_s": 1.0 / float(np.median(self.took_s)),
            "frames": row["frames"],
        }


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def measure_ride(ride: Ride, tick: Tick) -> list[Row]:
    """A row for each pipeline."""
    car = mirror_car()
    track, lanes = Highway().build()
    drive = HighwayDrive(lanes[0], SPEED_MPS, (LANE_CHANGE,))
    followers = [TruthFollower(lane, car.vehicle.reference_x_m) for lane in lanes]
    look = replace(LIGHTS[ride.light], noise_seed=ride.seed, floor_seed=ride.seed, wear_seed=ride.seed)
    turned_rad = math.radians(ride.bounce_deg + ride.sway_deg) + BEND_RAD * ride.hills
    eyes, rig = renderers(track, car, look, turned_rad), Stereo.rig(car)
    others = traffic(SPEED_MPS, ride.seed) if ride.traffic else ()
    odometer, watched = Odometer(ride.seed), [Watched(make_pipeline(name, car)) for name in ride.pipelines]
    count = round(min(ride.seconds, drive.lasts_s) * RATE_HZ)
    for index in range(count):
        t_s = index / RATE_HZ
        pose, body = drive.pose(t_s), ride.body(t_s)
        place = pose.x_m, pose.y_m, pose.yaw_rad
        ground = HILLS.ahead(track.road.project(place[:2])[0]) if ride.hills else None
        parts = tuple(filter(None, (other.parts(lanes, t_s) for other in others)))
        left, right = (
            eye.render(
                *place,
                pose.speed_mps,
                pose.yaw_rate_radps,
                index,
                standing=Standing(camera=camera if turned_rad else None, height_m=ground, traffic=parts),
            )
            for eye, camera in zip(eyes, rig.over(body), strict=True)
        )
        # odometry measures the distance since the frame before: its speeds are those of the middle between both
        motion = odometer.motion(drive.pose(max(t_s - 0.5 / RATE_HZ, 0.0)), round(t_s * 1e9))
        truths = [follower.step(*place) for follower in followers]
        pair = StereoFrame(t_ns=motion.t_ns, index=index, left=left, right=right)
        for one in watched:
            one.see(pair, motion, truths, body.pitch_rad)
        tick(1.0 / count)
    return [{"ride": ride.words, "pipeline": one.pipeline.name, **one.row()} for one in watched]


def measure(rides: Sequence[Ride], sweep: Sweep) -> list[Row]:
    """The paper's row, and one for each ride and pipeline."""
    rows = [{**dict.fromkeys(COLUMNS), **PAPER}]
    for _, found in spread("bench stereo-paper", measure_ride, rides, sweep):
        rows += found
    say(
        "the paper says +-0.2 m of its width, and not of what; width_sd_m is a standard deviation. Widths, pitch and"
        " reaches are of frames in which both lines are seen; monocular pipelines see the left camera's frames"
    )
    return rows
