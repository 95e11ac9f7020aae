"""A highway of several lanes, drives that change lanes, and its traffic: the road of the stereo paper's sequence.

The road is straight, bends to the left, is straight again and bends to the right, with clothoids in between. Its
curvature is that at which a car of the paper's speed turns at the paper's largest yaw rate.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from automodel.curves import Curve, OffsetCurve, SplineCurve
from automodel.geometry import SE2
from automodel.sim.hills import Hills
from automodel.sim.paint import Grain, Paint, paint_line
from automodel.sim.track import Lane, Obstacle, Track, constant, lane_between, reversed_lane
from automodel.sim.track_files import join_pieces
from automodel.sim.track_sections import ArcPiece, ClothoidPiece, LinePiece, Marking, OriginSection, Piece
from automodel.sim.trajectory import DrivenPose, pose_on

MARGIN_M = 60.0  # of the floor beside the road
EASING_M = 80.0  # of a clothoid between a straight and an arc
KNOT_M = 2.0  # between the knots of the drive's path
# A climb of 4 % and a descent; the vertical curves have a radius of 4 km, about the smallest on roads for 100 km/h.
HILLS = Hills(((30.0, 0.0), (190.0, 0.04), (230.0, 0.04), (550.0, -0.04), (590.0, -0.04), (750.0, 0.0)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Highway:
    """What a highway is like. Lengths in metres; the lines' distance is that of their middles.

    `straights_m`, `arc_m`: lengths of the two straights and of each arc; `bend_per_m`: the arcs' curvature.
    """

    lanes: int = 3
    width_m: float = 3.5
    edge_m: float = 0.15  # width of the solid lines at the edges
    dash_m: float = 6.0
    gap_m: float = 12.0
    marking_m: float = 0.15  # width of the dashes
    straights_m: tuple[float, float] = (100.0, 200.0)
    arc_m: float = 60.0
    bend_per_m: float = 1.2e-3

    def build(self) -> tuple[Track, tuple[Lane, ...]]:
        """The track, and its lanes, the rightmost first. The track's forward lane is the rightmost."""
        line = join_pieces(tuple(self._pieces()), OriginSection(), False)
        lanes = tuple(
            lane_between(OffsetCurve(line, self.width_m * (k - 0.5 * (self.lanes - 1))), constant(self.width_m))
            for k in range(self.lanes)
        )
        points = line.position(np.linspace(0.0, line.length_m, 256))
        low, high = points.min(axis=0) - MARGIN_M, points.max(axis=0) + MARGIN_M
        track = Track(
            name="highway",
            road=line,
            forward=lanes[0],
            reverse=reversed_lane(lanes[0]),
            floor=(float(low[0]), float(low[1]), float(high[0]), float(high[1])),
            start=lanes[0].pose(0.0),
            painted=tuple(self._paint(line)),
        )
        return track, lanes

    def _pieces(self) -> Iterator[Piece]:
        for side, straight_m in zip((1.0, -1.0), self.straights_m, strict=True):
            bend = side * self.bend_per_m
            yield LinePiece(length_m=straight_m)
            yield ClothoidPiece(start_per_m=0.0, end_per_m=bend, length_m=EASING_M)
            yield ArcPiece(radius_m=1.0 / self.bend_per_m, turn_rad=bend * self.arc_m)
            yield ClothoidPiece(start_per_m=bend, end_per_m=0.0, length_m=EASING_M)
        yield LinePiece(length_m=self.straights_m[0])

    def _paint(self, line: Curve) -> Iterator[Paint]:
        grain = Grain.of_lane(self.width_m)
        for k in range(self.lanes + 1):
            edge = k in (0, self.lanes)
            marking = (
                Marking(style="solid", width_m=self.edge_m)
                if edge
                else Marking(style="dashed", width_m=self.marking_m, dash_m=self.dash_m, gap_m=self.gap_m)
            )
            yield from paint_line(OffsetCurve(line, self.width_m * (k - 0.5 * self.lanes)), marking, (), grain)


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneChange:
    """A change to the next lane on the left (`to` +1) or right (-1), from `from_s` on for `lasts_s` seconds."""

    from_s: float
    lasts_s: float = 5.0
    to: int = 1


class HighwayDrive:
    """A drive at constant speed that starts in a lane, wanders about its middle and changes lanes.

    `wander_m` at `wander_hz` is about the middle of the lane; the path is that of the rear axle's centre.
    """

    def __init__(
        self,
        lane: Lane,
        speed_mps: float,
        changes: tuple[LaneChange, ...] = (),
        wander_m: float = 0.15,
        wander_hz: float = 0.1,
    ) -> None:
        self.speed_mps = speed_mps
        line = lane.centerline
        s = np.linspace(0.0, line.length_m, math.ceil(line.length_m / KNOT_M) + 1)
        t = s / speed_mps
        offset = wander_m * np.sin(math.tau * wander_hz * t)
        for change in changes:
            u = np.clip((t - change.from_s) / change.lasts_s, 0.0, 1.0)
            step = u * u * u * (10.0 + u * (6.0 * u - 15.0))  # no jump of the acceleration
            offset = offset + change.to * step * lane.width_m(s)
        self.path = SplineCurve(line.offset_position(s, offset))

    @property
    def lasts_s(self) -> float:
        """The time to the end of the road [s]."""
        return self.path.length_m / self.speed_mps

    def pose(self, t_s: float) -> DrivenPose:
        """The pose at `t_s` seconds after the start."""
        return pose_on(self.path, t_s * self.speed_mps, self.speed_mps)


@dataclass(frozen=True, slots=True, kw_only=True)
class Vehicle:
    """Another vehicle, a "car" or a "truck", in the middle of a lane (0: the rightmost) at constant speed.

    `gap_m`: from the start of the road to its rear at the start; `grey`: of its body, 0 .. 255.
    """

    kind: str
    lane: int
    gap_m: float
    speed_mps: float
    grey: int

    def parts(self, lanes: tuple[Lane, ...], t_s: float) -> tuple[Obstacle, ...]:
        """Its parts from low to high at a time; none where it is not on the road."""
        line, rear_m = lanes[self.lane].centerline, self.gap_m + self.speed_mps * t_s
        if not 0.0 <= rear_m <= line.length_m:
            return ()
        pose = lanes[self.lane].pose(rear_m)
        shapes = _TRUCK if self.kind == "truck" else _CAR
        return tuple(_part(pose, *shape[:-1], self.grey if shape[-1] is None else shape[-1]) for shape in shapes)


def traffic(speed_mps: float, seed: int) -> tuple[Vehicle, ...]:
    """What a car at this speed meets that starts in the rightmost lane and changes to the next after half the time.

    It follows a truck that it overtakes then; one car overtakes it before and is followed in the next lane, a faster
    one passes in the third lane.
    """
    rng = np.random.default_rng((seed, 11))
    more = rng.uniform(-0.15, 0.15, 3)
    greys = rng.integers(30, 240, 3).tolist()
    return (
        Vehicle(kind="truck", lane=0, gap_m=42.0 * (1.0 + more[0]), speed_mps=speed_mps - 1.5, grey=greys[0]),
        Vehicle(kind="car", lane=1, gap_m=-14.0 * (1.0 + more[1]), speed_mps=speed_mps + 2.5, grey=greys[1]),
        Vehicle(kind="car", lane=2, gap_m=-70.0 * (1.0 + more[2]), speed_mps=speed_mps + 8.0, grey=greys[2]),
    )


# Parts: from the rear to the front [m], half the width, from the ground to the top [m], and grey; None: the body's.
_Shape = tuple[float, float, float, float, float, int | None]
_CAR: tuple[_Shape, ...] = (
    (0.0, 4.5, 0.85, 0.0, 0.3, 20),  # wheels, and what is dark under it
    (0.0, 4.5, 0.9, 0.3, 0.8, None),
    (-0.03, 0.0, 0.26, 0.5, 0.61, 230),  # number plate
    (0.3, 3.2, 0.8, 0.8, 1.2, 40),  # windows
    (0.5, 2.8, 0.78, 1.2, 1.45, None),
)
_TRUCK: tuple[_Shape, ...] = (
    (0.0, 12.0, 1.2, 0.0, 0.5, 15),
    (0.0, 12.0, 1.2, 0.5, 1.1, 25),
    (-0.05, 0.0, 1.2, 0.5, 0.65, 220),  # bumper
    (0.0, 12.0, 1.25, 1.1, 3.8, None),
)


def _part(pose: SE2, rear_m: float, front_m: float, half_m: float, low_m: float, top_m: float, grey: int) -> Obstacle:
    corners = np.array(((rear_m, -half_m), (front_m, -half_m), (front_m, half_m), (rear_m, half_m)))
    return Obstacle(polygon_m=pose.apply(corners), height_m=top_m - low_m, grey=grey, base_m=low_m)
