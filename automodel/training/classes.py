"""Drawn images of one class each, and how well a network does on each class.

A class is a lane on the floor of a scale car whose lines, or whose light or camera, are of one kind. What is beside and
behind it, the camera, and the effects of lens and sensor are as varied as in training, with other seeds.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable

import numpy as np

from automodel.geometry import GroundCamera
from automodel.perception.markings.unet import MarkingNetwork
from automodel.training.augmentation import motion
from automodel.training.cameras import Kind, random_camera
from automodel.training.dataset import HEIGHT_PX, WIDTH_PX, resized
from automodel.training.distractors import random_distractors
from automodel.training.lighting import ceiling_lamps, reflections
from automodel.training.metrics import measured
from automodel.training.roads import LineStyle, Road, painted, random_ribbon
from automodel.training.scenes import Ground, Layers, Sample, augmented, lit_ground
from automodel.training.shapes import Ink, Ribbon, Stripe
from automodel.training.views import from_above
from automodel.types import FloatImage, Image

Rng = np.random.Generator

CLASSES = ("ordinary", "thin", "wide", "horizontal", "dashed", "dark tape", "lamp", "blur")
WIDTHS = {"thin": (0.008, 0.02), "wide": (0.12, 0.28)}  # of lines [lane widths]
ORDINARY = (0.04, 0.1)
FROM_ABOVE_PX = (640, 360)  # of the picture that is seen from above
COLUMNS = ("size", "class", "images", "near_precision", "near_recall", "f1")


def class_sample(name: str, seed: int, above: bool = False) -> Sample:
    """The image of a class and a seed, the same for the same seed; its bird's-eye view if `above`.

    Raises ValueError for an unknown class.
    """
    rng = np.random.default_rng((seed, CLASSES.index(name)))
    camera = random_camera(rng, Kind.SCALE, *(FROM_ABOVE_PX if above else (WIDTH_PX, HEIGHT_PX)))
    road, dark = _road(rng, name), name == "dark tape"
    ground = lit_ground(rng, camera, road, (*random_distractors(rng, road), *road.stripes), dark)
    layers = ground.image, ground.mask, ground.seen, ground.whole
    if name == "lamp":
        layers = _with_lamps(ground, camera, rng)
    elif name == "blur":
        layers = _moved(ground, rng)
    sample = augmented(layers, int(rng.integers(2**62)), dark)
    return from_above(rng, camera, sample) if above else sample


def _road(rng: Rng, name: str) -> Road:
    """A lane with two lines, or the lines across the end of one."""
    ribbon = random_ribbon(rng, Kind.SCALE, 0.6, straight=name == "horizontal")
    half = 0.5 * float(rng.uniform(*WIDTHS.get(name, ORDINARY)))
    length = float(rng.uniform(0.2, 0.8))
    pattern = (length, length * float(rng.uniform(0.7, 2.0))) if name == "dashed" else ()
    style = LineStyle(half_width=half, ink=Ink.PAINT, patterns=(pattern,))
    places = _across(rng, ribbon) if name == "horizontal" else [ribbon.place(ribbon.s, side) for side in (-0.5, 0.5)]
    stripes: list[Stripe] = [stripe for points in places for stripe in painted(rng, style, points)]
    reach = float(ribbon.s[-1])
    return Road(kind=Kind.SCALE, ribbon=ribbon, left=0.5, right=0.5, reach=reach, stripes=tuple(stripes))


def _across(rng: Rng, ribbon: Ribbon) -> list[np.ndarray]:
    """Two lines (n, 2) that turn off to one side: a corner of about 90 degrees ahead."""
    side, at, away = float(rng.choice((-1.0, 1.0))), rng.uniform(0.5, 3.0), np.linspace(0.0, 6.0, 40)[:, None]
    lean = np.array([rng.normal(0.0, 0.1), side])
    return [ribbon.local(at, (shift, -side * shift) + away * lean) for shift in (-0.5, 0.5)]


def _with_lamps(ground: Ground, camera: GroundCamera, rng: Rng) -> Layers:
    """The ground with lamps mirrored in it."""
    image: FloatImage = ground.image.astype(np.float32)
    ceiling_lamps(image, camera, rng)
    reflections(image, rng)
    return np.clip(image, 0.0, 255.0).astype(np.uint8), ground.mask, ground.seen, ground.whole


def _moved(ground: Ground, rng: Rng) -> Layers:
    """The ground and its paint under the same motion of the camera."""
    seed = int(rng.integers(2**62))

    def moved(layer: Image | FloatImage) -> Image:
        return motion(np.clip(layer, 0.0, 255.0).astype(np.uint8), np.random.default_rng(seed))

    seen, whole = (moved(layer).astype(np.float32) for layer in (ground.seen, ground.whole))
    return moved(ground.image), ground.mask, seen, whole


def measure(network: MarkingNetwork, images: int, seed: int, classes: Iterable[str] = ()) -> list[dict[str, object]]:
    """A row of `COLUMNS` for each class, of `images` images from `seed` on, at a probability of one half."""
    rows: list[dict[str, object]] = []
    for name in classes or CLASSES:
        draw: Callable[[int], Sample] = functools.partial(class_sample, name, above=network.from_above)
        samples = (np.stack((sample.image, sample.mask)) for sample in map(draw, range(seed, seed + images)))
        found = measured(network.step, (resized(each, network.width_px, network.height_px) for each in samples))
        rows.append(
            {
                "size": network.size,
                "class": name,
                "images": images,
                "near_precision": found.near_precision,
                "near_recall": found.near_recall,
                "f1": found.score,
            }
        )
    return rows
