"""From what ranges the knobs of a random appearance are drawn, one table a style."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Any

from numpy.random import Generator

Draw = Callable[[Generator], Any]


def key_of(name: str) -> int:
    """A number that stands for a knob in seeds: the same everywhere and at all times."""
    return zlib.crc32(name.encode())


def _within(low: float, high: float) -> Draw:
    return lambda rng: float(rng.uniform(low, high))


def _sometimes(chance: float, low: float, high: float) -> Draw:
    """0 except with the given chance."""

    def draw(rng: Generator) -> float:
        wanted, value = rng.random() < chance, float(rng.uniform(low, high))
        return value if wanted else 0.0

    return draw


def _choice(*values: Any) -> Draw:
    return lambda rng: values[int(rng.integers(len(values)))]


def _tint(spread: float) -> Draw:
    """Blue and red move against each other: colder or warmer."""

    def draw(rng: Generator) -> tuple[float, float, float]:
        warmth = float(rng.uniform(-spread, spread))
        return (1.0 - warmth, 1.0, 1.0 + warmth)

    return draw


def _lamps(most: int, strongest: float) -> Draw:
    """Round lamps and tubes at the ceiling, tall windows in the walls."""

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
    "dry": {  # a circuit in the sun: hard shadows, tyre marks and dust on the lines
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
    "wet": {  # rain: dark, no shadows, the sky and lights mirrored in the film of water, little contrast, drops, noise
        "floor_grey": _within(45.0, 75.0),
        "floor_tint": _tint(0.03),
        "floor_texture": _choice("asphalt"),
        "floor_contrast": _within(0.2, 0.6),
        "surround_grey": _within(42.0, 75.0),
        "marking_grey": _within(135.0, 195.0),
        "marking_tint": _tint(0.03),
        "wear": _within(0.03, 0.3),
        "dirt": _within(0.1, 0.5),
        "light": _within(0.75, 1.05),
        "light_tint": _tint(0.08),
        "gradient": _within(0.0, 0.04),
        "gradient_direction_rad": _within(-3.14159, 3.14159),
        "lamps": _lamps(5, 120.0),
        "shine": _within(0.35, 0.85),
        "shadow": _choice(0.0),
        "exposure_step": _sometimes(0.4, 0.05, 0.2),
        "exposure_hold_frames": _choice(60, 120, 240),
        "vignetting": _within(0.05, 0.3),
        "defocus_px": _within(0.5, 1.3),
        "exposure_s": _within(0.003, 0.009),
        "read_noise": _within(1.5, 4.0),
        "shot_noise": _within(0.05, 0.2),
        "background": _choice("outdoor"),
        "background_grey": _within(110.0, 175.0),
        "clutter": _within(0.3, 1.0),
    },
}
