"""The appearance of the simulated world: ground, light, camera and background; styles with random parameters."""

from __future__ import annotations

import dataclasses
import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator

from automodel.config.toml_reader import one_of

Draw = Callable[[Generator], Any]


def key_of(name: str) -> int:
    """A number that stands for a parameter in seeds, the same on every machine."""
    return zlib.crc32(name.encode())


def _within(low: float, high: float) -> Draw:
    return lambda rng: float(rng.uniform(low, high))


def _sometimes(chance: float, low: float, high: float) -> Draw:
    """A value in low .. high with the given probability, else 0."""

    def draw(rng: Generator) -> float:
        present, value = rng.random() < chance, float(rng.uniform(low, high))
        return value if present else 0.0

    return draw


def _choice(*values: Any) -> Draw:
    return lambda rng: values[int(rng.integers(len(values)))]


def _tint(spread: float) -> Draw:
    """A colder or warmer tint: blue and red change in opposite directions."""

    def draw(rng: Generator) -> tuple[float, float, float]:
        warmth = float(rng.uniform(-spread, spread))
        return (1.0 - warmth, 1.0, 1.0 + warmth)

    return draw


def _lamps(most: int, strongest: float) -> Draw:
    """Lamps and tubes at the ceiling, windows in the walls."""

    def draw(rng: Generator) -> tuple[dict[str, float], ...]:
        lamps = []
        for _ in range(int(rng.integers(0, most + 1))):
            window = rng.random() < 0.3
            lamps.append(
                {
                    "azimuth_rad": float(rng.uniform(-3.14159, 3.14159)),
                    "elevation_rad": float(rng.uniform(0.05, 0.25) if window else rng.uniform(0.15, 0.65)),
                    "width_rad": float(rng.uniform(0.08, 0.2) if window else rng.uniform(0.02, 0.09)),
                    "height_rad": float(rng.uniform(0.1, 0.2) if window else rng.uniform(0.02, 0.07)),
                    "strength": float(rng.uniform(0.25, 1.0) * strongest),
                }
            )
        return tuple(lamps)

    return draw


STYLES: dict[str, dict[str, Draw]] = {
    "competition": {
        "floor_grey": _within(14.0, 42.0),
        "floor_tint": _tint(0.04),
        "floor_texture": _choice("plastic", "plastic", "plain"),
        "floor_contrast": _within(0.1, 0.5),
        "surround_grey": _within(50.0, 140.0),
        "marking_grey": _within(185.0, 245.0),
        "marking_tint": _tint(0.04),
        "wear": _sometimes(0.4, 0.01, 0.12),
        "dirt": _within(0.0, 0.3),
        "light": _within(0.65, 1.15),
        "light_tint": _tint(0.1),
        "gradient": _within(0.0, 0.12),
        "gradient_direction_rad": _within(-3.14159, 3.14159),
        "lamps": _lamps(12, 150.0),
        "shine": _within(0.05, 0.35),
        "shadow": _sometimes(0.35, 0.2, 0.5),
        "exposure_step": _sometimes(0.4, 0.05, 0.25),
        "exposure_hold_frames": _choice(20, 40, 80, 160),
        "vignetting": _within(0.0, 0.3),
        "defocus_px": _within(0.0, 0.9),
        "exposure_s": _within(0.002, 0.012),
        "read_noise": _within(0.8, 3.0),
        "shot_noise": _within(0.02, 0.15),
        "background": _choice("hall"),
        "background_grey": _within(70.0, 170.0),
        "clutter": _within(0.2, 1.0),
    },
    "road": {
        "floor_grey": _within(60.0, 115.0),
        "floor_tint": _tint(0.03),
        "floor_texture": _choice("asphalt"),
        "floor_contrast": _within(0.3, 0.9),
        "surround_grey": _within(60.0, 120.0),
        "marking_grey": _within(190.0, 245.0),
        "marking_tint": _tint(0.03),
        "wear": _sometimes(0.7, 0.02, 0.3),
        "dirt": _within(0.1, 0.5),
        "light": _within(0.6, 1.2),
        "light_tint": _tint(0.08),
        "gradient": _within(0.0, 0.06),
        "gradient_direction_rad": _within(-3.14159, 3.14159),
        "lamps": _lamps(1, 90.0),
        "shine": _within(0.0, 0.1),
        "shadow": _sometimes(0.5, 0.3, 0.6),
        "exposure_step": _sometimes(0.3, 0.05, 0.2),
        "exposure_hold_frames": _choice(40, 80, 160),
        "vignetting": _within(0.0, 0.25),
        "defocus_px": _within(0.0, 0.8),
        "exposure_s": _within(0.001, 0.008),
        "read_noise": _within(0.5, 2.0),
        "shot_noise": _within(0.02, 0.1),
        "background": _choice("outdoor"),
        "background_grey": _within(130.0, 220.0),
        "clutter": _within(0.2, 1.0),
    },
    "varied": {
        "floor_grey": _within(10.0, 130.0),
        "floor_tint": _tint(0.2),
        "floor_texture": _choice("plain", "plastic", "tiles", "wood", "asphalt", "concrete"),
        "floor_contrast": _within(0.0, 1.0),
        "surround_grey": _choice(None, 40.0, 90.0, 150.0),
        "marking_grey": _within(150.0, 255.0),
        "marking_tint": _tint(0.1),
        "wear": _sometimes(0.6, 0.02, 0.4),
        "dirt": _within(0.0, 0.7),
        "light": _within(0.5, 1.4),
        "light_tint": _tint(0.2),
        "gradient": _within(0.0, 0.3),
        "gradient_direction_rad": _within(-3.14159, 3.14159),
        "lamps": _lamps(16, 230.0),
        "shine": _within(0.0, 0.6),
        "shadow": _sometimes(0.6, 0.2, 0.75),
        "exposure_step": _sometimes(0.6, 0.05, 0.5),
        "exposure_hold_frames": _choice(10, 20, 40, 80, 160),
        "vignetting": _within(0.0, 0.5),
        "defocus_px": _within(0.0, 1.8),
        "exposure_s": _within(0.0, 0.025),
        "read_noise": _within(0.0, 7.0),
        "shot_noise": _within(0.0, 0.4),
        "background": _choice("plain", "hall", "hall", "outdoor"),
        "background_grey": _within(40.0, 220.0),
        "clutter": _within(0.0, 1.0),
    },
    "dry": {  # a circuit in the sun: hard shadows, dust on the lines
        "floor_grey": _within(72.0, 105.0),
        "floor_tint": _tint(0.03),
        "floor_texture": _choice("asphalt"),
        "floor_contrast": _within(0.4, 0.9),
        "surround_grey": _within(58.0, 100.0),
        "marking_grey": _within(195.0, 240.0),
        "marking_tint": _tint(0.03),
        "wear": _within(0.03, 0.3),
        "dirt": _within(0.1, 0.5),
        "light": _within(0.85, 1.2),
        "light_tint": _tint(0.08),
        "gradient": _within(0.0, 0.05),
        "gradient_direction_rad": _within(-3.14159, 3.14159),
        "lamps": _choice(()),
        "shine": _within(0.0, 0.08),
        "shadow": _within(0.3, 0.65),
        "exposure_step": _sometimes(0.4, 0.05, 0.2),
        "exposure_hold_frames": _choice(60, 120, 240),
        "vignetting": _within(0.0, 0.25),
        "defocus_px": _within(0.0, 0.7),
        "exposure_s": _within(0.001, 0.004),
        "read_noise": _within(0.5, 2.0),
        "shot_noise": _within(0.02, 0.1),
        "background": _choice("outdoor"),
        "background_grey": _within(150.0, 220.0),
        "clutter": _within(0.3, 1.0),
    },
}
# rain: dark, without shadows, reflections in the film of water, low contrast, drops, noise
STYLES["wet"] = STYLES["dry"] | {
    "floor_grey": _within(45.0, 75.0),
    "floor_contrast": _within(0.2, 0.6),
    "surround_grey": _within(42.0, 75.0),
    "marking_grey": _within(135.0, 195.0),
    "light": _within(0.75, 1.05),
    "gradient": _within(0.0, 0.04),
    "lamps": _lamps(5, 120.0),
    "shine": _within(0.35, 0.85),
    "shadow": _choice(0.0),
    "vignetting": _within(0.05, 0.3),
    "defocus_px": _within(0.5, 1.3),
    "exposure_s": _within(0.003, 0.009),
    "read_noise": _within(1.5, 4.0),
    "shot_noise": _within(0.05, 0.2),
    "background_grey": _within(110.0, 175.0),
}
# moisture or low sun in the air: what is far away fades into the colour of the horizon
STYLES["hazy"] = STYLES["dry"] | {
    "haze": _within(0.08, 0.35),
    "light": _within(0.75, 1.05),
    "shadow": _sometimes(0.3, 0.1, 0.3),
    "background_grey": _within(150.0, 210.0),
}
# dark tape on a light floor of a living room or a corridor
STYLES["taped"] = STYLES["varied"] | {
    "floor_grey": _within(120.0, 200.0),
    "floor_texture": _choice("wood", "carpet", "concrete", "plain"),
    "marking_grey": _within(10.0, 55.0),
    "wear": _sometimes(0.3, 0.02, 0.15),
    "dirt": _within(0.0, 0.3),
    "light": _within(0.6, 1.15),
    "shine": _within(0.0, 0.35),
    "lamps": _lamps(8, 120.0),
    "read_noise": _within(0.5, 5.0),
}
# paint that is hardly lighter than the floor
STYLES["faint"] = STYLES["varied"] | {
    "floor_grey": _within(60.0, 85.0),
    "floor_contrast": _within(0.0, 0.5),
    "marking_grey": _within(105.0, 125.0),
    "dirt": _within(0.0, 0.2),
    "light": _within(0.8, 1.3),
    "lamps": _lamps(4, 80.0),
    "read_noise": _within(0.5, 4.0),
}
# a camera in poor light
STYLES["noisy"] = STYLES["competition"] | {"read_noise": _within(8.0, 20.0), "shot_noise": _within(0.1, 0.4)}
# many lamps over a polished floor
STYLES["reflections"] = STYLES["competition"] | {"lamps": _lamps(28, 240.0), "shine": _within(0.3, 0.8)}
Bgr = tuple[float, float, float]
FLOORS = ("plain", "plastic", "tiles", "wood", "asphalt", "concrete", "carpet")
BACKGROUNDS = ("plain", "hall", "outdoor")


@dataclass(frozen=True, slots=True, kw_only=True)
class Lamp:
    """A distant lamp or window that is reflected in a shiny floor: direction in the world, size and brightness.

    `strength` is the brightness of the reflection's centre under neutral light [grey levels].
    """

    azimuth_rad: float
    elevation_rad: float
    width_rad: float
    height_rad: float
    strength: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Appearance:
    """The look of a scene; the defaults are neutral: flat colours, even light, a perfect camera.

    Lengths without a unit are in scene units: 1 m for a camera 0.18 m above the ground, in proportion to its height, so
    that one appearance suits a scale car and a real one. Grey levels are 0 .. 255; a tint has a factor for blue, green
    and red.
    """

    floor_grey: float = 40.0
    floor_tint: Bgr = (1.0, 1.0, 1.0)
    floor_texture: str = "plain"  # one of FLOORS
    floor_contrast: float = 0.0  # contrast of the texture, 0 .. 1
    floor_seed: int = 0
    surround_grey: float | None = None  # the ground beyond the floor's edge; None: as the floor
    marking_grey: float = 230.0
    marking_tint: Bgr = (1.0, 1.0, 1.0)
    yellow_bgr: Bgr = (60.0, 190.0, 225.0)
    wear: float = 0.0  # share of the markings that has flaked off, 0 .. 1
    dirt: float = 0.0  # darkening of the markings by dirt, 0 .. 1
    wear_seed: int = 0
    light: float = 1.0  # factor on everything
    light_tint: Bgr = (1.0, 1.0, 1.0)
    gradient: float = 0.0  # relative change of the ground's light from the car to a unit away
    gradient_direction_rad: float = 0.0  # the direction of increasing light in the world
    lamps: tuple[Lamp, ...] = ()
    shine: float = 0.0  # reflectance of the floor at grazing view, 0 .. 1
    shadow: float = 0.0  # share of the light that shadows block, 0 .. 1
    shadow_seed: int = 0
    haze: float = 0.0  # the contrast falls by a factor of e over 1 / haze scene units (Koschmieder's law)
    exposure_step: float = 0.0  # relative size of the sudden changes of exposure
    exposure_hold_frames: int = 40  # frames between them
    exposure_seed: int = 0
    vignetting: float = 0.0  # share of the light lost in the image corners
    defocus_px: float = 0.0  # standard deviation of the blur
    exposure_s: float = 0.0  # the duration of motion blur
    read_noise: float = 0.0  # standard deviation in grey levels, the same for all pixels
    shot_noise: float = 0.0  # variance in grey levels squared per grey level
    noise_seed: int = 0
    background: str = "plain"  # one of BACKGROUNDS
    background_grey: float = 130.0
    clutter: float = 0.5  # density of background objects, 0 .. 1
    background_seed: int = 0

    def __post_init__(self) -> None:
        one_of("floor_texture", self.floor_texture, FLOORS)
        one_of("background", self.background, BACKGROUNDS)
        for name in ("floor_contrast", "wear", "dirt", "shine", "shadow", "exposure_step", "vignetting", "clutter"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name}: expected 0 .. 1, got {getattr(self, name)}")
        for name in (
            "light",
            "haze",
            "defocus_px",
            "exposure_s",
            "read_noise",
            "shot_noise",
            "floor_grey",
            "marking_grey",
        ):
            if not (getattr(self, name) >= 0.0 and math.isfinite(getattr(self, name))):
                raise ValueError(f"{name}: expected a number >= 0, got {getattr(self, name)}")
        if self.exposure_hold_frames < 1:
            raise ValueError(f"exposure_hold_frames: expected 1 or more, got {self.exposure_hold_frames}")

    @classmethod
    def random(cls, seed: int, style: str = "competition") -> Appearance:
        """A random appearance of a style, each parameter from a seed of its own; ValueError for an unknown style.

        "competition" is a black shiny floor under indoor lamps, "road" a real road outdoors, "varied" a wide range of
        both, "dry", "wet" and "hazy" a circuit in the sun, in the rain and in mist; "taped" is dark tape on a light
        floor, "faint" worn out paint, "noisy" a camera in poor light, "reflections" lamps over a polished floor.
        """
        one_of("style", style, tuple(STYLES))
        drawn = {}
        for name, draw in STYLES[style].items():
            drawn[name] = draw(np.random.default_rng((seed, key_of(name))))
        drawn["lamps"] = tuple(Lamp(**lamp) for lamp in drawn["lamps"])
        for field in dataclasses.fields(cls):
            if field.name.endswith("_seed"):
                drawn[field.name] = int(np.random.default_rng((seed, key_of(field.name))).integers(1 << 31))
        return cls(**drawn)
