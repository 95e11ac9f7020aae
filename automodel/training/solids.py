"""Solid objects of flat faces: boxes, walls, cones, people, cables, cars, lorries. Lengths are in lane widths."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from automodel.types import FloatArray

Rng = np.random.Generator

WHOLE = (0.0, 1.0, 0.0, 1.0)
UPRIGHT = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Solid:
    """Faces in painting order.

    `quads` (n, 4, 3) are corners in the body frame, counter-clockwise from the visible side; `greys` (n,); `footprint`
    (m, 2) is the ground that it darkens, or empty; `two_sided` faces are visible from both sides.
    """

    quads: FloatArray
    greys: FloatArray
    footprint: FloatArray
    two_sided: bool = False


class Builder:
    """Collects the faces of a solid at a ground point, rotated by `yaw_rad`."""

    def __init__(self, x: float, y: float, yaw_rad: float = 0.0) -> None:
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        self._turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        self._at = np.array([x, y, 0.0])
        self._quads: list[FloatArray] = []
        self._greys: list[float] = []
        self._light = 0.35 * math.sin(3.0 * x + 2.0 * y)  # the side of the light

    def face(self, corners: ArrayLike, grey: float, part: tuple[float, ...] = WHOLE) -> None:
        """Add a quad (4, 3) or its part (u0, u1, v0, v1), with u from corner 0 to 1 and v from corner 0 to 3."""
        p, q, r, s = np.asarray(corners, dtype=np.float64)
        a, b, c, d = part
        if part != WHOLE:
            at = [(1 - v) * ((1 - u) * p + u * q) + v * ((1 - u) * s + u * r) for u, v in _corners(a, b, c, d)]
            self._quads.append(np.array(at))
        else:
            self._quads.append(np.array([p, q, r, s]))
        self._greys.append(grey)

    def upright(self, left: ArrayLike, right: ArrayLike, grey: float) -> None:
        """Add a quad between two upright edges, `left` and `right` (2, 3), each from the bottom to the top."""
        (a, d), (b, c) = np.asarray(left, dtype=np.float64), np.asarray(right, dtype=np.float64)
        self.face((a, b, c, d), grey)

    def box(self, low: ArrayLike, high: ArrayLike, grey: float, inset: tuple[float, float, float] = UPRIGHT) -> None:
        """Add a box between two corners, lit from above and one side; `inset` as for `box_faces`."""
        for name, corners in box_faces(low, high, inset).items():
            self.face(corners, grey * (_SHADES[name] + self._light * _SIDEWAYS[name]))

    def solid(self, footprint: ArrayLike = (), two_sided: bool = False) -> Solid:
        """The collected solid; `footprint` (m, 2) is in the builder's frame."""
        quads = np.array(self._quads) @ self._turn.T + self._at
        ground = np.asarray(footprint, dtype=np.float64).reshape(-1, 2) @ self._turn[:2, :2].T + self._at[:2]
        return Solid(quads=quads, greys=np.array(self._greys), footprint=ground, two_sided=two_sided)


_SHADES = {"top": 1.25, "right": 0.8, "left": 0.8, "front": 0.7, "rear": 0.7}
_SIDEWAYS = {"top": 0.0, "right": 1.0, "left": -1.0, "front": 0.0, "rear": 0.0}


def _corners(a: float, b: float, c: float, d: float) -> tuple[tuple[float, float], ...]:
    return (a, c), (b, c), (b, d), (a, d)


def box_faces(low: ArrayLike, high: ArrayLike, inset: tuple[float, float, float] = UPRIGHT) -> dict[str, FloatArray]:
    """The four walls and the top (4, 3) of a box, counter-clockwise from outside; the rear faces -x.

    `inset` is the inset of the rear, front and side edges of the top.
    """
    (x0, y0, z0), (x1, y1, z1) = (np.asarray(p, dtype=np.float64) for p in (low, high))
    rear, front, side = inset
    bottom = [(x0, y0, z0), (x1, y0, z0), (x1, y1, z0), (x0, y1, z0)]
    top = [(x0 + rear, y0 + side, z1), (x1 - front, y0 + side, z1)]
    top += [(x1 - front, y1 - side, z1), (x0 + rear, y1 - side, z1)]
    walls = {
        name: np.array([bottom[i], bottom[j], top[j], top[i]])
        for name, i, j in (("front", 1, 2), ("left", 2, 3), ("right", 0, 1), ("rear", 3, 0))
    }
    return {**walls, "top": np.array(top)}


def rectangle(x0: float, x1: float, half: float) -> FloatArray:
    """A footprint (4, 2) from x0 to x1, `half` wide to each side."""
    return np.array([[x0, -half], [x1, -half], [x1, half], [x0, half]])


def carton(rng: Rng, x: float, y: float, yaw_rad: float) -> Solid:
    """A box of any size, with a label or a strip of tape."""
    build = Builder(x, y, yaw_rad)
    length, wide, tall = np.exp(rng.uniform(math.log(0.1), math.log(1.2), 3))
    grey = rng.uniform(10, 235)
    build.box((0, -wide / 2, 0), (length, wide / 2, tall), grey)
    faces = box_faces((-0.003, -wide / 2 - 0.003, 0), (length, wide / 2 + 0.003, tall))
    for name in ("rear", "left", "right"):
        a, b = sorted(rng.uniform(0, 1, 2))
        c, d = sorted(rng.uniform(0, 1, 2))
        build.face(faces[name], rng.uniform(0, 255), (a, b, c, d) if rng.random() < 0.5 else (a, a + 0.08, 0, 1))
    return build.solid(rectangle(-0.05, length, wide * 0.55))


def embankment(rng: Rng, x: float, y: float, yaw_rad: float, length: float) -> Solid:
    """A slope beside the road that rises away from it, with an irregular upper edge."""
    build = Builder(x, y, yaw_rad)
    side = math.copysign(1.0, y)
    wide, tall, grey = rng.uniform(0.5, 5.0), rng.uniform(0.2, 2.5), rng.uniform(30, 190)
    along = np.linspace(0.0, 1.0, 14) ** 2 * length
    rise = tall * np.exp(rng.normal(0.0, 0.12, 14))
    for i in range(13):
        foot = [(along[j], 0.0, 0.0) for j in (i, i + 1)]
        top = [(along[j], side * wide, rise[j]) for j in (i, i + 1)]
        build.face((foot[0], foot[1], top[1], top[0]), grey)
        build.face((top[0], top[1], (along[i + 1], side * wide * 9, rise[i + 1]), (along[i], side * wide * 9, 0)), grey)
    return build.solid(two_sided=True)


def wall(rng: Rng, x: float, y: float, yaw_rad: float, length: float) -> Solid:
    """A wall, kerb, barrier, skirting board or guard rail, in panels whose length grows with the distance."""
    build = Builder(x, y, yaw_rad)
    kind = rng.choice(5)
    tall = float(rng.choice((rng.uniform(0.02, 0.08), rng.uniform(0.1, 0.4), rng.uniform(0.4, 3.0))))
    thick, low = rng.uniform(0.02, 0.15), 0.0
    grey, edge = rng.uniform(20, 215), rng.uniform(0, 255)
    if kind == 0:  # guard rail
        tall, low, thick = rng.uniform(0.15, 0.25), 0.09, 0.04
    ends = np.concatenate(([0.0], np.minimum(0.35 * 1.6 ** np.arange(1, 12), length)))
    for start, stop in pairwise(ends):
        if stop - start < 0.01:
            break
        tone = grey + rng.normal(0, 6)
        if kind == 0:
            build.box((start, -0.02, 0), (start + 0.04, 0.02, low), grey * 0.6)
        build.box((start, -thick / 2, low), (stop, thick / 2, tall), tone)
        faces = box_faces((start, -thick / 2 - 0.002, low), (stop, thick / 2 + 0.002, tall))
        for name in ("left", "right"):
            if kind in (0, 1):  # a bright or dark strip along it
                build.face(faces[name], edge, (0.0, 1.0, 0.35, 0.6))
            elif kind == 2:  # a skirting board
                build.face(faces[name], edge, (0.0, 1.0, 0.0, min(1.0, 0.06 / tall)))
            elif kind == 3:  # red and white
                build.face(faces[name], edge, (0.0, 0.5, 0.0, 1.0))
    return build.solid(rectangle(0.0, length, thick * 1.5))


def _billboard(
    rng: Rng, at: FloatArray, eye: FloatArray, profile: list[tuple[float, float, float]], lean: float
) -> Solid:
    """A round object facing the camera at `eye` (2,): `profile` has rows of height, half width and grey above it."""
    build = Builder(float(at[0]), float(at[1]), math.atan2(*(at - eye)[::-1]))
    shade = rng.uniform(0.55, 1.0)
    for (z0, w0, grey), (z1, w1, _) in pairwise(profile):
        for side, tone in ((1.0, grey), (-1.0, grey * shade)):
            y0, y1 = z0 * lean, z1 * lean
            edge = [(0.0, y0 + side * w0, z0), (0.0, y1 + side * w1, z1)]
            build.upright([(0.0, y0, z0), (0.0, y1, z1)], edge, tone)
    half = max(w for _, w, _ in profile)
    return build.solid(rectangle(-half, half, half), two_sided=True)


def cone(rng: Rng, at: FloatArray, eye: FloatArray) -> Solid:
    """A traffic cone with white bands on a dark foot."""
    tall = rng.uniform(0.1, 0.45)
    base, red, white = tall * rng.uniform(0.22, 0.4), rng.uniform(45, 140), rng.uniform(170, 255)
    profile = [(0.0, base * 1.3, red * 0.7), (tall * 0.05, base * 1.3, red * 0.7), (tall * 0.051, base, red)]
    profile += [(tall * z, base * (1 - 0.85 * z), g) for z, g in ((0.3, white), (0.5, red), (0.65, white), (0.8, red))]
    return _billboard(rng, at, eye, [*profile, (tall, base * 0.15, red)], 0.0)


def post(rng: Rng, at: FloatArray, eye: FloatArray) -> Solid:
    """A delineator, pole, bollard, tree trunk or lamp post."""
    tall = float(np.exp(rng.uniform(math.log(0.15), math.log(4.0))))
    half, grey = rng.uniform(0.01, 0.06), rng.choice((rng.uniform(0, 90), rng.uniform(150, 255)))
    band = rng.uniform(0, 255) if rng.random() < 0.5 else grey
    profile = [(0.0, half, grey), (tall * 0.6, half, band), (tall * 0.75, half, grey), (tall, half, grey)]
    return _billboard(rng, at, eye, profile, rng.normal(0, 0.02))


def legs(rng: Rng, at: FloatArray, eye: FloatArray) -> Solid:
    """The legs of a person beside a small track, or a whole person beside a road."""
    tall = rng.choice((rng.uniform(0.4, 0.55), rng.uniform(1.5, 5.0)))
    shoe, trousers, shirt = rng.uniform(0, 255), rng.uniform(0, 200), rng.uniform(0, 255)
    build = Builder(float(at[0]), float(at[1]), math.atan2(*(at - eye)[::-1]))
    lean = rng.normal(0, 0.06)
    for side in (-1.0, 1.0):
        foot, leg, knee = side * tall * 0.06, tall * 0.045, tall * lean * side
        build.box((-tall * 0.1, foot - leg, 0), (tall * 0.05, foot + leg, tall * 0.035), shoe)
        sole = [(-0.1 * tall, foot, 0.0), (-0.1 * tall, foot, 0.012 * tall)]
        build.upright(np.add(sole, (0, leg, 0)), np.subtract(sole, (0, leg, 0)), rng.uniform(0, 255))
        bone = np.array([(0, foot, 0.02 * tall), (0, foot + knee, tall * 0.52)])
        build.upright(np.add(bone, (0, leg, 0)), np.subtract(bone, (0, leg, 0)), trousers)
        build.upright(bone, np.subtract(bone, (0, leg, 0)), trousers * 0.75)
    for z0, z1, half, grey in ((0.45, 0.85, 0.12, shirt), (0.87, 1.0, 0.05, rng.uniform(40, 200))):
        trunk = np.array([(0, 0, tall * z0), (0, 0, tall * z1)])
        build.upright(np.add(trunk, (0, tall * half, 0)), np.subtract(trunk, (0, tall * half, 0)), grey)
    return build.solid(rectangle(-tall * 0.1, tall * 0.1, tall * 0.15), two_sided=True)


def table(rng: Rng, x: float, y: float, yaw_rad: float) -> Solid:
    """A chair or table: four thin legs, bars, and a seat above."""
    build = Builder(x, y, yaw_rad)
    wide, tall, thick = rng.uniform(0.5, 1.6), rng.uniform(0.5, 1.6), rng.uniform(0.02, 0.07)
    grey = rng.choice((rng.uniform(0, 80), rng.uniform(140, 255)))
    for u in (wide, 0.0):
        for v in (0.0, wide):
            build.box((u, v, 0), (u + thick, v + thick, tall), grey)
    if rng.random() < 0.5:
        build.box((0, 0, tall * 0.25), (thick, wide, tall * 0.25 + thick), grey)
    build.box((0, 0, tall), (wide + thick, wide + thick, tall * 1.06), rng.uniform(20, 230))
    return build.solid()


def cable(rng: Rng, x: float, y: float) -> Solid:
    """A winding cable or hose on the ground, bright on one side and dark on the other."""
    count, step = int(rng.integers(8, 30)), rng.uniform(0.05, 0.25)
    heading = rng.uniform(0, 2 * math.pi) + np.cumsum(rng.normal(0, rng.uniform(0.02, 0.35), count))
    path = np.array([x, y]) + np.cumsum(step * np.column_stack((np.cos(heading), np.sin(heading))), axis=0)
    normal = np.column_stack((-np.sin(heading), np.cos(heading))) * rng.uniform(0.004, 0.03)
    bright, dark = rng.uniform(60, 255), rng.uniform(0, 60)
    quads, greys = [], []
    for side, grey in ((-1.5, dark), (1.0, bright)):
        rim = np.column_stack((path + normal * side, np.full(count, 0.0)))
        core = np.column_stack((path - normal * 0.2 * side, np.full(count, 0.0)))
        quads += [np.array([core[i], core[i + 1], rim[i + 1], rim[i]]) for i in range(count - 1)]
        greys += [grey] * (count - 1)
    return Solid(quads=np.array(quads), greys=np.array(greys), footprint=np.empty((0, 2)), two_sided=True)


def _wheels(build: Builder, length: float, half: float, tall: float) -> None:
    """Four dark boxes under the ends."""
    for x in (0.72 * length, 0.1 * length):
        for side in (-1.0, 1.0):
            y0, y1 = sorted((side * half * 0.62, side * half * 0.97))
            build.box((x, y0, 0), (x + tall, y1, tall), 14, (tall * 0.2, tall * 0.2, 0.0))


def _flanks(build: Builder, length: float, half: float, tall: float) -> None:
    """The wheels on the sides: dark octagons with a lighter rim."""
    angle = np.arange(4) * math.pi / 4 + math.pi / 8
    radius = tall / 2.0
    for x in (0.72 * length, 0.1 * length):
        for side in (-1.0, 1.0):
            middle = np.array([x + radius, side * (half + 0.004), radius])
            spoke = np.column_stack((-side * np.cos(angle), np.zeros(4), np.sin(angle)))
            for size, grey in ((radius, 12.0), (radius * 0.55, 95.0)):
                rim = middle + size * np.concatenate((spoke, -spoke))
                for i in (0, 2, 4):  # a fan of three quads fills the octagon
                    build.face((rim[0], rim[i + 1], rim[i + 2], rim[(i + 3) % 8]), grey)


def car(rng: Rng, x: float, y: float, yaw_rad: float) -> Solid:
    """A car, van or pick-up: body, cabin, windows, wheels, lamps, number plate."""
    build = Builder(x, y, yaw_rad)
    scale, slant = rng.uniform(0.85, 1.15), rng.uniform(0.0, 1.0)
    half, length, tall = 0.25 * scale, rng.uniform(0.9, 1.4) * scale, rng.uniform(0.34, 0.5) * scale
    paint, glass = rng.uniform(8, 240), rng.uniform(5, 110)
    waist, floor, dark = tall * rng.uniform(0.55, 0.68), tall * rng.uniform(0.1, 0.18), rng.uniform(0.3, 0.9)
    _wheels(build, length, half, tall * 0.42)
    low, high, inset = (0, -half, floor), (length, half, waist), (0.02, 0.05, 0.015)
    build.box(low, high, paint, inset)
    rear = box_faces((-0.003, -half, floor), high, inset)["rear"]
    lamp, plate = rng.uniform(20, 255), rng.uniform(100, 255)
    for part, grey in (
        ((0.0, 1.0, 0.0, 0.3), paint * dark * 0.7),
        ((0.02, 0.2, 0.55, 0.85), lamp),
        ((0.8, 0.98, 0.55, 0.85), lamp),
        ((0.38, 0.62, 0.35, 0.55), plate),
    ):
        build.face(rear, grey, part)
    _flanks(build, length, half, tall * 0.42)
    start, stop = length * rng.uniform(0.01, 0.25), length * rng.uniform(0.65, 0.9)
    drawn_in = (tall * 0.5 * slant, tall * 0.6, half * 0.2)
    build.box((start, -half * 0.95, waist), (stop, half * 0.95, tall), paint, drawn_in)
    shell = box_faces((start - 0.004, -half * 0.95 - 0.004, waist), (stop, half * 0.95 + 0.004, tall), drawn_in)
    for name in ("left", "right", "rear"):
        build.face(shell[name], glass, (0.06, 0.94, 0.1, 0.85))
        if name != "rear":
            build.face(shell[name], paint * 0.7, (0.45, 0.5, 0.1, 0.85))
    if rng.random() < 0.4:
        build.face(shell["rear"], glass + 90, (0.2, 0.6, 0.5, 0.8))  # the sky in the window
    return build.solid(rectangle(-0.06, length, half * 1.1))


def truck(rng: Rng, x: float, y: float, yaw_rad: float) -> Solid:
    """A lorry from behind: a tall box on wheels, with doors and a bumper."""
    build = Builder(x, y, yaw_rad)
    half, length, tall, floor = rng.uniform(0.3, 0.37), rng.uniform(1.5, 4.5), rng.uniform(0.8, 1.15), 0.3
    grey = rng.uniform(25, 245)
    _wheels(build, length * 0.5, half, floor)
    build.box((0, -half, floor * 0.8), (length, half, tall), grey)
    faces = box_faces((-0.003, -half - 0.003, floor * 0.8), (length, half + 0.003, tall))
    for name in ("left", "right"):
        build.face(faces[name], rng.uniform(0, 255), (rng.uniform(0, 0.4), rng.uniform(0.5, 1), 0.3, 0.8))
        build.face(faces[name], grey * 0.3, (0.0, 1.0, 0.0, 0.06))
    build.face(faces["rear"], grey * 0.4, (0.0, 1.0, 0.0, 0.06))
    build.face(faces["rear"], grey * 0.5, (0.495, 0.505, 0.06, 1.0))
    for part in ((0.0, 0.12, 0.0, 0.06), (0.88, 1.0, 0.0, 0.06)):
        build.face(faces["rear"], rng.uniform(90, 255), part)
    _flanks(build, length * 0.5, half, floor)
    return build.solid(rectangle(-0.1, length, half * 1.15))
