"""The simulator's camera: pictures of painted ground from any pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from automodel.geometry import SE2, GroundCamera
from automodel.sim.appearance import Appearance
from automodel.sim.background import Background
from automodel.sim.coverage import PolygonSet, covered_softly
from automodel.sim.ground_light import NEUTRAL, GroundLight, GroundSampler, MipPattern, floor_pattern, wear_pattern
from automodel.sim.ground_projection import GroundProjection
from automodel.sim.obstacle_boxes import Prism, draw_obstacles
from automodel.sim.paint_view import Painted, PaintView
from automodel.sim.sensor_effects import SensorEffects, exposure
from automodel.types import FloatArray, Image

Float32Array = NDArray[np.float32]

GREY_OF_BGR = np.array([0.114, 0.587, 0.299])
SCALE_CAMERA_M = 0.18  # a camera at this height above the ground has a scene unit of 1 m
TEXEL_UNITS = 0.002
KERB_BGR = np.array([45.0, 40.0, 165.0])


class Renderer:
    """Pictures of one scene through one camera.

    `paint` lies on a floor (x0, y0, x1, y1) [m] of the world frame; `obstacles` stand on it. Pictures depend on the
    arguments of `render` alone: the same ones give the same picture bit for bit. Markings are drawn as exact areas of
    their polygons; floor, wear and light are patterns looked up at each pixel's ground. `roadside` is a circuit's
    ground: asphalt, which then takes the floor's place, with grass beyond it, and kerbs, which are no markings.
    """

    def __init__(
        self,
        paint: Sequence[Painted],
        floor: tuple[float, float, float, float],
        obstacles: Sequence[Prism],
        camera: GroundCamera,
        appearance: Appearance,
        colour: bool = False,
        roadside: Sequence[Painted] = (),
    ) -> None:
        self.camera, self.appearance, self.colour = camera, appearance, colour
        self.obstacles = tuple(obstacles)
        model, projection = camera.camera, GroundProjection(camera)
        self._shape = (model.height_px, model.width_px)
        self._projection, self._row0 = projection, projection.row0
        self._paint = PaintView(projection, paint)
        self._roadside = PaintView(projection, roadside) if roadside else None
        x0, y0, x1, y1 = floor
        self._floor = PolygonSet([np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])])
        unit_m = float(camera.centre_m[2]) / SCALE_CAMERA_M
        self._background = Background(camera, projection.seen, appearance)
        self._light = GroundLight(projection, appearance, unit_m, self._background.view)
        self._sampler = GroundSampler(projection.ground_m[self._row0 :], TEXEL_UNITS * unit_m)
        self._patterns = _patterns(appearance, bool(roadside))
        self._effects = SensorEffects(appearance, self._shape, float(model.matrix[0, 0]), 3 if colour else 1)
        white = appearance.marking_grey * np.array(appearance.marking_tint)
        self._colours = {"white": white, "yellow": np.array(appearance.yellow_bgr), "red": KERB_BGR}

    def render(
        self,
        x_m: float,
        y_m: float,
        yaw_rad: float,
        speed_mps: float = 0.0,
        yaw_rate_radps: float = 0.0,
        index: int = 0,
    ) -> Image:
        """The picture (h, w) grey or (h, w, 3) BGR from a pose of the body frame, the middle of the exposure."""
        pose = SE2(x_m, y_m, yaw_rad)
        gain = self.appearance.light * exposure(self.appearance, index)
        light = gain * self._channels(np.array(self.appearance.light_tint))
        picture = np.empty((*self._shape, 3) if self.colour else self._shape, np.uint8)
        if self._row0 < self._shape[0]:
            picture[self._row0 :] = self._ground(pose, speed_mps * self.appearance.exposure_s, light)
        self._put_background(picture, yaw_rad, light)
        draw_obstacles(picture, self.obstacles, self.camera, pose, light)
        return self._effects.apply(picture, yaw_rate_radps, index)

    def render_mask(self, x_m: float, y_m: float, yaw_rad: float) -> Image:
        """How much of each pixel markings cover (h, w), 0 .. 255: not worn, not blurred, hidden behind obstacles."""
        pose = SE2(x_m, y_m, yaw_rad)
        share = np.zeros(self._projection.shape, np.float32)
        for seen in self._paint.shares(pose).values():
            share = np.minimum(share + seen, np.float32(1.0))
        mask = np.zeros(self._shape, np.uint8)
        mask[self._row0 :] = np.round(255.0 * share)
        draw_obstacles(mask, self.obstacles, self.camera, pose, np.zeros(1))
        return mask

    def _channels(self, bgr: FloatArray) -> FloatArray:
        """A colour's channels in the picture: three, or its grey."""
        return bgr if self.colour else np.array([bgr @ GREY_OF_BGR])

    def _ground(self, pose: SE2, way_m: float, light: FloatArray) -> Image:
        """The rows from `row0` on, lit; `way_m` is how far the car goes during the exposure."""
        sampled = self._sampler.sample(self._patterns, pose)
        beside = {} if self._roadside is None else self._roadside.shares(pose, way_m)
        floor = self._floor_grey(pose, sampled, beside)
        layers = []
        for colour, share in (*beside.items(), *self._paint.shares(pose, way_m).items()):
            if colour == "asphalt":
                continue
            if "wear" in sampled:
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
        """The bare ground, without tint and light."""
        look = self.appearance
        floor = self._textured(look.floor_grey, sampled.get("floor"))
        if look.surround_grey is None:
            return floor
        if self._roadside is None:
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

    def _put_background(self, picture: Image, yaw_rad: float, light: FloatArray) -> None:
        """Fill the pixels that show no ground."""
        seen = self._background.look_up(yaw_rad, self.colour)
        if seen is not None:
            lit = cv2.multiply(seen, np.array((*light, *[0.0] * (4 - len(light)))))
            cv2.copyTo(lit, self._background.mask, picture[: len(seen)])


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
