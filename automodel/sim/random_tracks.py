"""The tracks of random worlds: a random road with its markings, crossings, traps, changes of width, boxes and litter.

They are put together from the sections of a track file.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from automodel.sim.paint import Paint
from automodel.sim.random_draws import Draws, WorldRanges
from automodel.sim.random_roads import RandomRoad, RoadRanges, random_road
from automodel.sim.street import ground_lines, street
from automodel.sim.track import Track
from automodel.sim.track_files import build_track
from automodel.sim.track_sections import (
    Box,
    BrokenLines,
    CrossingsSection,
    FloorSection,
    Gap,
    LanesSection,
    Marking,
    MarkingsSection,
    RoadsideSection,
    StopLine,
    TrackFile,
    WidthAt,
    ZebraPattern,
)

SCALE_ROADS = RoadRanges()
CIRCUIT_ROADS = RoadRanges(size=(14.0, 26.0), radius=(1.8, 8.0), eased=0.9)  # bends of 18 to 80 m


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene:
    """What is known of a world before its paint."""

    seed: int
    kind: str
    style: str
    road: RandomRoad
    width_m: float
    lanes: int

    @property
    def half_m(self) -> float:
        """From the reference line to the road's edge."""
        return 0.5 * self.lanes * self.width_m


def marking_width(kind: str, width_m: float, draws: Draws) -> float:
    """The common width [m] of the markings in a lane of `width_m`."""
    return width_m * draws.log_within("circuit_marking" if kind == "circuit" else "marking")


def random_track(seed: int, kind: str, style: str, width_m: float, draws: Draws) -> tuple[Track, bool]:
    """The track with lanes of `width_m`, and whether the own lane's lines are missing behind a crossing.

    Raises RuntimeError where no road is found.
    """
    lanes = 1 if kind in ("widths", "circuit") or not (kind == "unmarked" or draws.happens("two_lanes")) else 2
    loops = int(draws.rng("loops").integers(1, 4)) if kind in ("crossing", "start") else 0
    rng = draws.rng("road")
    for _ in range(50):  # an edge of a road of changing width may fold in a tight bend
        road = random_road(rng, width_m, lanes, loops, CIRCUIT_ROADS if kind == "circuit" else SCALE_ROADS)
        scene = Scene(seed=seed, kind=kind, style=style, road=road, width_m=width_m, lanes=lanes)
        sections, trap = _sections(scene, draws)
        try:
            track = build_track(sections, road.line)
        except ValueError:
            continue
        return dataclasses.replace(track, roadside=track.roadside + _lines(scene, track, draws)), trap
    raise RuntimeError(f"world {seed}: no road found")


def _sections(scene: Scene, draws: Draws) -> tuple[TrackFile, bool]:
    """The track file of the road, and whether it has a trap."""
    width_m, line, circuit = scene.width_m, scene.road.line, scene.kind == "circuit"
    traps = _traps(scene, draws) if scene.road.crossings and draws.happens("trap") else []
    gaps = _gaps(scene, draws) if scene.kind in ("plain", "crossing", "start") and draws.happens("gappy") else []
    points = line.position(np.linspace(0.0, line.length_m, 400))
    beyond = scene.half_m + width_m * draws.within("margin")
    (x0_m, y0_m), (x1_m, y1_m) = points.min(axis=0) - beyond, points.max(axis=0) + beyond
    sections = TrackFile(
        name=f"world {scene.seed}",
        closed=True,
        floor=FloorSection(x0_m=float(x0_m), y0_m=float(y0_m), x1_m=float(x1_m), y1_m=float(y1_m)),
        origin=scene.road.origin,
        lanes=LanesSection(count=scene.lanes, width_m=width_m),
        markings=_markings(scene, draws),
        crossings=CrossingsSection(interrupt_lines=not draws.happens("through_lines"), zebra=_zebra(scene, draws)),
        broken=BrokenLines(seed=scene.seed) if circuit else None,
        roadside=RoadsideSection(kerb_radius_m=60.0) if circuit else None,
        widths=_widths(scene, draws) if scene.kind in ("widths", "circuit") else (),
        stop_lines=_stop_lines(scene, draws) if draws.happens("stop_line") else (),
        gaps=(*traps, *gaps),
        obstacles=_boxes(scene, draws) if not circuit and draws.happens("boxes") else (),
    )
    return sections, bool(traps)


def _markings(scene: Scene, draws: Draws) -> MarkingsSection:
    if scene.kind == "unmarked":
        none = Marking(style="none")
        return MarkingsSection(left=none, centre=none, right=none)
    common_m = marking_width(scene.kind, scene.width_m, draws)
    rng, ranges = draws.rng("markings"), WorldRanges()
    uneven = draws.happens("uneven")
    low_m, high_m = (edge * scene.width_m for edge in ranges.marking)
    colours = scene.style in ("competition", "varied", "road") and draws.happens("yellow")
    dash_m = scene.width_m * draws.within("dash")
    gap_m = dash_m * draws.within("dash_gap")
    made = {}
    for name in ("left", "centre", "right"):
        share, style, colour = rng.uniform(*ranges.unevenness), rng.random(), rng.random()
        edge = ranges.dashed_start if scene.kind == "start" else ranges.dashed_edge
        dashed = style > ranges.solid_centre if name == "centre" else style < edge
        plain = scene.kind in ("widths", "circuit")
        made[name] = Marking(
            style="none" if name == "centre" and scene.lanes == 1 else "dashed" if dashed and not plain else "solid",
            width_m=float(np.clip(common_m * share, low_m, high_m)) if uneven and not plain else common_m,
            dash_m=dash_m,
            gap_m=gap_m,
            colour="yellow" if colours and colour < 0.5 else "white",
        )
    return MarkingsSection(**made)


def _zebra(scene: Scene, draws: Draws) -> ZebraPattern | None:
    if not scene.road.crossings or not draws.happens("zebra"):
        return None
    bar_m = scene.width_m * draws.within("zebra_bar")
    length_m = scene.width_m * draws.within("zebra_length")
    return ZebraPattern(bar_width_m=bar_m, bar_gap_m=bar_m, length_m=length_m, distance_m=0.12 * scene.width_m)


def _arm_m(scene: Scene, angle_rad: float) -> float:
    """From the middle of a crossing to where the lines begin again."""
    return scene.half_m * (1.0 + abs(math.cos(angle_rad))) / math.sin(angle_rad)


def _traps(scene: Scene, draws: Draws) -> list[Gap]:
    """Own lines missing behind crossings, in both directions of travel."""
    rng, length_m = draws.rng("traps"), scene.road.line.length_m
    own = (("right",), ("centre",), ("right", "centre")) if scene.lanes == 2 else (("left",), ("right",))
    gaps = []
    for crossing in scene.road.crossings:
        arm_m = _arm_m(scene, crossing.angle_rad)
        for place in (crossing.s_first_m, crossing.s_second_m):
            for side in (1.0, -1.0):
                lines = own[int(rng.integers(len(own)))]
                size_m = scene.width_m * float(rng.uniform(*WorldRanges().trap_length))
                near, far = sorted((place + side * arm_m, place + side * (arm_m + size_m)))
                if near >= 0.0 and far <= length_m:
                    gaps.append(Gap(from_m=near, to_m=far, lines=lines))
    return gaps


def _gaps(scene: Scene, draws: Draws) -> list[Gap]:
    rng, length_m = draws.rng("gaps"), scene.road.line.length_m
    names = ("left", "centre", "right") if scene.lanes == 2 else ("left", "right")
    gaps = []
    for _ in range(int(rng.integers(2, 9))):
        from_m, name = float(rng.uniform(0.0, length_m)), names[int(rng.integers(len(names)))]
        size_m = scene.width_m * float(rng.uniform(*WorldRanges().gap_length))
        gaps.append(Gap(from_m=from_m, to_m=from_m + size_m, lines=(name,)))
    return gaps


def _stop_lines(scene: Scene, draws: Draws) -> tuple[StopLine, ...]:
    """Before each crossing, on the right of the road and on the side from which the lane is driven."""
    side = 1.0 if draws.happens("mirrored") else -1.0
    stops = []
    for crossing in scene.road.crossings:
        reach_m = _arm_m(scene, crossing.angle_rad) + 1.1 * scene.width_m
        for place in (crossing.s_first_m, crossing.s_second_m):
            s_m = (place + side * reach_m) % scene.road.line.length_m
            stops.append(StopLine(s_m=s_m, width_m=0.1 * scene.width_m))
    return tuple(stops)


def _widths(scene: Scene, draws: Draws) -> tuple[WidthAt, ...]:
    """Sections of another width, in which the width changes smoothly."""
    rng, ranges, length_m = draws.rng("widths"), WorldRanges(), scene.road.line.length_m
    places, s_m = [], scene.width_m * float(rng.uniform(0.5, 4.0))
    while True:
        change = float(rng.choice((-1.0, 1.0)) * rng.uniform(*ranges.width_change))
        tapers = scene.width_m * rng.uniform(*ranges.width_taper, 2)
        held_m, between_m = scene.width_m * rng.uniform(*ranges.width_held, 2)
        if s_m + tapers.sum() + held_m > length_m - 0.1 * scene.width_m:
            break
        steps = ((s_m, 0.0), (s_m + tapers[0], change), (s_m + tapers[0] + held_m, change))
        end_m = float(s_m + tapers.sum() + held_m)
        for at_m, share in (*steps, (end_m, 0.0)):
            places.append(WidthAt(s_m=float(at_m), width_m=scene.width_m * (1.0 + share)))
        s_m = end_m + float(between_m)
    return tuple(places) or (WidthAt(s_m=0.0, width_m=scene.width_m),)


def _boxes(scene: Scene, draws: Draws) -> tuple[Box, ...]:
    """Boxes beside the road, in no pass of it."""
    rng, line = draws.rng("boxes"), scene.road.line
    points = line.position(np.linspace(0.0, line.length_m, 800))
    boxes = []
    for _ in range(int(rng.integers(1, 7))):
        s_m, side = rng.uniform(0.0, line.length_m), rng.choice((-1.0, 1.0))
        size = scene.width_m * rng.uniform((0.2, 0.2, 0.1), (1.0, 0.6, 0.8))
        reach_m = 0.5 * float(np.hypot(size[0], size[1]))
        place = line.offset_position(s_m, side * (scene.half_m + reach_m + scene.width_m * rng.uniform(0.1, 1.5)))
        turn, grey = rng.uniform(0.0, math.tau), int(rng.integers(20, 230))
        if np.hypot(*(points - place).T).min() > scene.half_m + reach_m + 0.08 * scene.width_m:
            boxes.append(
                Box(
                    x_m=float(place[0]),
                    y_m=float(place[1]),
                    heading_rad=float(turn),
                    length_m=float(size[0]),
                    width_m=float(size[1]),
                    height_m=float(size[2]),
                    grey=grey,
                )
            )
    return tuple(boxes)


def _lines(scene: Scene, track: Track, draws: Draws) -> tuple[Paint, ...]:
    """Line-like things on the ground that are no markings."""
    rng = draws.rng("street")
    if scene.kind == "unmarked":
        return street(track.road, scene.width_m, rng)
    if scene.kind == "circuit" or not draws.happens("litter"):
        return ()
    return ground_lines(track.road, scene.half_m, scene.width_m, rng, rails=scene.style == "road")
