"""Objects on the ground and parts of the own car, drawn into an image and removed from its mask."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from automodel.geometry import GroundCamera
from automodel.training import noise, solids
from automodel.training.solids import Solid
from automodel.types import FloatArray, Image

Rng = np.random.Generator
Pixels = list[NDArray[np.int32]]


def draw_objects(image: Image, mask: Image, camera: GroundCamera, rng: Rng, road_reach: float) -> None:
    """Draw up to six solids and parts of the own car in place; `mask` becomes 0 where they cover it.

    `image` and `mask` are (h, w) uint8 of the size of `camera`, whose lengths are in lane widths; `road_reach` [lane
    widths] is the largest distance of objects.
    """
    count = int(rng.choice(7, p=(0.3, 0.2, 0.17, 0.13, 0.1, 0.06, 0.04)))
    things = [_thing(camera, rng, road_reach) for _ in range(count)]
    eye = camera.centre_m[:2]
    for thing in sorted(things, key=lambda s: -float(np.hypot(*(s.quads[..., :2].mean(axis=(0, 1)) - eye)))):
        _shade(image, camera, thing, rng)
        _paint(image, mask, camera, thing, rng)
    if rng.random() < 0.16:
        _own_car(image, mask, rng)
    if rng.random() < 0.04:
        _wiper(image, mask, rng)
    if rng.random() < 0.05:
        _dashboard_reflection(image, rng)


def _place(camera: GroundCamera, rng: Rng, reach: float, in_lane: float) -> FloatArray:
    """A random ground point (2,), mostly beside the lane."""
    x = camera.centre_m[0] + float(np.exp(rng.uniform(math.log(0.7), math.log(max(reach, 1.0)))))
    if rng.random() < in_lane:
        return np.array([x, rng.uniform(-0.6, 0.6)])
    return np.array([x, rng.choice((-1, 1)) * rng.uniform(0.65, 1.2 + 0.35 * x)])


def _thing(camera: GroundCamera, rng: Rng, reach: float) -> Solid:
    kind = rng.random()
    eye = camera.centre_m[:2]
    if kind < 0.38:
        at = _place(camera, rng, reach, 0.2)
        yaw = rng.normal(0, 0.12) if rng.random() < 0.8 else rng.uniform(-math.pi, math.pi)
        build = solids.truck if rng.random() < 0.2 else solids.car
        return build(rng, at[0] + 0.6, at[1], yaw)
    if kind < 0.56:
        return _wall_beside(camera, rng, reach)
    if kind < 0.66:
        return solids.cone(rng, _place(camera, rng, reach, 0.2), eye)
    if kind < 0.76:
        return solids.post(rng, _place(camera, rng, reach, 0.05), eye)
    if kind < 0.84:
        return solids.legs(rng, _place(camera, rng, reach, 0.15), eye)
    at = _place(camera, rng, reach, 0.12)
    if kind < 0.92:
        return solids.carton(rng, at[0], at[1], rng.uniform(-math.pi, math.pi))
    if kind < 0.96:
        return solids.table(rng, at[0], at[1], rng.uniform(-math.pi, math.pi))
    return solids.cable(rng, at[0], at[1])


def _wall_beside(camera: GroundCamera, rng: Rng, reach: float) -> Solid:
    side = float(rng.choice((-1, 1)))
    x = camera.centre_m[0] + (rng.uniform(0.2, 1.0) if rng.random() < 0.6 else rng.uniform(0.5, max(reach, 1.0)))
    length = rng.uniform(0.5, max(2.0 * reach, 2.0))
    if rng.random() < 0.15:  # across, beyond the road's end
        return solids.wall(rng, x + rng.uniform(0.3, 1.0) * reach, rng.uniform(2, 9), -1.5 + rng.normal(0, 0.2), 20.0)
    yaw = side * abs(rng.normal(0.0, 0.1)) + rng.normal(0.0, 0.03)
    build = solids.embankment if rng.random() < 0.25 else solids.wall
    return build(rng, x, side * rng.uniform(0.65, 3.0), yaw, length)


def _polygons(camera: GroundCamera, outlines: FloatArray) -> Pixels:
    """Outlines (n, k, 3) as polygons [1/16 px] with edges sampled for lens distortion; empty if not visible."""
    steps = np.linspace(0.0, 1.0, 5, endpoint=False)[:, None]
    after = np.roll(outlines, -1, axis=1)
    edges = outlines[:, :, None, :] * (1.0 - steps) + after[:, :, None, :] * steps
    pixels = camera.body_to_px(edges.reshape(len(outlines), 5 * outlines.shape[1], 3))
    seen: NDArray[np.bool_] = np.asarray(np.isfinite(pixels).all(axis=-1))
    whole = np.rint(np.clip(np.nan_to_num(pixels), -4000, 4000) * 16.0).astype(np.int32)
    return [p[s] if s.sum() >= 3 else np.empty((0, 2), dtype=np.int32) for p, s in zip(whole, seen, strict=True)]


def _facing(solid: Solid, eye: FloatArray) -> NDArray[np.bool_]:
    """Which faces (n,) are turned towards the camera's centre (3,)."""
    if solid.two_sided:
        return np.ones(len(solid.quads), dtype=np.bool_)
    q = solid.quads
    normal = np.cross(q[:, 1] - q[:, 0], q[:, 3] - q[:, 0])
    facing: NDArray[np.bool_] = np.einsum("ij,ij->i", normal, eye - q.mean(axis=1)) > 0.0
    return facing


def _box_around(polygons: Pixels, shape: tuple[int, ...], margin_px: int) -> tuple[slice, slice] | None:
    """Rows and columns of the bounding box of polygons in the image; None if they are outside."""
    corners = [p for p in polygons if len(p)]
    if not corners:
        return None
    points = np.concatenate(corners) / 16.0
    low = np.maximum(np.floor(points.min(axis=0)).astype(int) - margin_px, 0)
    high = np.minimum(np.ceil(points.max(axis=0)).astype(int) + margin_px + 1, (shape[1], shape[0]))
    if (high <= low).any():
        return None
    return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))


def _paint(image: Image, mask: Image, camera: GroundCamera, solid: Solid, rng: Rng) -> None:
    shown = _facing(solid, camera.centre_m)
    polygons = _polygons(camera, solid.quads[shown])
    box = _box_around(polygons, image.shape, 1)
    if box is None:
        return
    cover = np.zeros_like(image)
    for polygon, grey in zip(polygons, solid.greys[shown], strict=True):
        if len(polygon):
            cv2.fillPoly(image, [polygon], float(np.clip(grey, 0, 255)), cv2.LINE_AA, 4)
            cv2.fillPoly(cover, [polygon], 255, cv2.LINE_8, 4)
    part, covered = image[box], cover[box]
    if rng.random() < 0.7:
        rough = part.copy()
        noise.add(rough, noise.fractal(1.4, noise.variant(rng)), rng.uniform(2, 14), rng)
        if rng.random() < 0.4:
            noise.add(rough, noise.band(64.0, 1.0, noise.variant(rng)), rng.uniform(1, 8), rng)
        part[covered > 0] = rough[covered > 0]
    mask[box][covered > 0] = 0


def _shade(image: Image, camera: GroundCamera, solid: Solid, rng: Rng) -> None:
    """Darken the ground under and beside an object."""
    if not len(solid.footprint):
        return
    middle = solid.footprint.mean(axis=0)
    ground = middle + (solid.footprint - middle) * rng.uniform(1.0, 1.2) + rng.normal(0, 0.06, 2)
    outline = np.column_stack((ground, np.zeros(len(ground))))
    polygons = _polygons(camera, outline[None])
    box = _box_around(polygons, image.shape, 8)
    if box is None:
        return
    cover = np.zeros_like(image)
    cv2.fillPoly(cover, polygons, 255, cv2.LINE_AA, 4)
    soft = cv2.GaussianBlur(cover[box], (0, 0), rng.uniform(0.6, 3.0))
    table = (1.0 - rng.uniform(0.3, 0.92) * np.arange(256) / 255.0).astype(np.float32)
    image[box] = (image[box] * cv2.LUT(soft, table)).astype(np.uint8)


def _own_car(image: Image, mask: Image, rng: Rng) -> None:
    """The own bonnet or bumper along the bottom edge, with highlights."""
    height, width = image.shape
    tall, u = rng.uniform(0.02, 0.16) * height, width * rng.uniform(0.35, 0.65)
    half, grey = width * rng.uniform(0.2, 0.9), rng.choice((rng.uniform(0, 60), rng.uniform(60, 230)))
    bend = rng.uniform(0.1, 1.0)
    across = np.linspace(-1.0, 1.0, 24)
    top = height - tall * (1.0 - bend * across**2 - (1.0 - bend) * across**8)
    outline = np.concatenate(
        (np.column_stack((u + half * across, top)), [[u + half, height + 2], [u - half, height + 2]])
    )
    polygon = [np.rint(outline * 16).astype(np.int32)]
    cv2.fillPoly(image, polygon, float(grey), cv2.LINE_AA, 4)
    cv2.fillPoly(mask, polygon, 0.0, cv2.LINE_8, 4)
    for _ in range(int(rng.integers(0, 3))):  # highlights and edges follow its shape
        line = np.column_stack((u + half * across, top + rng.uniform(0.0, 0.8) * tall))
        tone = float(np.clip(grey + rng.normal(30, 60), 0, 255))
        cv2.polylines(
            image, [np.rint(line * 16).astype(np.int32)], False, tone, int(rng.integers(1, 4)), cv2.LINE_AA, 4
        )


def _wiper(image: Image, mask: Image, rng: Rng) -> None:
    """The arm of a wiper in front of the image."""
    height, width = image.shape
    start = (int(rng.uniform(0, width)), height + 5)
    end = (int(start[0] + rng.normal(0, 0.4) * width), int(height * rng.uniform(0.4, 0.95)))
    thick = int(rng.integers(3, 12))
    cv2.line(image, start, end, float(rng.uniform(0, 50)), thick, cv2.LINE_AA)
    cv2.line(mask, start, end, 0.0, thick + 1)


def _dashboard_reflection(image: Image, rng: Rng) -> None:
    """A faint reflection of the dashboard in the windscreen; the lines behind it stay visible."""
    height, width = image.shape
    veil = np.zeros((height // 2, width // 2), dtype=np.uint8)
    for _ in range(int(rng.integers(1, 6))):
        start, end = (tuple(int(v) for v in rng.uniform(0, 1, 2) * (width // 2, height // 2)) for _ in range(2))
        cv2.line(veil, start, end, float(rng.uniform(10, 50)), int(rng.integers(2, 30)))
    soft = cv2.resize(cv2.GaussianBlur(veil, (0, 0), rng.uniform(1.0, 5.0)), (width, height))
    cv2.add(image, soft, dst=image)
