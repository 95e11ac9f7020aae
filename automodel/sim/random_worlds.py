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
from numpy.typing import ArrayLike

from automodel.config import CarConfig
from automodel.sim.appearance import Appearance, key_of
from automodel.sim.random_draws import Draws, WorldRanges
from automodel.sim.random_tracks import marking_width, random_track
from automodel.sim.track import Lane, Track, reversed_lane
from automodel.sim.trajectory import CircuitDrive, Drive, DrivenPose
from automodel.types import FloatArray

# of twenty seeds in a row, the worlds of each kind; "start" begins at a standstill inside a crossing
KINDS = {"plain": 4, "crossing": 6, "start": 1, "widths": 3, "circuit": 4, "unmarked": 2}
LOOKS = {  # by kind: the styles of `Appearance.random`, each with its weight
    "scale": {"competition": 4, "varied": 6, "road": 2, "taped": 3, "faint": 2, "noisy": 2, "reflections": 2},
    "circuit": {"dry": 1, "wet": 1, "hazy": 1},
    "unmarked": {"road": 3, "dry": 1, "hazy": 1},
}


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
    track, trap = random_track(seed, kind, style, width_m, draws)
    mirrored = draws.happens("mirrored")
    lane = reversed_lane(track.forward) if mirrored else track.forward
    marking_m = marking_width(kind, width_m, draws)
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
