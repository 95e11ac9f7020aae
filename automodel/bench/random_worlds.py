"""`bench accuracy --world random`: pipelines in worlds that nobody has seen before, one a seed.

A pipeline is told what the world's car.toml says, which is often wrong; the camera is the true one. All pipelines get
the same frames. Errors are against the lane that the car drives in; in an intersection the lane goes on along the car's
own road. Availability counts the frames in which a marking of the lane is in view (`LaneSight`), from `START_S` on.
"""

from __future__ import annotations

import collections
import dataclasses
import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from automodel.assembly.parts import make_pipeline
from automodel.assembly.simulated_car import renderer
from automodel.bench.accuracy import AccuracyMeter, Row
from automodel.bench.centerline_paper import full_scale_car
from automodel.config import PIPELINE_NAMES, CarConfig, ConfigError
from automodel.console.workers import Sweep, Tick, spread
from automodel.geometry import SE2, GroundCamera
from automodel.output_files import output_path
from automodel.signals import Frame, LaneEstimate, Motion, MotionSource
from automodel.sim.random_worlds import RandomWorld, kind_of, random_world
from automodel.sim.trajectory import DrivenPose, Odometer
from automodel.sim.truth import Truth, TruthFollower
from automodel.types import Bools, FloatArray
from automodel.viewer import overlay

RATE_HZ = 30.0  # frames a second: that of common cameras
FRAMES = 300  # a world, ten seconds
START_S = 0.5  # availability does not count before: a pipeline knows nothing yet
COLUMNS = (
    "pipeline", "seed", "misled_pct", "bound_exceeded_pct", "availability_pct", "false_lane_pct", "world",
    "phantom_pct", "estimate_pct", "bound_median_m", "offset_mae_pct", "heading_mae_deg", "frames",
)  # fmt: skip
TRUTH: overlay.Colour = (255, 200, 0)  # the true lane's lines in a worst frame


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldChoice:
    """Which worlds, how many frames of each, and where the worst frames are drawn (None: nowhere).

    `kinds` are those that the seeds take in turn; empty: each seed's own.
    """

    pipelines: tuple[str, ...] = ()
    seeds: range = range(1)
    kinds: tuple[str, ...] = ()
    frames: int = FRAMES
    worst: Path | None = None

    def cases(self) -> list[tuple[int, str]]:
        """Seed and kind of each world."""
        return [(seed, self.kinds[seed % len(self.kinds)] if self.kinds else kind_of(seed)) for seed in self.seeds]


class LaneSight:
    """Whether a camera sees a marking of a lane.

    It does where at least `LEAST` lane widths of painted line lie in the image, counted where the marking is
    `LEAST_PX` wide or wider and haze leaves `LEAST_CONTRAST` of its contrast.
    """

    STEP = 0.05  # lane widths between two places that are looked at
    AHEAD = 6.0  # lane widths, at most
    LEAST = 0.3
    LEAST_PX = 1.5
    LEAST_CONTRAST = 0.25

    def __init__(self, world: RandomWorld) -> None:
        self._world, self._line = world, world.lane.centerline
        width_m = world.car.lane.width_m
        self._count = math.ceil(self._line.length_m / (self.STEP * width_m))
        s = np.arange(self._count) * (self._line.length_m / self._count)
        sides = 0.5 * world.lane.width_m(s)
        self._points = [self._line.offset_position(s, side) for side in (sides, -sides)]
        polygons = [p.polygon_m for p in world.track.painted if p.kind in ("line", "dash")]
        self._painted = [_inside_any(points, polygons) for points in self._points]
        focal_px = world.car.camera.intrinsics.fx_px
        reach_m = min(self.AHEAD * width_m, focal_px * world.car.lane.marking_width_m / self.LEAST_PX)
        if world.look.haze:
            unit_m = world.car.camera.extrinsics.z_m / 0.18
            reach_m = min(reach_m, -math.log(self.LEAST_CONTRAST) / world.look.haze * unit_m)
        self._reach_m = reach_m
        self._window = np.arange(-round(1.0 / self.STEP), round(self.AHEAD / self.STEP))

    def sees(self, camera: GroundCamera, pose: DrivenPose, s_m: float) -> bool:
        """Whether a marking is in view of the camera, whose reference point is at arc length `s_m`."""
        first = round(s_m / self._line.length_m * self._count)
        at = (first + self._window) % self._count
        body = SE2(pose.x_m, pose.y_m, pose.yaw_rad).inverse()
        seen = 0
        for points, painted in zip(self._points, self._painted, strict=True):
            near = body.apply(points[at[painted[at]]])
            near = near[np.hypot(*(near - camera.centre_m[:2]).T) < self._reach_m]
            seen += int(camera.camera.inside(camera.ground_to_px(near)).sum()) if len(near) else 0
        return seen * self.STEP >= self.LEAST


def _inside_any(points: FloatArray, polygons: Sequence[FloatArray]) -> Bools:
    """Which points (n, 2) lie in any of the polygons."""
    inside = np.zeros(len(points), np.bool_)
    for polygon in polygons:
        low, high = polygon.min(axis=0), polygon.max(axis=0)
        near = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1) & ~inside)
        if not len(near):
            continue
        a, b = polygon, np.roll(polygon, -1, axis=0)
        x, y = points[near, 0][:, None], points[near, 1][:, None]
        spans = (a[:, 1] > y) != (b[:, 1] > y)
        slope = (b[:, 0] - a[:, 0]) / np.where(b[:, 1] == a[:, 1], 1.0, b[:, 1] - a[:, 1])
        left = x < a[:, 0] + (y - a[:, 1]) * slope
        inside[near] = (spans & left).sum(axis=1) % 2 == 1
    return inside


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """A frame as a pipeline gets it, and what is true in it; `visible`: a marking of the lane is in view."""

    frame: Frame
    motion: Motion
    truth: Truth
    visible: bool
    pose: DrivenPose
    camera: GroundCamera  # the true one, with its nod


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shot:
    """One frame and what a pipeline made of it."""

    view: View
    estimate: LaneEstimate

    def badness(self, marked: bool) -> float:
        """How wrong it is: the error beyond the bound in lane widths; where no bound is stated, the error."""
        pose = self.estimate.pose
        if pose is None:
            return -2.0
        if not marked:
            return max(0.5 - pose.offset_bound_m / self.view.truth.width_m, -1.0)
        error = abs(pose.offset_m - self.view.truth.offset_m)
        bound = pose.offset_bound_m if math.isfinite(pose.offset_bound_m) else 0.0
        return (error - bound) / self.view.truth.width_m


@dataclass(slots=True, eq=False)
class Seer:
    """A pipeline in one world: its metrics, and its worst frame."""

    name: str
    meter: AccuracyMeter
    worst: Shot | None = None

    def add(self, t_s: float, shot: Shot, marked: bool, visible: bool) -> None:
        """Add one frame."""
        self.meter.add(t_s, shot.estimate, shot.view.truth, visible=visible, marked=marked)
        if self.worst is None or shot.badness(marked) > self.worst.badness(marked):
            self.worst = shot


def true_camera(world: RandomWorld, nod_rad: float) -> GroundCamera:
    """The camera at a moment; the nod is taken for a change of pitch_rad, which it is where yaw and roll are small."""
    place = world.car.camera.extrinsics
    pitched = dataclasses.replace(place, pitch_rad=place.pitch_rad + nod_rad)
    return GroundCamera.from_config(dataclasses.replace(world.car.camera, extrinsics=pitched))


def build_world(car: CarConfig, seed: int, kind: str) -> RandomWorld:
    """The world with the car of a scale, at `RATE_HZ`."""
    car = full_scale_car(car.pipeline) if kind == "circuit" else car
    return random_world(seed, kind, dataclasses.replace(car, camera=dataclasses.replace(car.camera, rate_hz=RATE_HZ)))


def views(world: RandomWorld, frames: int) -> Iterator[View]:
    """What the car sees in its first frames."""
    nod_max_rad = 0.0 if world.nod is None else world.nod.amplitude_rad
    eye = renderer(world.track, world.car, world.look, nod_max_rad)
    follower, sight = TruthFollower(world.lane, world.car.vehicle.reference_x_m, world.start_s_m), LaneSight(world)
    odometer = Odometer(world.seed)
    t_s = np.arange(frames) / RATE_HZ
    # odometry measures the distance since the frame before: its speeds are those of the middle between both
    poses, between = world.poses(t_s), world.poses(np.maximum(t_s - 0.5 / RATE_HZ, 0.0))
    for index, (t, pose) in enumerate(zip(t_s.tolist(), poses, strict=True)):
        nod_rad = world.nod_rad(t)
        image = eye.render(pose.x_m, pose.y_m, pose.yaw_rad, pose.speed_mps, pose.yaw_rate_radps, index, nod_rad)
        frame = Frame(t_ns=round(t * 1e9), index=index, image=image)
        motion = odometer.motion(between[index], frame.t_ns)
        if not world.odometry:
            motion = Motion(t_ns=frame.t_ns, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)
        truth = follower.step(pose.x_m, pose.y_m, pose.yaw_rad)
        camera = true_camera(world, nod_rad)
        visible = t >= START_S and world.marked and sight.sees(camera, pose, truth.s_m)
        yield View(frame=frame, motion=motion, truth=truth, visible=visible, pose=pose, camera=camera)


def measure_world(
    car: CarConfig, names: Sequence[str], choice: WorldChoice, case: tuple[int, str], tick: Tick
) -> list[tuple[Row, AccuracyMeter]]:
    """A row and its frames for each pipeline."""
    world = build_world(car, *case)
    seers = [Seer(name, AccuracyMeter()) for name in names]
    pipelines = [make_pipeline(name, world.believed) for name in names]
    for view in views(world, choice.frames):
        for seer, pipeline in zip(seers, pipelines, strict=True):
            estimate = pipeline.step(view.frame, view.motion)
            shot = Shot(view=view, estimate=estimate)
            seer.add(1e-9 * view.frame.t_ns, shot, world.marked, view.visible)
        tick(1.0 / choice.frames)
    if choice.worst is not None:
        for seer in seers:
            save_worst(choice.worst / f"{seer.name}-{world.seed:04d}.png", world, seer)
    return [(row_of(seer.name, world.seed, world.words, seer.meter), seer.meter) for seer in seers]


def row_of(pipeline: str, seed: int | None, words: str, meter: AccuracyMeter) -> Row:
    """A row of the table; `phantom_pct` is None on a road with markings.

    `estimate_pct` is the share of all frames with an estimate, markings in view or not.
    """
    unmarked, known = ~np.array(meter.marked, np.bool_), np.isfinite(np.array(meter.estimated).reshape(-1, 2)[:, 0])
    phantom = 100.0 * float(meter.phantoms()[unmarked].mean()) if unmarked.any() else None
    claimed = 100.0 * float(known.mean()) if len(known) else 0.0
    row: Row = {"pipeline": pipeline, "seed": seed, "world": words}
    return row | meter.row() | {"phantom_pct": phantom, "estimate_pct": claimed}


def save_worst(path: Path, world: RandomWorld, seer: Seer) -> None:
    """Draw the estimate of the worst frame and, as blue dots, the true lane; raises ConfigError."""
    shot = seer.worst
    if shot is None:
        return
    view = shot.view
    believed = world.believed
    pose, seen = shot.estimate.pose, GroundCamera.from_config(believed.camera)
    note = f"seed {world.seed} {shot.estimate.t_ns * 1e-9:.1f} s true {100 * view.truth.offset_m:+.1f} cm"
    if pose is not None:
        note += f" bound {100 * pose.offset_bound_m:.1f} cm"
    image, reference_x_m = view.frame.image, believed.vehicle.reference_x_m
    canvas = overlay.draw(image, shot.estimate, seen, reference_x_m=reference_x_m, note=note)
    scale = overlay.scale_of(image.shape[1])
    width_m = view.truth.width_m
    s = view.truth.s_m + np.arange(-1.0, 8.0, 0.1) * width_m
    body = SE2(view.pose.x_m, view.pose.y_m, view.pose.yaw_rad).inverse()
    for side in (0.5, -0.5):
        on_line = world.lane.centerline.offset_position(s, side * world.lane.width_m(s))
        pixels = view.camera.ground_to_px(body.apply(on_line))
        for u, v in pixels[view.camera.camera.inside(pixels)]:
            cv2.circle(canvas, (round((u + 0.5) * scale), round((v + 0.5) * scale)), 2, TRUTH, -1, cv2.LINE_AA)
    with output_path(path) as part:
        if not cv2.imwrite(str(part), canvas):
            raise ConfigError(f"{path}: cannot be written as an image")


def measure(car: CarConfig, choice: WorldChoice, sweep: Sweep, plot: Path | None) -> list[Row]:
    """A row for each pipeline and world, then for each pipeline those of each kind and all; `plot` gets a PNG.

    Of `car` the camera counts in scale worlds, the pipeline's settings in all. Raises ConfigError.
    """
    names = tuple(dict.fromkeys(choice.pipelines or PIPELINE_NAMES))
    for name in names:
        make_pipeline(name, car)  # raises for what it cannot work with before any work
    if choice.worst is not None:
        make_folder(choice.worst)
    cases = choice.cases()
    work = functools.partial(measure_world, car, names, choice)
    rows: dict[str, list[Row]] = {name: [] for name in names}
    meters: dict[tuple[str, str], AccuracyMeter] = {}
    for (_, kind), found in spread("bench accuracy", work, cases, sweep):
        for name, (row, meter) in zip(names, found, strict=True):
            rows[name].append(row)
            meters.setdefault((name, kind), AccuracyMeter()).include(meter)
    counts = collections.Counter(kind for _, kind in cases)
    whole: dict[str, AccuracyMeter] = {}
    for (name, kind), meter in meters.items():
        whole.setdefault(name, AccuracyMeter()).include(meter)
        if len(counts) > 1:
            rows[name].append(row_of(name, None, f"all {counts[kind]} {kind}", meter))
    table = [row for name in names for row in rows[name]]
    if len(cases) > 1:
        table += [row_of(name, None, f"all {len(cases)}", meter) for name, meter in whole.items()]
    if plot is not None:
        from automodel.viewer.plots import plot_reliability

        plot_reliability(plot, [(name, *_claims(meter)) for name, meter in whole.items()])
    return table


def make_folder(path: Path) -> None:
    """Make the folder where there is none; raises ConfigError."""
    try:
        path.mkdir(exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be made a folder: {error.strerror}") from None


def _claims(meter: AccuracyMeter) -> tuple[list[str], FloatArray, FloatArray]:
    """Status (n), bounds (n, 2) and errors (n, 2) of offset [lane widths] and heading [rad] where both are known."""
    errors, bounds = np.stack(meter.errors(), axis=-1), np.array(meter.bounds).reshape(-1, 2)
    known = np.isfinite(errors[:, 0]) & np.array(meter.marked, np.bool_)
    units = np.array(meter.true).reshape(-1, 3)[known][:, [2, 2]] * [1.0, 0.0] + [0.0, 1.0]  # [m], [rad]
    return [meter.statuses[k].value for k in np.flatnonzero(known)], bounds[known] / units, errors[known] / units
