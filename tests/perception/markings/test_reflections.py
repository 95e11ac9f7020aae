"""Reflections against paint, on images of a scene that are drawn by the camera's own projection."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from automodel.config import CameraConfig, CarConfig
from automodel.geometry import BirdsEye, GroundCamera, View
from automodel.perception.line_scan import SightedLine
from automodel.perception.markings.binary_views import WhiteAreas
from automodel.perception.markings.reflections import ReflectionConfig, Reflections, of_streaks, to_the_valleys
from tests.support.drawn_views import Shape, bar, line_at, share

MARKING_M = 0.03
VIEW = View(x_near_m=0.46, x_far_m=1.66, half_width_m=0.64, m_per_px=0.006)
CAR = CarConfig().camera
PIECES = 12


@functools.lru_cache
def pixels(camera: CameraConfig) -> tuple[np.ndarray, np.ndarray]:
    """Body x and y (4, h, w) under four points of each pixel."""
    v, u = np.mgrid[0 : camera.height_px, 0 : camera.width_px]
    parts = np.stack([np.stack((u + a, v + b), axis=-1) for a in (-0.25, 0.25) for b in (-0.25, 0.25)])
    ground = np.nan_to_num(GroundCamera.from_config(camera).px_to_ground(parts.astype(np.float64)), nan=-9.0)
    return ground[..., 0], ground[..., 1]


def lamp(camera: CameraConfig, azimuth_rad: float, width_rad: float) -> np.ndarray:
    """The light (h, w), 0 .. 1, of a lamp that is reflected at an azimuth: a bell, whose edges lie 40 cm from the car
    and 1.2 m behind that."""
    x, y = (part.mean(axis=0) for part in pixels(camera))
    ahead = x - camera.extrinsics.x_m
    bell = np.exp(-(((np.arctan2(y, ahead) - azimuth_rad) / width_rad) ** 2))
    return np.where((ahead > 0.0) & (ahead < 1.6), bell, 0.0)


def drawn(
    *shapes: Shape, light: np.ndarray | None = None, dark: bool = False, camera: CameraConfig = CAR, noise: float = 2.0
) -> np.ndarray:
    """The camera's image (h, w) of painted shapes in a light [grey levels]."""
    painted = np.any([shape(*pixels(camera)) for shape in shapes], axis=0).mean(axis=0) if shapes else 0.0
    image = 60.0 + 90.0 * painted + (0.0 if light is None else light)
    image = image + np.random.default_rng(1).normal(0.0, noise, (camera.height_px, camera.width_px))
    return np.clip(255.0 - image if dark else image, 0.0, 255.0).round().astype(np.uint8)


def filtered(
    *shapes: Shape, light: np.ndarray | None = None, dark: bool = False, camera: CameraConfig = CAR, noise: float = 2.0
) -> tuple[np.ndarray, np.ndarray]:
    """The line view (h, w) of painted shapes in a light [grey levels], and what is left of it; of a car that drives
    straight on.

    The pipeline believes the camera to be the default one.
    """
    return filtered_of(drawn(*shapes, light=light, dark=dark, camera=camera, noise=noise), dark=dark, turn_rad=0.0)


def filtered_of(seen: np.ndarray, *, dark: bool = False, turn_rad: float | None) -> tuple[np.ndarray, np.ndarray]:
    """The line view (h, w) of an image (h, w) of a car that has turned so far in a frame, and what is left of it."""
    eye, markings = GroundCamera.from_config(CAR), "dark" if dark else "light"
    birdseye = BirdsEye(eye, VIEW)
    white_areas = WhiteAreas(birdseye, MARKING_M, 0.0, markings)
    reflections = Reflections(eye, VIEW, white_areas.mask, MARKING_M, markings, PIECES)
    reflections.turned(turn_rad)
    view = birdseye.warp(seen)
    lines = white_areas.step(view).lines
    return lines, reflections.step(view, lines)


def kept(lines: np.ndarray, left: np.ndarray) -> float:
    assert np.count_nonzero(lines) > 300
    assert not (left & ~lines).any()  # nothing is added
    return np.count_nonzero(left) / np.count_nonzero(lines)


@pytest.mark.parametrize("azimuth_rad", [0.0, 0.2, -0.35])
@pytest.mark.parametrize("width_rad", [0.03, 0.06, 0.1, 0.15])
@pytest.mark.parametrize("dark", [False, True])
def test_a_streak_is_removed(azimuth_rad: float, width_rad: float, dark: bool) -> None:
    assert kept(*filtered(light=100.0 * lamp(CAR, azimuth_rad, width_rad), dark=dark)) < 0.15


@pytest.mark.parametrize("noise", [0.0, 0.5, 2.0])
def test_noise_of_a_flat_top_is_no_valley_and_a_streak_beside_it_lies_beyond_one(noise: float) -> None:
    u = np.arange(-13, 14)
    wide, narrow = (60.0 + 100.0 * np.exp(-0.5 * (u / sigma) ** 2) for sigma in (12.0, 3.0))
    beside = narrow + 80.0 * np.exp(-0.5 * ((u - 10) / 2.0) ** 2)
    grain = np.random.default_rng(4).normal(0.0, noise, (100, len(u)))
    assert (to_the_valleys(np.round(wide + grain)).sum(axis=1) > 0.8 * len(u)).mean() >= 0.95
    found = to_the_valleys(np.round(beside + grain))
    assert found[:, :17].all(axis=1).mean() >= 0.95
    assert not found[:, 22:].any()


@pytest.mark.parametrize("azimuth_rad", [0.47, -0.47, 0.5])
def test_a_streak_that_is_seen_in_part_is_removed(azimuth_rad: float) -> None:
    """To one side of it is no ground in view."""
    assert kept(*filtered(light=100.0 * lamp(CAR, azimuth_rad, 0.04))) < 0.3


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("away_rad", [0.12, -0.12])
def test_a_streak_beside_another_one_is_removed(away_rad: float, dark: bool) -> None:
    light = 100.0 * lamp(CAR, 0.1, 0.05) + 90.0 * lamp(CAR, 0.1 + away_rad, 0.05)
    assert kept(*filtered(light=light, dark=dark)) < 0.15


def test_a_streak_that_is_white_in_the_image_is_removed_and_white_paint_stays() -> None:
    assert kept(*filtered(light=500.0 * lamp(CAR, 0.2, 0.03))) < 0.15
    line = line_at(-0.2 * CAR.extrinsics.x_m, slope=0.2)
    bright = 300.0 * line(*pixels(CAR)).mean(axis=0)
    assert kept(*filtered(light=bright)) > 0.95


@pytest.mark.parametrize("pitch_rad", [-0.03, 0.03])
@pytest.mark.parametrize("height", [0.9, 1.1])
def test_a_streak_points_to_the_camera_that_stands_otherwise_than_believed(pitch_rad: float, height: float) -> None:
    place = CAR.extrinsics
    camera = replace(CAR, extrinsics=replace(place, pitch_rad=place.pitch_rad + pitch_rad, z_m=height * place.z_m))
    assert kept(*filtered(light=100.0 * lamp(camera, 0.2, 0.04), camera=camera)) < 0.15


@pytest.mark.parametrize("slope", [0.0, 0.25, -0.4])
@pytest.mark.parametrize("dark", [False, True])
def test_paint_that_points_to_the_camera_stays(slope: float, dark: bool) -> None:
    line = line_at(-slope * CAR.extrinsics.x_m, slope=slope)
    assert kept(*filtered(line, dark=dark)) == 1.0


@pytest.mark.parametrize("line", [line_at(0.2), line_at(-0.2), line_at(0.2, bend_per_m=-0.8), line_at(0.5, slope=-0.6)])
def test_blurred_paint_stays(line: Shape) -> None:
    """A line beside the car, as wide as no marking is; it does not point to the camera."""
    soft = sum(0.1 * line_at_width(line, scale) for scale in np.linspace(0.2, 2.0, 10))
    assert kept(*filtered(light=90.0 * np.asarray(soft))) == 1.0


@pytest.mark.parametrize("azimuth_rad", [0.0, 0.2, -0.3])
@pytest.mark.parametrize("turn_rad", [0.0, 0.01, 0.02, 0.025, 0.03, 0.04])
def test_paint_that_points_to_the_camera_of_a_car_that_turns_stays(azimuth_rad: float, turn_rad: float) -> None:
    """An image of a car that turns moves across while it is exposed, here for a whole frame."""
    line = line_at(-np.tan(azimuth_rad) * CAR.extrinsics.x_m, slope=np.tan(azimuth_rad))
    moved_px = max(round(turn_rad * CAR.intrinsics.fx_px), 1)
    blurred = cv2.blur(drawn(line, noise=0.0).astype(np.float64), (moved_px, 1))
    seen = (blurred + np.random.default_rng(2).normal(0.0, 2.0, blurred.shape)).round().astype(np.uint8)
    assert kept(*filtered_of(seen, turn_rad=turn_rad)) > 0.95
    assert kept(*filtered_of(seen, turn_rad=None)) > 0.95


@pytest.mark.parametrize("azimuth_rad", [0.0, 0.2, -0.3])
@pytest.mark.parametrize("light", [100.0, 300.0, 700.0])
@pytest.mark.parametrize("width_rad", [0.02, 0.03])
def test_a_streak_as_wide_as_a_marking_is_no_blurred_one_where_the_car_does_not_turn(
    azimuth_rad: float, light: float, width_rad: float
) -> None:
    seen = drawn(light=light * lamp(CAR, azimuth_rad, width_rad))
    assert kept(*filtered_of(seen, turn_rad=0.0)) < 0.25


def test_paint_that_crosses_a_streak_stays() -> None:
    """What is left of the streak is doubtful, the line is not."""
    eye, line = GroundCamera.from_config(CAR), line_at(-0.7, MARKING_M, 0.9)
    birdseye = BirdsEye(eye, VIEW)
    white_areas = WhiteAreas(birdseye, MARKING_M)
    reflections = Reflections(eye, VIEW, white_areas.mask, MARKING_M, "light", PIECES)
    reflections.turned(0.0)
    view = birdseye.warp(drawn(line, light=100.0 * lamp(CAR, 0.0, 0.06)))
    areas = white_areas.step(view)
    left = reflections.step(view, areas.lines, areas.paint)
    painted = share(VIEW, line)
    off = cv2.dilate(np.where(painted > 0.0, 255, 0).astype(np.uint8), np.ones((3, 15), np.uint8)) == 0
    assert (left[(painted == 1.0) & (areas.lines > 0)] > 0).mean() > 0.95
    assert np.count_nonzero(areas.lines[off]) > 300
    assert np.count_nonzero(left[off]) < 0.25 * np.count_nonzero(areas.lines[off])
    assert not (reflections.doubtful & ~left).any()
    assert not reflections.doubtful[areas.paint > 0].any()


def test_what_few_rows_show_of_a_line_across_has_no_direction_and_stays() -> None:
    """A long view has rows much longer than its pixels are wide; of a line across, these show shreds."""
    eye, coarse = GroundCamera.from_config(CAR), replace(VIEW, m_per_row=4.0 * VIEW.m_per_px)
    height, width = coarse.height_px, coarse.width_px
    row, column = np.mgrid[0:height, 0:width]
    away = np.abs(row - 0.5 * height - 0.1 * (column - 0.5 * width))
    view = (60.0 + 90.0 * np.clip(2.0 - away, 0.0, 1.0)).astype(np.uint8)
    shreds = np.where((away < 1.5) & (np.abs(column - 0.5 * width) % 40 < 4), 255, 0).astype(np.uint8)
    mask = np.full((height, width), 255, np.uint8)
    reflections = Reflections(eye, coarse, mask, MARKING_M, "light", PIECES)
    reflections.turned(0.0)
    assert np.count_nonzero(shreds) > 50
    np.testing.assert_array_equal(reflections.step(view, shreds), shreds)


def line_at_width(line: Shape, scale: float) -> np.ndarray:
    """The line (h, w) drawn once to each side of its place: the sum of many is a line without edges."""
    x, y = pixels(CAR)
    off = 0.5 * (scale - 1.0) * MARKING_M
    return np.asarray(0.5 * (line(x, y + off).mean(axis=0) + line(x, y - off).mean(axis=0)))


def test_paint_in_a_reflection_stays_and_the_streak_beside_it_goes() -> None:
    light = 80.0 * lamp(CAR, 0.0, 0.08)
    dash = bar(0.9, 0.2, half_m=0.015)
    lines, left = filtered(dash, light=light)
    with_dash = (slice(VIEW.height_px - 122, VIEW.height_px - 80), slice(100, 113))  # x: 0.94 .. 1.19 m, |y| < 4 cm
    dash_only = filtered(dash)[0]
    inside = dash_only[with_dash] > 0
    assert np.count_nonzero(inside) > 100
    assert (left[with_dash][inside] > 0).mean() > 0.8
    assert np.count_nonzero(left) - np.count_nonzero(left[with_dash]) < 0.3 * (
        np.count_nonzero(lines) - np.count_nonzero(lines[with_dash])
    )


def of_camera(markings: str = "light") -> Reflections:
    eye = GroundCamera.from_config(CAR)
    mask = WhiteAreas(BirdsEye(eye, VIEW), MARKING_M, 0.0, markings).mask
    return Reflections(eye, VIEW, mask, MARKING_M, markings, PIECES)


def ray(azimuth_rad: float, from_m: float = 0.6, to_m: float = 1.4) -> np.ndarray:
    """Points (9, 2) of a line that points to the camera."""
    away = np.linspace(from_m, to_m, 9) - CAR.extrinsics.x_m
    return np.stack((away + CAR.extrinsics.x_m, away * np.tan(azimuth_rad)), axis=1)


@pytest.mark.parametrize("azimuth_rad", [0.0, 0.2, -0.3])
@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("colours", [1, 3])
def test_points_on_a_streak_are_told_from_points_on_paint(azimuth_rad: float, dark: bool, colours: int) -> None:
    reflections, points = of_camera("dark" if dark else "light"), ray(azimuth_rad)
    line = line_at(-np.tan(azimuth_rad) * CAR.extrinsics.x_m, slope=np.tan(azimuth_rad))
    streak, paint = (
        np.squeeze(np.repeat(image[..., None], colours, axis=2))
        for image in (drawn(light=100.0 * lamp(CAR, azimuth_rad, 0.04), dark=dark), drawn(line, dark=dark))
    )
    assert reflections.on_streaks(streak, points).all()
    assert not reflections.on_streaks(paint, points).any()
    assert not reflections.on_streaks(streak, points, paint=-1e6).any()  # odds are wanted of it
    assert reflections.on_streaks(paint, points, paint=1e6).all()


def of_line(points_m: np.ndarray) -> SightedLine:
    return SightedLine(points_m=points_m, painted_m=0.8, span_m=0.8)


def test_a_line_is_a_reflection_as_likely_as_its_profiles_say_or_as_another_thing_where_none_was_judged() -> None:
    at, reflections = 0.2, of_camera()
    streak = drawn(light=100.0 * lamp(CAR, at, 0.04))
    pointing = drawn(line_at(-np.tan(at) * CAR.extrinsics.x_m, slope=np.tan(at)))
    aside = drawn(line_at(0.2))
    beside = np.stack((np.linspace(0.6, 1.4, 9), np.full(9, 0.2)), axis=1)
    told = []
    for image, points in ((streak, ray(at)), (pointing, ray(at)), (aside, beside), (aside, ray(-at))):
        birdseye = BirdsEye(GroundCamera.from_config(CAR), VIEW)
        view = birdseye.warp(image)
        lines = WhiteAreas(birdseye, MARKING_M, 0.0, "light").step(view).lines
        reflections.step(view, lines)
        (one,) = reflections.told((of_line(points),))
        assert one.points_m is points
        told.append(one.reflection)
    assert told[0] > 100.0
    assert told[1] < 0.01
    assert told[2:] == [1.0, 1.0]  # it does not point to the camera; there is nothing
    assert of_camera().told((of_line(beside),))[0].reflection == 1.0  # before the first view


def test_only_points_that_point_to_the_camera_are_looked_at() -> None:
    image = drawn(light=100.0 * lamp(CAR, 0.2, 0.04))
    beside = np.stack((np.linspace(0.5, 0.8, 4), np.full(4, 0.2)), axis=1)  # a line straight ahead, to the streak
    away = of_camera().on_streaks(image, np.concatenate((beside, ray(0.2, 1.1, 1.4))))
    assert away.tolist() == 4 * [False] + 9 * [True]
    assert of_camera().on_streaks(image, np.empty((0, 2))).shape == (0,)
    assert not of_camera().on_streaks(image, ray(0.2, 1.4, 40.0) - (0.0, 9.0)).any()  # beside the image


@pytest.mark.parametrize(
    ("odds", "streaks"),
    [
        ((-4.0, -6.0, 1.0, 0.5), 4 * (True,)),  # a doubtful end of a streak
        ((-1.0, 5.0, 6.0, 4.0), 4 * (False,)),  # paint with a blurred end
        ((-9.0, -9.0, 9.0, 9.0), (True, True, False, False)),  # one ends on the other
        ((math.nan, -3.0, math.nan, -3.0), 4 * (True,)),  # shreds between its pieces
        (4 * (math.nan,), 4 * (False,)),
        ((math.inf, -3.0, math.inf, math.inf), 4 * (False,)),  # one piece of a line that points elsewhere
    ],
)
def test_pieces_of_one_thing_are_judged_together(odds: tuple[float, ...], streaks: tuple[bool, ...]) -> None:
    told = of_streaks(np.array((*odds, *(len(odds) * (1.0,)))), len(odds), ReflectionConfig().change)  # one beside it
    assert told.tolist() == [*streaks, *(len(odds) * (False,))]


def test_an_empty_view_stays_empty() -> None:
    lines, left = filtered(noise=0.0)
    assert not lines.any()
    assert not left.any()


@pytest.mark.parametrize(
    ("slope", "lateral_m", "points"), [(0.0, 0.2, False), (0.3, -0.06, True), (0.3, 0.14, False), (-0.5, 0.1, True)]
)
def test_points_on_a_ray_from_below_the_camera_are_told(slope: float, lateral_m: float, points: bool) -> None:
    eye = GroundCamera.from_config(CAR)
    reflections = Reflections(eye, VIEW, BirdsEye(eye, VIEW).mask, MARKING_M, "light", PIECES)
    x = np.linspace(0.5, 1.2, 5)
    line = np.column_stack((x, lateral_m + slope * x))
    assert reflections.any_points_to_camera(np.empty((0, 2)), line) == points
    assert reflections.any_points_to_camera(line, np.empty((0, 2))) == points
    assert not reflections.any_points_to_camera(line[:1], line[1:2])  # two lines' points are no neighbours
