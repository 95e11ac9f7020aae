"""What random worlds are drawn from: the ranges, and draws by name from seeds of their own."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from automodel.sim.appearance import key_of


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
