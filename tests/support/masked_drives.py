"""Drives whose line mask is known: the renderer's own, so that nothing but geometry and estimation can be wrong."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from automodel.config import CarConfig, LaneConfig
from automodel.geometry import SE2
from automodel.interfaces import Pipeline
from automodel.pipelines.centerline import Centerline
from automodel.signals import Frame, LaneEstimate, LaneStatus, Motion, MotionSource
from automodel.sim.renderer import Renderer
from automodel.sim.track import Lane, Track
from automodel.sim.track_files import parse_track
from automodel.sim.truth import TruthFollower
from automodel.types import Image
from tests.support.rendered_drives import CAR, Seen, check_sound, renderer

PERIOD_NS = 33_333_333


def line(length_m: float) -> str:
    return f'[[pieces]]\nkind = "line"\nlength_m = {length_m}\n'


def arc(radius_m: float, turn_rad: float) -> str:
    return f'[[pieces]]\nkind = "arc"\nradius_m = {radius_m}\nturn_rad = {turn_rad}\n'


def clothoid(start_per_m: float, end_per_m: float, length_m: float) -> str:
    numbers = f"start_per_m = {start_per_m}\nend_per_m = {end_per_m}\nlength_m = {length_m}\n"
    return f'[[pieces]]\nkind = "clothoid"\n{numbers}'


def gap(from_m: float, to_m: float, *lines: str) -> str:
    named = ", ".join(f'"{name}"' for name in lines)
    return f"[[gaps]]\nfrom_m = {from_m}\nto_m = {to_m}\nlines = [{named}]\n"


def road(
    *parts: str, width_m: float = 0.4, marking_m: float = 0.03, widths: Sequence[tuple[float, float]] = ()
) -> Track:
    """An open road of one lane from the world's origin along x, of `parts` (pieces, gaps); all lines are solid.

    `widths` are (place, width) [m] where the width changes.
    """
    floor = "[floor]\nx0_m = -900.0\ny0_m = -900.0\nx1_m = 900.0\ny1_m = 900.0\n"
    lanes = f"[lanes]\ncount = 1\nwidth_m = {width_m}\n"
    lines = "".join(f'[markings.{side}]\nstyle = "solid"\nwidth_m = {marking_m}\n' for side in ("left", "right"))
    places = "".join(f"[[widths]]\ns_m = {s}\nwidth_m = {width}\n" for s, width in widths)
    start = '[start]\ndirection = "forward"\ns_m = 0.0\n'
    text = f'name = "road"\nclosed = false\n{floor}{lanes}{lines}{start}{places}{"".join(parts)}'
    return parse_track(text, "road.toml")


class Oracle:
    """Markings that are known: what the renderer sees of them from `pose`, as `change` leaves it."""

    def __init__(self, eye: Renderer) -> None:
        self.eye, self.pose = eye, SE2()
        self.change: Callable[[Image], Image] = lambda mask: mask

    def step(self, grey: Image) -> Image:
        return self.change(self.eye.render_mask(self.pose.x_m, self.pose.y_m, self.pose.yaw_rad))


class GivenMarkings:
    """Markings that are reported frame by frame."""

    def __init__(self, size: tuple[int, int] = (CAR.camera.height_px, CAR.camera.width_px)) -> None:
        self.mask: Image = np.zeros(size, np.uint8)

    def step(self, grey: Image) -> Image:
        return self.mask


def sine(amplitude: float, wave_lanes: float) -> Callable[[float], float]:
    """An offset [lane widths] over the distance [lane widths]: a sine."""
    return lambda s: amplitude * math.sin(math.tau * s / wave_lanes)


@dataclass(kw_only=True)
class MaskedDrive:
    """A car whose rear axle goes beside a lane's centerline, and `centerline` on the mask that its camera would give.

    `offset` [lane widths] is a function of the distance [lane widths]. The reported speed is the true one times
    `speed_factor`, the yaw rate is wrong by `yaw_bias_radps`.
    """

    track: Track
    car: CarConfig = CAR
    direction: str = "forward"
    rate_hz: float = 30.0
    speed_mps: float = 1.0
    offset: Callable[[float], float] = field(default_factory=lambda: sine(0.08, 4.0 * math.pi))
    source: MotionSource = MotionSource.MEASURED
    speed_factor: float = 1.0
    yaw_bias_radps: float = 0.0

    def __post_init__(self) -> None:
        self.lane: Lane = self.track.lane(self.direction)
        self.oracle = Oracle(renderer(self.track, self.car))
        self.pipeline: Pipeline = Centerline(self.car, self.oracle)
        self.follower = TruthFollower(self.lane, self.car.vehicle.reference_x_m)
        size = (self.car.camera.height_px, self.car.camera.width_px)
        self._blank: Image = np.zeros((*size, 3) if self.car.camera.colour else size, np.uint8)

    def pose(self, s_m: float) -> SE2:
        """World pose of the body, its rear axle at arc length `s_m` of the centerline; it looks where it goes."""
        before, here, after = (self._place(s_m + h) for h in (-1e-4, 0.0, 1e-4))
        return SE2(here[0], here[1], math.atan2(after[1] - before[1], after[0] - before[0]))

    def _place(self, s_m: float) -> tuple[float, float]:
        unit = self.car.lane.width_m
        x, y = self.lane.centerline.offset_position(s_m, unit * self.offset(s_m / unit))
        return float(x), float(y)

    def frames(self, from_m: float, to_m: float, t0_ns: int = 0) -> Iterator[tuple[Frame, Motion, SE2]]:
        """The frames, motions and poses of a stretch; the image itself is blank."""
        period_s = 1.0 / self.rate_hz
        known = self.source is not MotionSource.NONE
        for index in range(round((to_m - from_m) / (self.speed_mps * period_s))):
            s_m = from_m + index * period_s * self.speed_mps
            pose, before = self.pose(s_m), self.pose(s_m - period_s * self.speed_mps)
            turn = math.remainder(pose.yaw_rad - before.yaw_rad, math.tau)
            distance = math.hypot(pose.x_m - before.x_m, pose.y_m - before.y_m) / float(np.sinc(turn / math.tau))
            t_ns = t0_ns + round(index * period_s * 1e9)
            motion = Motion(
                t_ns=t_ns,
                speed_mps=self.speed_factor * distance / period_s if known else 0.0,
                yaw_rate_radps=turn / period_s + self.yaw_bias_radps if known else 0.0,
                source=self.source,
            )
            yield Frame(t_ns=t_ns, index=index, image=self._blank), motion, pose

    def run(self, from_m: float, to_m: float, t0_ns: int = 0) -> list[Seen]:
        """What the pipeline says on a stretch; every estimate is checked to be sound."""
        seen = []
        for frame, motion, pose in self.frames(from_m, to_m, t0_ns):
            self.oracle.pose = pose
            estimate = self.pipeline.step(frame, motion)
            check_sound(estimate, frame.t_ns)
            truth = self.follower.step(pose.x_m, pose.y_m, pose.yaw_rad)
            seen.append(Seen(frame=frame, motion=motion, estimate=estimate, truth=truth))
        return seen


def scaled(car: CarConfig, lane_m: float, camera_z_m: float, marking_m: float) -> CarConfig:
    """A full-size car with the same camera in a lane of `lane_m`."""
    extrinsics = replace(car.camera.extrinsics, x_m=1.5, z_m=camera_z_m)
    return replace(
        car,
        camera=replace(car.camera, extrinsics=extrinsics),
        lane=LaneConfig(width_m=lane_m, marking_width_m=marking_m),
        vehicle=replace(car.vehicle, wheelbase_m=2.7, reference_x_m=1.35, width_m=1.8),
    )


@dataclass(frozen=True, kw_only=True)
class Errors:
    """Of a drive: mean and largest errors of offset [m] and heading [deg], and how many frames had what status."""

    offset_mean_m: float
    offset_max_m: float
    heading_mean_deg: float
    heading_max_deg: float
    statuses: dict[LaneStatus, int]

    @property
    def available(self) -> float:
        """Share of frames with an estimate."""
        return 1.0 - self.statuses.get(LaneStatus.LOST, 0) / sum(self.statuses.values())


def errors(seen: Sequence[Seen], skip: int = 0) -> Errors:
    """The errors from frame `skip` on, of the frames that have an estimate."""
    counted = seen[skip:]
    reported = [one for one in counted if one.estimate.valid]
    assert reported, "no estimate at all"
    offset = np.abs([one.offset_error_m for one in reported])
    heading = np.degrees(np.abs([one.heading_error_rad for one in reported]))
    every = [one.estimate.status for one in counted]
    return Errors(
        offset_mean_m=float(offset.mean()),
        offset_max_m=float(offset.max()),
        heading_mean_deg=float(heading.mean()),
        heading_max_deg=float(heading.max()),
        statuses={status: every.count(status) for status in LaneStatus if status in every},
    )


def bits(estimate: LaneEstimate) -> tuple[object, ...]:
    """Everything that an estimate says, to be compared for equality."""
    numbers: list[bytes] = []
    if estimate.pose is not None and estimate.left is not None and estimate.right is not None:
        pose = estimate.pose
        assert estimate.centerline is not None
        fields = (pose.offset_m, pose.heading_rad, pose.width_m, pose.curvature_per_m)
        numbers = [np.array(fields).tobytes(), pose.covariance.tobytes()]
        numbers += [estimate.left.points_m.tobytes(), estimate.right.points_m.tobytes()]
        for curve in (estimate.centerline, estimate.left.curve, estimate.right.curve):
            numbers.append(curve.position(np.linspace(0.0, curve.length_m, 7)).tobytes())
    return (estimate.t_ns, estimate.status, estimate.frame_age_ns, estimate.crossing, *numbers)
