"""How the world looks to the camera: seeded knobs, each of which can be turned alone."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from automodel.sim.appearance_styles import STYLES, key_of

Bgr = tuple[float, float, float]
FLOORS = ("plain", "plastic", "tiles", "wood", "asphalt", "concrete")
BACKGROUNDS = ("plain", "hall", "outdoor")


@dataclass(frozen=True, slots=True, kw_only=True)
class Lamp:
    """A lamp or window far away, as a shiny floor mirrors it: its direction in the world, its size, its brightness.

    `strength` is in grey levels at the reflection's middle under neutral light.
    """

    azimuth_rad: float
    elevation_rad: float
    width_rad: float
    height_rad: float
    strength: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Appearance:
    """What a picture shows beyond geometry; the defaults are neutral: flat colours, even light, a perfect camera.

    Lengths that have no unit are in the unit of the scene: 1 m for a camera 0.18 m above the ground, more in proportion
    for a higher one, so that one appearance suits a scale car and a real one. Grey levels are 0 .. 255; a tint is a
    factor for each of blue, green and red. Seeds choose among patterns of one kind.
    """

    floor_grey: float = 40.0
    floor_tint: Bgr = (1.0, 1.0, 1.0)
    floor_texture: str = "plain"  # one of FLOORS
    floor_contrast: float = 0.0  # how much the texture shows, 0 .. 1
    floor_seed: int = 0
    surround_grey: float | None = None  # the ground beyond the floor's edge; None: the floor goes on
    marking_grey: float = 230.0
    marking_tint: Bgr = (1.0, 1.0, 1.0)
    yellow_bgr: Bgr = (60.0, 190.0, 225.0)
    wear: float = 0.0  # share of the markings that has flaked off, 0 .. 1
    dirt: float = 0.0  # how much dirt darkens the markings, 0 .. 1
    wear_seed: int = 0
    light: float = 1.0  # factor on everything
    light_tint: Bgr = (1.0, 1.0, 1.0)
    gradient: float = 0.0  # relative change of the ground's light from the car to a unit away
    gradient_direction_rad: float = 0.0  # where it grows brighter, in the world
    lamps: tuple[Lamp, ...] = ()
    shine: float = 0.0  # how much the floor mirrors the background at grazing view, 0 .. 1
    shadow: float = 0.0  # share of the light that shadows take, 0 .. 1
    shadow_seed: int = 0
    exposure_step: float = 0.0  # relative size of the sudden changes of exposure
    exposure_hold_frames: int = 40  # frames between them
    exposure_seed: int = 0
    vignetting: float = 0.0  # share of the light lost in the picture's corners
    defocus_px: float = 0.0  # standard deviation of the blur
    exposure_s: float = 0.0  # motion blurs the picture over this time
    read_noise: float = 0.0  # standard deviation in grey levels, the same everywhere
    shot_noise: float = 0.0  # variance in grey levels squared per grey level
    noise_seed: int = 0
    background: str = "plain"  # one of BACKGROUNDS
    background_grey: float = 130.0
    clutter: float = 0.5  # how much stands around, 0 .. 1
    background_seed: int = 0

    def __post_init__(self) -> None:
        _one_of("floor_texture", self.floor_texture, FLOORS)
        _one_of("background", self.background, BACKGROUNDS)
        for name in ("floor_contrast", "wear", "dirt", "shine", "shadow", "exposure_step", "vignetting", "clutter"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name}: {getattr(self, name)} where 0 .. 1 is wanted")
        for name in ("light", "defocus_px", "exposure_s", "read_noise", "shot_noise", "floor_grey", "marking_grey"):
            if not (getattr(self, name) >= 0.0 and math.isfinite(getattr(self, name))):
                raise ValueError(f"{name}: {getattr(self, name)} where a number >= 0 is wanted")
        if self.exposure_hold_frames < 1:
            raise ValueError(f"exposure_hold_frames: {self.exposure_hold_frames} where 1 or more is wanted")

    @classmethod
    def clean(cls) -> Appearance:
        """The neutral appearance."""
        return cls()

    @classmethod
    def random(cls, seed: int, style: str = "competition") -> Appearance:
        """A plausible appearance of a style, each knob drawn from a seed of its own; ValueError for other styles.

        "competition" is a black shiny floor under indoor lamps, "road" a real road outdoors, "varied" anything,
        "dry" and "wet" a circuit in the sun and in the rain.
        """
        _one_of("style", style, tuple(STYLES))
        drawn = {}
        for name, draw in STYLES[style].items():
            drawn[name] = draw(np.random.default_rng((seed, key_of(name))))
        drawn["lamps"] = tuple(Lamp(**lamp) for lamp in drawn["lamps"])
        for field in dataclasses.fields(cls):
            if field.name.endswith("_seed"):
                drawn[field.name] = int(np.random.default_rng((seed, key_of(field.name))).integers(1 << 31))
        return cls(**drawn)


def _one_of(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise ValueError(f"{name}: {value!r} is none of {', '.join(choices)}")
