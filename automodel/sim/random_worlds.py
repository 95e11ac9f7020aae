"""Random worlds: a road, its look, a drive on it and a car.toml that is wrong, all from one seed.

No world is like another, so that nothing can be tuned to one. Each value is drawn from a seed of its own (the world's
seed and the value's name): a new value leaves the others as they are.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from automodel.config import CarConfig
from automodel.sim.appearance import Appearance, key_of
from automodel.sim.paint import Paint
from automodel.sim.random_roads import RandomRoad, RoadRanges, random_road
from automodel.sim.street import ground_lines, street
from automodel.sim.track import Lane, Track, reversed_lane
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
from automodel.sim.trajectory import CircuitDrive, Drive, DrivenPose
from automodel.types import FloatArray

# of twenty seeds in a row, the worlds of each kind; "start" begins at a standstill inside a crossing
KINDS = {"plain": 4, "crossing": 6, "start": 1, "widths": 3, "circuit": 4, "unmarked": 2}
LOOKS = {  # by kind: the styles of `Appearance.random`, each with its weight
    "scale": {"competition": 4, "varied": 6, "road": 2, "taped": 3, "faint": 2, "noisy": 2, "reflections": 2},
    "circuit": {"dry": 1, "wet": 1, "hazy": 1},
    "unmarked": {"road": 3, "dry": 1, "hazy": 1},
}
SCALE_ROADS = RoadRanges()
CIRCUIT_ROADS = RoadRanges(size=(14.0, 26.0), radius=(1.8, 8.0), eased=0.9)  # bends of 18 to 80 m


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldRanges:
    """What a world is drawn from: uniformly between (low, high), or how often something happens (one number)."""

    # the road; lengths in lane widths
    lane_width: tuple[float, float] = (0.85, 1.15)  # of the car's [lane] width_m
    circuit_width: tuple[float, float] = (0.9, 1.2)  # the same for a circuit: 9 to 12 m
    two_lanes: float = 0.7  # of plain and crossing roads
    marking: tuple[float, float] = (0.015, 0.08)  # width of the tape, logarithmically; the Carolo-Cup has 0.05
    circuit_marking: tuple[float, float] = (0.01, 0.025)  # 0.1 to 0.3 m
    uneven: float = 0.3  # how often the lines of one road differ in width
    unevenness: tuple[float, float] = (0.7, 1.4)  # then, each line's share of the common width
    dash: tuple[float, float] = (0.3, 1.2)  # length of a dash; 0.5 in the Carolo-Cup
    dash_gap: tuple[float, float] = (0.6, 1.5)  # of the gap, in dashes
    solid_centre: float = 0.25
    dashed_edge: float = 0.2  # each
    dashed_start: float = 0.6  # each, in a "start" world
    yellow: float = 0.15
    zebra: float = 0.4  # of crossing roads
    zebra_bar: tuple[float, float] = (0.08, 0.15)
    zebra_length: tuple[float, float] = (0.3, 0.7)
    stop_line: float = 0.3  # of crossing roads
    through_lines: float = 0.1  # how often lines are painted through the crossing
    trap: float = 0.6  # how often own lines are missing behind a crossing, so that the oncoming lane's are the plainest
    trap_length: tuple[float, float] = (0.5, 3.0)
    gappy: float = 0.35  # how often stretches of lines are missing elsewhere
    gap_length: tuple[float, float] = (0.5, 2.5)
    width_change: tuple[float, float] = (0.1, 0.3)  # of the lane's width, up or down
    width_taper: tuple[float, float] = (1.5, 6.0)  # over this length
    width_held: tuple[float, float] = (2.0, 10.0)
    boxes: float = 0.25  # how often boxes stand beside the road
    litter: float = 0.2  # how often seams, cracks and shadows of rails lie on a road with markings
    margin: tuple[float, float] = (1.5, 6.0)  # of the floor around the road
    # the look
    hazed: float = 0.15  # of scale worlds
    haze: tuple[float, float] = (0.04, 0.2)  # 1 / scene units
    # the drive
    mirrored: float = 0.5  # left-hand traffic
    racing: float = 0.25
    oscillating: float = 0.2
    speed: tuple[float, float] = (1.0, 3.5)  # lane widths a second
    lead: tuple[float, float] = (1.0, 4.0)  # seconds from the start to what the world is about
    inside: float = 0.15  # how often the drive begins inside the crossing
    standing: float = 0.25  # how often the car stands for a while
    standing_first: float = 0.35  # then, how often from the start on
    standing_from: tuple[float, float] = (1.0, 6.0)  # seconds
    standing_for: tuple[float, float] = (0.8, 3.0)
    no_motion: float = 0.2  # how often no motion is known
    nodding: float = 0.25
    nod: tuple[float, float] = (math.radians(0.3), math.radians(1.5))  # amplitude of the pitch
    nod_rate: tuple[float, float] = (0.8, 3.0)  # Hz
    # car.toml
    wrong: float = 0.7  # how often it is wrong
    pitch: tuple[float, float] = (-math.radians(2.0), math.radians(2.0))  # error of pitch_rad
    height: tuple[float, float] = (0.9, 1.1)  # factor on z_m
    believed_width: tuple[float, float] = (0.85, 1.15)  # factor on [lane] width_m
    believed_marking: tuple[float, float] = (0.5, 2.0)  # factor on marking_width_m, logarithmically


class Draws:
    """Draws the values of `WorldRanges` by their names, each from a seed of its own."""

    def __init__(self, seed: int, ranges: WorldRanges) -> None:
        self._seed, self._ranges = seed, ranges

    def rng(self, name: str) -> Generator:
        """A generator for what has this name."""
        return np.random.default_rng((self._seed, key_of(f"world.{name}")))

    def within(self, name: str) -> float:
        """Uniform in the range of this name."""
        return float(self.rng(name).uniform(*getattr(self._ranges, name)))

    def log_within(self, name: str) -> float:
        """Uniform in the logarithm."""
        return math.exp(float(self.rng(name).uniform(*np.log(getattr(self._ranges, name)))))

    def happens(self, name: str) -> bool:
        """True in the share of worlds of this name."""
        return bool(self.rng(name).random() < getattr(self._ranges, name))

    def weighted(self, name: str, weights: dict[str, int]) -> str:
        """One of the keys."""
        total = np.cumsum(list(weights.values()))
        return list(weights)[int(np.searchsorted(total, self.rng(name).integers(total[-1]), side="right"))]


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Nod:
    """The pitch of a suspended camera over time, positive downwards."""

    amplitude_rad: float
    rate_hz: float
    phase_rad: float

    def at(self, t_s: float) -> float:
        """The pitch [rad] at `t_s`, at most the amplitude either way; it swells and fades."""
        swell = 0.6 + 0.4 * math.sin(0.37 * math.tau * self.rate_hz * t_s + 2.0 * self.phase_rad)
        return self.amplitude_rad * swell * math.sin(math.tau * self.rate_hz * t_s + self.phase_rad)


@dataclass(frozen=True, kw_only=True, eq=False)
class RandomWorld:
    """A road, the lane on it that is driven, its look, the drive, the car, and the car that car.toml describes.

    `car` has the true camera and lane width, `believed` is what a pipeline is told. `marked` is False where there is no
    lane marking at all. The car starts at arc length `start_s_m` of the lane. `stop_s` is the time (from, to) [s] for
    which it stands, None where it does not. `odometry` is False where its motion is not known.
    """

    seed: int
    kind: str
    style: str
    track: Track
    lane: Lane
    look: Appearance
    car: CarConfig
    believed: CarConfig
    marked: bool
    mirrored: bool
    trap: bool
    drive_style: str
    speed_mps: float
    start_s_m: float
    stop_s: tuple[float, float] | None
    odometry: bool
    nod: Nod | None

    @property
    def words(self) -> str:
        """What is special about this world, in a few words."""
        loops = len(self.track.crossings)
        camera, believed = self.car.camera.extrinsics, self.believed.camera.extrinsics
        marking = self.believed.lane.marking_width_m / self.car.lane.marking_width_m
        words = [f"{self.kind} {loops}" if loops else self.kind, self.style]
        words += [name for name in ("oscillating", "racing") if self.drive_style == name]
        words += ["mirrored"] * self.mirrored + ["trap"] * self.trap + ["haze"] * (self.look.haze > 0.0)
        words += ["nod"] * (self.nod is not None) + ["no-motion"] * (not self.odometry)
        if self.stop_s is not None:
            words.append("stand" if self.stop_s[0] > 0.0 else "stand-first")
        if self.believed != dataclasses.replace(self.car, lane=self.believed.lane) or marking != 1.0:
            words.append(
                f"pitch{math.degrees(believed.pitch_rad - camera.pitch_rad):+.1f} h{believed.z_m / camera.z_m:.2f}"
                f" w{self.believed.lane.width_m / self.car.lane.width_m:.2f} m{marking:.2f}"
            )
        return " ".join(words)

    def poses(self, t_s: ArrayLike) -> list[DrivenPose]:
        """The true poses at times (n,) [s] after the start."""
        t = np.asarray(t_s, dtype=np.float64)
        drive, start_s = self._drive
        at, pace = self._driven(t)
        poses = (
            drive.poses(start_s + at)
            if isinstance(drive, CircuitDrive)
            else [drive.pose(start_s + moment) for moment in at.tolist()]
        )
        return [
            dataclasses.replace(pose, speed_mps=v * pose.speed_mps, yaw_rate_radps=v * pose.yaw_rate_radps)
            for pose, v in zip(poses, pace.tolist(), strict=True)
        ]

    def nod_rad(self, t_s: float) -> float:
        """The camera's pitch beyond its place on the car at `t_s`; small while the car stands."""
        if self.nod is None:
            return 0.0
        return float(0.15 + 0.85 * self._driven(np.array([t_s]))[1][0]) * self.nod.at(t_s)

    @cached_property
    def _drive(self) -> tuple[Drive | CircuitDrive, float]:
        """The drive, and the time [s] in it at which this world begins."""
        car_m = self.car.vehicle.width_m
        drive: Drive | CircuitDrive
        if self.kind == "circuit":
            drive = CircuitDrive(self.lane, self.drive_style, car_m, self.seed)
        else:
            drive = Drive(
                lane=self.lane, style=self.drive_style, speed_mps=self.speed_mps, car_width_m=car_m, seed=self.seed
            )
        return drive, drive.time_at(self.start_s_m)

    def _driven(self, t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The time (n,) [s] for which an undisturbed drive gets as far, and the share of its speed (n,)."""
        if self.stop_s is None:
            return t_s, np.ones(len(t_s))
        ramp_s = 4.0 if self.kind == "circuit" else 0.5
        before = np.full(len(t_s), -np.inf) if self.stop_s[0] <= 0.0 else self.stop_s[0] - t_s
        pace = np.clip(np.maximum(before, t_s - self.stop_s[1]) / ramp_s, 0.0, 1.0)
        lost = _ramp_lost(t_s, self.stop_s, ramp_s)
        return t_s - lost, pace


def _ramp_lost(t_s: FloatArray, stop_s: tuple[float, float], ramp_s: float) -> FloatArray:
    """The integral of 1 - pace from 0 to t: pace falls linearly to 0 at the stop's start and rises from its end."""
    start, end = stop_s

    def falling(t: FloatArray) -> FloatArray:
        """From long before to t, of a ramp that rises from 0 at start - ramp to 1 at start."""
        u = np.clip(t - (start - ramp_s), 0.0, ramp_s)
        return np.asarray(u * u / (2.0 * ramp_s))

    def rising(t: FloatArray) -> FloatArray:
        """From `end` to t, of a ramp that falls from 1 at end to 0 at end + ramp."""
        u = np.clip(t - end, 0.0, ramp_s)
        return np.asarray(u - u * u / (2.0 * ramp_s))

    zero = np.zeros(1)
    if start <= 0.0:
        return np.minimum(t_s, end) + rising(t_s)
    return falling(t_s) - falling(zero) + np.clip(t_s - start, 0.0, end - start) + rising(t_s)


def kind_of(seed: int) -> str:
    """The kind of the world of a seed: twenty seeds in a row, from a multiple of twenty on, have those of `KINDS`."""
    block = [kind for kind, count in KINDS.items() for _ in range(count)]
    order = np.random.default_rng((seed // len(block), key_of("world.kinds"))).permutation(len(block))
    return block[int(order[seed % len(block)])]


def random_world(seed: int, kind: str | None, car: CarConfig) -> RandomWorld:
    """The world of a seed, of `kind` (None: the seed's own kind); ValueError for an unknown kind.

    `car` is the car that drives, with the true camera: a scale car, for a "circuit" a full-size one. The road's
    lanes are about as wide as its [lane] width_m.
    """
    kind = kind_of(seed) if kind is None else kind
    if kind not in KINDS:
        raise ValueError(f"kind: expected one of {', '.join(KINDS)}, got {kind!r}")
    draws = Draws(seed, WorldRanges())
    style = draws.weighted("look", LOOKS.get(kind, LOOKS["scale"]))
    look = _look(seed, style, kind, draws)
    width_m = car.lane.width_m * draws.within("circuit_width" if kind == "circuit" else "lane_width")
    track, trap = _track(seed, kind, style, width_m, draws)
    mirrored = draws.happens("mirrored")
    lane = reversed_lane(track.forward) if mirrored else track.forward
    marking_m = _marking_m(kind, width_m, draws)
    true = dataclasses.replace(
        car,
        lane=dataclasses.replace(
            car.lane,
            width_m=width_m,
            marking_width_m=marking_m,
            markings="dark" if look.marking_grey < look.floor_grey else "light",
        ),
    )
    drive_style = _drive_style(kind, draws)
    speed_mps = width_m * draws.within("speed")
    return RandomWorld(
        seed=seed,
        kind=kind,
        style=style,
        track=track,
        lane=lane,
        look=look,
        car=true,
        believed=_believed(true, draws),
        marked=kind != "unmarked",
        mirrored=mirrored,
        trap=trap,
        drive_style=drive_style,
        speed_mps=speed_mps,
        start_s_m=_start(kind, track, lane, mirrored, speed_mps, draws),
        stop_s=_stop(kind, draws),
        odometry=not draws.happens("no_motion"),
        nod=_nod(draws),
    )


def _look(seed: int, style: str, kind: str, draws: Draws) -> Appearance:
    """A random look in which a person sees the markings."""
    look = Appearance.random(seed, style=style)
    if kind != "circuit" and draws.happens("hazed"):
        look = dataclasses.replace(look, haze=draws.within("haze"))
    dirt = min(look.dirt, 0.5)
    least = (18.0 + look.read_noise) / (1.0 - 0.5 * dirt)  # grey levels between marking and floor
    marking = look.marking_grey
    if marking < look.floor_grey:
        marking = max(min(marking, look.floor_grey - least), 0.0)
    else:
        marking = min(max(marking, look.floor_grey + least), 255.0)
    return dataclasses.replace(look, marking_grey=marking, dirt=dirt)


def _marking_m(kind: str, width_m: float, draws: Draws) -> float:
    return width_m * draws.log_within("circuit_marking" if kind == "circuit" else "marking")


def _drive_style(kind: str, draws: Draws) -> str:
    if draws.happens("racing"):
        return "racing"
    return "oscillating" if draws.happens("oscillating") and kind != "unmarked" else "centred"


def _stop(kind: str, draws: Draws) -> tuple[float, float] | None:
    if not draws.happens("standing") and kind != "start":
        return None
    from_s = 0.0 if kind == "start" or draws.happens("standing_first") else draws.within("standing_from")
    return from_s, from_s + draws.within("standing_for")


def _nod(draws: Draws) -> Nod | None:
    if not draws.happens("nodding"):
        return None
    phase = float(draws.rng("nod_phase").uniform(0.0, math.tau))
    return Nod(amplitude_rad=draws.within("nod"), rate_hz=draws.within("nod_rate"), phase_rad=phase)


def _believed(car: CarConfig, draws: Draws) -> CarConfig:
    """The car as car.toml describes it."""
    if not draws.happens("wrong"):
        return car
    place = car.camera.extrinsics
    wrong = dataclasses.replace(
        place, pitch_rad=place.pitch_rad + draws.within("pitch"), z_m=place.z_m * draws.within("height")
    )
    lane = dataclasses.replace(
        car.lane,
        width_m=car.lane.width_m * draws.within("believed_width"),
        marking_width_m=car.lane.marking_width_m * draws.log_within("believed_marking"),
    )
    return dataclasses.replace(car, camera=dataclasses.replace(car.camera, extrinsics=wrong), lane=lane)


def _start(kind: str, track: Track, lane: Lane, mirrored: bool, speed_mps: float, draws: Draws) -> float:
    """The arc length on the lane at which the drive begins, a little before what the world is about."""
    length_m = lane.centerline.length_m
    rng = draws.rng("start")
    if not track.crossings:
        return float(rng.uniform(0.0, length_m))
    crossing = track.crossings[int(rng.integers(len(track.crossings)))]
    on_road = (crossing.s_first_m, crossing.s_second_m)[int(rng.integers(2))]
    point = track.road.position(on_road)
    share = on_road / track.road.length_m
    near = length_m * (1.0 - share if mirrored else share)
    at = lane.centerline.project(point, near, 0.05 * length_m)[0]
    width_m = float(lane.width_m(at))
    if kind == "start" or draws.happens("inside"):
        return float((at + rng.uniform(-1.0, 0.5) * width_m) % length_m)
    return float((at - speed_mps * draws.within("lead") - width_m) % length_m)


def _track(seed: int, kind: str, style: str, width_m: float, draws: Draws) -> tuple[Track, bool]:
    """The track, and whether the own lane's lines are missing behind a crossing."""
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
    common_m = _marking_m(scene.kind, scene.width_m, draws)
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
