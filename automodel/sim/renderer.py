"""The simulator's camera: images of painted ground and obstacles from any pose, with lens and sensor effects."""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from automodel.config import Intrinsics
from automodel.geometry import SE2, CameraModel, GroundCamera
from automodel.sim.appearance import Appearance
from automodel.sim.background import Background, Haze
from automodel.sim.coverage import PaintView, PolygonSet, covered_softly
from automodel.sim.ground_light import (
    NEUTRAL,
    NO_MAP,
    GroundLight,
    GroundSampler,
    MipPattern,
    floor_pattern,
    wear_pattern,
)
from automodel.sim.ground_projection import GroundProjection
from automodel.sim.hills import HeightAhead, seen_ground
from automodel.sim.paint import Paint
from automodel.sim.track import Obstacle
from automodel.types import Float32Array, FloatArray, Image

FRACTION_BITS = 6


def draw_obstacles(
    image: Image,
    obstacles: Sequence[Sequence[Obstacle]],
    camera: GroundCamera,
    pose: SE2,
    light: FloatArray,
    height_m: HeightAhead | None = None,
) -> None:
    """Draw groups of convex obstacles into an image (h, w[, 3]), the farthest group first, each in its own order.

    `light` is a factor for each channel; `height_m` tells how high the ground is under a group.
    """
    body_from_world = pose.inverse()
    outlines = [[body_from_world.apply(part.polygon_m) for part in group] for group in obstacles]
    middles = [np.mean([outline.mean(axis=0) for outline in group], axis=0) for group in outlines]
    for i in sorted(range(len(obstacles)), key=lambda i: (float(np.linalg.norm(middles[i])), i), reverse=True):
        up_m = np.array((0.0, 0.0, 0.0 if height_m is None else float(height_m(middles[i][:1])[0])))
        for part, outline in zip(obstacles[i], outlines[i], strict=True):
            for face, shade in _faces(outline, part, camera.centre_m - up_m, pose.yaw_rad):
                polygon = _projected(face + up_m, camera)
                if len(polygon) >= 3:
                    colour = np.clip(part.grey * shade * light, 0.0, 255.0).round().tolist()
                    fixed = np.round(polygon * (1 << FRACTION_BITS)).astype(np.int32)
                    cv2.fillPoly(image, [fixed], colour, cv2.LINE_AA, FRACTION_BITS)


def _faces(outline: FloatArray, part: Obstacle, eye_m: FloatArray, yaw_rad: float) -> list[tuple[FloatArray, float]]:
    """Faces (n, 3) [m] visible from `eye_m`, and their brightness; the light's direction is fixed in the world."""
    faces, low_m, height_m = [], part.base_m, part.base_m + part.height_m
    for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        along = b - a
        if along[0] * (eye_m[1] - a[1]) - along[1] * (eye_m[0] - a[0]) >= 0.0:
            continue  # this wall faces away
        outwards = math.atan2(-along[0], along[1]) + yaw_rad
        wall = np.array([(*a, low_m), (*b, low_m), (*b, height_m), (*a, height_m)])
        faces.append((wall, 0.7 + 0.25 * math.cos(outwards - 0.8)))
    if eye_m[2] > height_m:
        faces.append((np.column_stack((outline, np.full(len(outline), height_m))), 1.0))
    return faces


def _projected(face: FloatArray, camera: GroundCamera) -> FloatArray:
    """Pixels (m, 2) of a face (n, 3) of the body frame, without the parts behind the camera or outside its lens."""
    cam = (face - camera.centre_m) @ camera.cam_from_body.T
    cam = _cut(cam, np.array([0.0, 0.0, 1.0]), 0.02 * float(camera.centre_m[2]))
    if len(cam) < 3:
        return np.zeros((0, 2))
    if camera.camera.distortion.any():
        parts = np.linspace(0.0, 1.0, 24, endpoint=False)[:, None]
        cam = np.concatenate([a + parts * (b - a) for a, b in zip(cam, np.roll(cam, -1, axis=0), strict=True)])
    pixels = camera.camera.project(cam)
    return np.clip(pixels[np.isfinite(pixels[:, 0])], -2e4, 2e4)


def _cut(polygon: FloatArray, normal: FloatArray, level: float) -> FloatArray:
    """The part of a polygon (n, 3) where `normal @ p >= level` (Sutherland and Hodgman 1974)."""
    side = polygon @ normal - level
    kept = []
    for i in range(len(polygon)):
        j = (i + 1) % len(polygon)
        if side[i] >= 0.0:
            kept.append(polygon[i])
        if side[i] * side[j] < 0.0:
            kept.append(polygon[i] + side[i] / (side[i] - side[j]) * (polygon[j] - polygon[i]))
    return np.array(kept).reshape(-1, 3)


POOL_MARGIN = (251, 509)  # rows and columns by which the noise is shifted from frame to frame


def mixed(*numbers: int) -> int:
    """A 64-bit hash of the numbers (the finaliser of splitmix64)."""
    state = 0
    for number in numbers:
        state = (state + number + 0x9E3779B97F4A7C15) & 0xFFFFFFFFFFFFFFFF
        state = ((state ^ (state >> 30)) * 0xBF58476D1CE4E5B9) & 0xFFFFFFFFFFFFFFFF
        state = ((state ^ (state >> 27)) * 0x94D049BB133111EB) & 0xFFFFFFFFFFFFFFFF
        state ^= state >> 31
    return state


def exposure(look: Appearance, index: int) -> float:
    """Brightness factor of frame `index`; it changes every `exposure_hold_frames` frames."""
    if not look.exposure_step:
        return 1.0
    draw = mixed(look.exposure_seed, index // look.exposure_hold_frames) / 2.0**64
    return 1.0 + look.exposure_step * (2.0 * draw - 1.0)


@functools.lru_cache(maxsize=64)  # that down the image is the same in every frame
def blur_kernel(sigma_px: float, smear_px: float) -> Float32Array:
    """Gaussian of `sigma_px` convolved with a box of length `smear_px`, integrated over pixels; odd length, sum 1."""
    sigma = math.hypot(sigma_px, 0.05)
    reach = math.ceil(3.0 * sigma_px + 0.5 * smear_px)
    borders = np.arange(-reach, reach + 2) - 0.5
    if smear_px < 1e-3:
        rising = np.array([0.5 * (1.0 + math.erf(b / (sigma * math.sqrt(2.0)))) for b in borders])
    else:
        rising = np.array([_ramp(b + 0.5 * smear_px, sigma) - _ramp(b - 0.5 * smear_px, sigma) for b in borders])
    kernel = np.diff(rising)
    return (kernel / kernel.sum()).astype(np.float32)


def _ramp(x: float, sigma: float) -> float:
    """The integral of the cumulative normal distribution."""
    z = x / sigma
    density = math.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)
    return x * 0.5 * (1.0 + math.erf(z / math.sqrt(2.0))) + sigma * density


class SensorEffects:
    """Applies the lens and the sensor of an appearance to images (h, w[, 3]) of one size."""

    def __init__(self, look: Appearance, shape: tuple[int, int], focal_px: float, channels: int) -> None:
        self._look, self._shape, self._focal_px, self._channels = look, shape, focal_px, channels
        self._vignette = self._vignette_factors(shape) if look.vignetting else None
        self._pool: Float32Array | None = None
        if look.read_noise or look.shot_noise:
            rng = np.random.default_rng(look.noise_seed)
            size = (shape[0] + POOL_MARGIN[0], shape[1] + POOL_MARGIN[1], channels)
            self._pool = rng.standard_normal(size, dtype=np.float32)
        levels = np.arange(256.0)
        self._sigma = np.sqrt(look.read_noise**2 + look.shot_noise * levels).astype(np.float32)

    def apply(self, image: Image, yaw_rate_radps: float, index: int) -> Image:
        """The image as the sensor delivers it."""
        seen: NDArray[Any] = image
        if self._vignette is not None:
            seen = cv2.multiply(seen, self._vignette, scale=1.0 / 255.0)
        smear_px = abs(yaw_rate_radps) * self._look.exposure_s * self._focal_px
        if self._look.defocus_px > 0.0 or smear_px > 0.05:
            across, down = blur_kernel(self._look.defocus_px, smear_px), blur_kernel(self._look.defocus_px, 0.0)
            seen = cv2.sepFilter2D(seen, cv2.CV_8U, across, down, borderType=cv2.BORDER_REPLICATE)
        if self._pool is not None:
            noise: NDArray[Any] = self._noise(self._pool, index)
            seen = cv2.add(seen, cv2.multiply(noise, cv2.LUT(seen, self._sigma)), dtype=cv2.CV_8U)
        return np.asarray(seen, dtype=np.uint8)

    def _noise(self, pool: Float32Array, index: int) -> Float32Array:
        """Normal noise (h, w[, 3]) of unit variance for frame `index`: a part of the pool."""
        draw = mixed(self._look.noise_seed, index)
        row, column = draw % POOL_MARGIN[0], (draw >> 16) % POOL_MARGIN[1]
        part = pool[row : row + self._shape[0], column : column + self._shape[1]]
        return part[..., 0] if self._channels == 1 else part

    def _vignette_factors(self, shape: tuple[int, int]) -> Image:
        height, width = shape
        v, u = np.mgrid[0:height, 0:width]
        middle_u, middle_v = 0.5 * (width - 1), 0.5 * (height - 1)
        radius2 = ((u - middle_u) ** 2 + (v - middle_v) ** 2) / (middle_u**2 + middle_v**2)
        factor = np.round(255.0 * (1.0 - self._look.vignetting * radius2)).astype(np.uint8)
        return factor if self._channels == 1 else np.repeat(factor[..., None], self._channels, axis=2)


GREY_OF_BGR = np.array([0.114, 0.587, 0.299])
SCALE_CAMERA_M = 0.18  # the camera height at which the scene unit is 1 m
TEXEL_UNITS = 0.002
KERB_BGR = np.array([45.0, 40.0, 165.0])
SHADES = {
    "stone": 1.45,
    "pale": 1.2,
    "gutter": 0.78,
    "tar": 0.5,
    "crack": 0.35,
    "shade": 0.5,
}  # shares of the floor's grey


class MovingView:
    """A camera that moves with its car: its image is a view of a `wide` camera's at rest on flat ground.

    `wide` has the same lens and place and a margin on each side, for pitches up to `max_rad` either way.
    """

    def __init__(self, camera: GroundCamera, max_rad: float) -> None:
        model = camera.camera
        corner = np.abs(model.rays([(0.0, 0.0), (model.width_px - 1.0, model.height_px - 1.0)]))[:, :2].max(axis=0)
        if not np.isfinite(corner).all():
            raise ValueError("camera: a lens whose image corners see nothing cannot nod")
        slope = math.tan(max_rad)
        axis = np.abs(camera.cam_from_body[:, 1])  # the car pitches about its own y, which is not that camera's x
        turn, aside = slope * float(axis[2]), slope * float(axis[1])
        turned = turn * corner[1] + aside * (1.0 + corner[0] * (corner[0] + aside)), turn * corner[0]
        across = corner[0] * (corner[1] + slope) * slope + turned[0]
        down = (1.0 + corner[1] * (corner[1] + slope)) * slope + turned[1]
        across, down = (math.ceil(float(model.matrix[k, k] * margin)) + 2 for k, margin in enumerate((across, down)))
        lens = Intrinsics(
            fx_px=float(model.matrix[0, 0]),
            fy_px=float(model.matrix[1, 1]),
            cx_px=float(model.matrix[0, 2]) + across,
            cy_px=float(model.matrix[1, 2]) + down,
            distortion=tuple(model.distortion.tolist()),
        )
        self.max_rad = max_rad
        self.wide = copy.copy(camera)
        self.wide.camera = CameraModel(lens, model.width_px + 2 * across, model.height_px + 2 * down)
        self._camera, self._size = camera, (model.width_px, model.height_px)
        self._cam_from_body = camera.cam_from_body
        self._inverse = np.linalg.solve(model.matrix, np.eye(3))

    @functools.cached_property
    def _rays(self) -> FloatArray:
        """The ray (h, w, 3) of each pixel, in the cam frame."""
        rows, columns = np.mgrid[0 : self._size[1], 0 : self._size[0]]
        return self._camera.camera.rays(np.stack((columns, rows), axis=-1).astype(np.float64))

    def moved(self, image: Image, camera: GroundCamera, height_m: HeightAhead | None) -> Image:
        """The image of the `camera` as it stands now over ground whose height is `height_m` ahead.

        Each pixel shows the place on the ground, or the direction above it, that it sees now. What stands on the ground
        is not moved rightly: draw it afterwards.
        """
        ground_m = seen_ground(camera, self._rays, height_m)
        sky = np.isnan(ground_m[..., 0])
        away = np.concatenate((ground_m, np.zeros((*sky.shape, 1))), axis=-1) - self.wide.centre_m
        above = self._rays[sky] @ camera.cam_from_body
        above[:, 2] = np.maximum(above[:, 2], 0.0)  # behind a crest there is no ground, and no sky was drawn
        away[sky] = above
        maps = self.wide.camera.project(away @ self.wide.cam_from_body.T).astype(np.float32)
        seen = cv2.remap(image, maps, NO_MAP, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(seen, dtype=np.uint8)

    def turned(self, image: Image, nod_rad: float) -> Image:
        """The image of a camera that nods about its own centre; `nod_rad` is positive downwards.

        Raises ValueError beyond `max_rad`.
        """
        if abs(nod_rad) > self.max_rad:
            raise ValueError(f"nod_rad: expected at most {self.max_rad} either way, got {nod_rad}")
        cos, sin = math.cos(nod_rad), math.sin(nod_rad)
        pitch = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])  # of the body frame
        rest_from_nodding = self._cam_from_body @ pitch @ self._cam_from_body.T
        if not self._camera.camera.distortion.any():
            wide_from_px = self.wide.camera.matrix @ rest_from_nodding @ self._inverse
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            return np.asarray(cv2.warpPerspective(image, wide_from_px, self._size, flags=flags), dtype=np.uint8)
        maps = self.wide.camera.project(self._rays @ rest_from_nodding.T).astype(np.float32)
        return np.asarray(cv2.remap(image, maps, NO_MAP, cv2.INTER_LINEAR), dtype=np.uint8)


@dataclass(frozen=True, slots=True, kw_only=True)
class Standing:
    """How a car stands at an instant, where it is not level on flat and empty ground.

    `camera` is the one that renders, as it stands over the plane under the car now; None where that is as at rest.
    `height_m`: of the ground ahead over that plane. `traffic`: other cars on it, each of parts from low to high. A
    camera or a height needs a Renderer with a `nod_max_rad`: the largest angle by which the ground may turn.
    """

    camera: GroundCamera | None = None
    height_m: HeightAhead | None = None
    traffic: tuple[tuple[Obstacle, ...], ...] = ()


class Renderer:
    """Renders images of one scene through one camera.

    `paint` lies on a floor (x0, y0, x1, y1) [m] of the world frame; `obstacles` stand on it. An image depends only on
    the arguments of `render`, to the bit. Markings are drawn as exact areas of their polygons; floor, wear and light
    are patterns looked up at the ground point of each pixel. `roadside` is the ground of a circuit: asphalt, which
    replaces the floor, with grass beyond it, and kerbs, which are no markings; or the street's seams and cracks.
    `nod_max_rad` is the largest pitch by which `render` may be asked to turn the camera.
    """

    def __init__(
        self,
        paint: Sequence[Paint],
        floor: tuple[float, float, float, float],
        obstacles: Sequence[Obstacle],
        camera: GroundCamera,
        appearance: Appearance,
        colour: bool = False,
        roadside: Sequence[Paint] = (),
        nod_max_rad: float = 0.0,
    ) -> None:
        self.camera, self.appearance, self.colour = camera, appearance, colour
        self.obstacles = tuple((each,) for each in obstacles)
        self._nod = MovingView(camera, nod_max_rad) if nod_max_rad > 0.0 else None
        self._eye = eye = camera if self._nod is None else self._nod.wide
        model, projection = eye.camera, GroundProjection(eye)
        self._shape = (model.height_px, model.width_px)
        self._projection, self._row0 = projection, projection.row0
        self._paint = PaintView(projection, paint)
        self._roadside = PaintView(projection, roadside) if roadside else None
        self._paved = any(paint.colour == "asphalt" for paint in roadside)
        x0, y0, x1, y1 = floor
        self._floor = PolygonSet([np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])])
        unit_m = float(camera.centre_m[2]) / SCALE_CAMERA_M
        self._background = Background(eye, projection.seen, appearance)
        self._haze = Haze(projection, appearance, unit_m) if appearance.haze else None
        self._light = GroundLight(projection, appearance, unit_m, self._background.view)
        self._sampler = GroundSampler(projection.ground_m[self._row0 :], TEXEL_UNITS * unit_m)
        self._patterns = _patterns(appearance, self._paved)
        sensor = (camera.camera.height_px, camera.camera.width_px)
        self._effects = SensorEffects(appearance, sensor, float(model.matrix[0, 0]), 3 if colour else 1)
        white = appearance.marking_grey * np.array(appearance.marking_tint)
        self._colours = {"white": white, "yellow": np.array(appearance.yellow_bgr), "red": KERB_BGR}
        ground = appearance.floor_grey * np.array(appearance.floor_tint)
        self._colours |= {name: share * ground for name, share in SHADES.items()}

    def render(
        self,
        x_m: float,
        y_m: float,
        yaw_rad: float,
        speed_mps: float = 0.0,
        yaw_rate_radps: float = 0.0,
        index: int = 0,
        nod_rad: float = 0.0,
        standing: Standing | None = None,
    ) -> Image:
        """The image (h, w) grey or (h, w, 3) BGR from a pose of the body frame at the middle of the exposure.

        `nod_rad` is the pitch of the car, and of its camera with it, positive downwards. `standing`, in its place, says
        how the car stands; obstacles are not hazed then. Raises ValueError for both, and for what needs a margin.
        """
        if nod_rad and standing is not None:
            raise ValueError("nod_rad: expected 0 beside standing, whose camera is pitched")
        pose = SE2(x_m, y_m, yaw_rad)
        gain = self.appearance.light * exposure(self.appearance, index)
        light = gain * self._channels(np.array(self.appearance.light_tint))
        image = np.empty((*self._shape, 3) if self.colour else self._shape, np.uint8)
        if self._row0 < self._shape[0]:
            image[self._row0 :] = self._ground(pose, speed_mps * self.appearance.exposure_s, light)
        self._put_background(image, yaw_rad, light)
        if standing is None:
            draw_obstacles(image, self.obstacles, self._eye, pose, light)
        if self._haze is not None:
            image = self._haze.apply(image, light)
        if standing is not None:
            camera = standing.camera or self.camera
            if standing.camera is not None or standing.height_m is not None:
                if self._nod is None:
                    raise ValueError("standing: expected a Renderer with a nod_max_rad, the camera has no margin")
                image = self._nod.moved(image, camera, standing.height_m)
            elif self._nod is not None:
                image = self._nod.turned(image, 0.0)
            draw_obstacles(image, (*self.obstacles, *standing.traffic), camera, pose, light, standing.height_m)
        elif self._nod is not None:
            image = self._nod.turned(image, nod_rad)
        return self._effects.apply(image, yaw_rate_radps, index)

    def render_mask(self, x_m: float, y_m: float, yaw_rad: float, nod_rad: float = 0.0) -> Image:
        """The share of each pixel that markings cover (h, w), 0 .. 255: without wear and blur, hidden by obstacles."""
        pose = SE2(x_m, y_m, yaw_rad)
        share = np.zeros(self._projection.shape, np.float32)
        for seen in self._paint.shares(pose).values():
            share = np.minimum(share + seen, np.float32(1.0))
        mask = np.zeros(self._shape, np.uint8)
        mask[self._row0 :] = np.round(255.0 * share)
        draw_obstacles(mask, self.obstacles, self._eye, pose, np.zeros(1))
        return mask if self._nod is None else self._nod.turned(mask, nod_rad)

    def _channels(self, bgr: FloatArray) -> FloatArray:
        """The image channels of a colour: three, or its grey."""
        return bgr if self.colour else np.array([bgr @ GREY_OF_BGR])

    def _ground(self, pose: SE2, travel_m: float, light: FloatArray) -> Image:
        """The rows from `row0` on with light; `travel_m` is the distance that the car drives during the exposure."""
        sampled = self._sampler.sample(self._patterns, pose)
        beside = {} if self._roadside is None else self._roadside.shares(pose, travel_m)
        floor = self._floor_grey(pose, sampled, beside)
        layers = []
        for colour, share in (*beside.items(), *self._paint.shares(pose, travel_m).items()):
            if colour == "asphalt":
                continue
            if "wear" in sampled and colour not in SHADES:
                share = np.asarray(
                    cv2.multiply(share, sampled["wear"], scale=1.0 / 255.0, dtype=cv2.CV_32F), np.float32
                )
            layers.append((share, self._channels(self._colours[colour])))
        factor, mirrored = self._light.factor(pose), self._light.reflection(pose.yaw_rad)
        tint = self._channels(np.array(self.appearance.floor_tint))
        channels = []
        for c, gain in enumerate(light.tolist()):
            ground = floor * np.float32(tint[c])
            for share, paint in layers:
                ground += cv2.multiply(share, np.float32(paint[c]) - ground)
            if factor is not None:
                cv2.multiply(ground, factor, dst=ground)
            if mirrored is not None:
                cv2.add(ground, mirrored, dst=ground)
            channels.append(cv2.convertScaleAbs(ground, alpha=gain))
        return np.asarray(cv2.merge(channels) if self.colour else channels[0])

    def _floor_grey(self, pose: SE2, sampled: Mapping[str, Image], beside: Mapping[str, Float32Array]) -> Float32Array:
        """The ground without paint, tint and light."""
        look = self.appearance
        floor = self._textured(look.floor_grey, sampled.get("floor"))
        if look.surround_grey is None:
            return floor
        if not self._paved:
            edges_m = self._floor.edges(np.ones(1, np.bool_), pose.inverse())
            inside = covered_softly(self._projection.edges_px(edges_m), self._projection.shape)
        elif "asphalt" in beside:
            inside = beside["asphalt"]
        else:
            inside = np.zeros(self._projection.shape, np.float32)
        surround = (
            self._textured(look.surround_grey, sampled.get("grass")) if "grass" in sampled else look.surround_grey
        )
        floor -= surround
        cv2.multiply(floor, inside, dst=floor)
        floor += surround
        return floor

    def _textured(self, grey: float, grain: Image | None) -> Float32Array:
        if grain is None:
            return np.full(self._projection.shape, grey, np.float32)
        return np.asarray(grain * np.float32(grey / NEUTRAL))

    def _put_background(self, image: Image, yaw_rad: float, light: FloatArray) -> None:
        """Fill the pixels without ground."""
        seen = self._background.look_up(yaw_rad, self.colour)
        if seen is not None:
            lit = cv2.multiply(seen, np.array((*light, *[0.0] * (4 - len(light)))))
            cv2.copyTo(lit, self._background.mask, image[: len(seen)])


def _patterns(look: Appearance, grass: bool) -> dict[str, MipPattern]:
    """The patterns that the appearance asks for."""
    patterns = {}
    if look.floor_contrast > 0.0:
        patterns["floor"] = MipPattern(floor_pattern(look.floor_texture, look.floor_contrast, look.floor_seed))
        if grass and look.surround_grey is not None:
            patterns["grass"] = MipPattern(floor_pattern("grass", look.floor_contrast, look.floor_seed))
    if look.wear > 0.0 or look.dirt > 0.0:
        patterns["wear"] = MipPattern(wear_pattern(look.wear, look.dirt, look.wear_seed))
    return patterns
