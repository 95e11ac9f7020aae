"""The white-areas filter on drawn views."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from automodel.config import CarConfig
from automodel.geometry import BirdsEye, GroundCamera, View
from automodel.perception.markings.binary_views import Run, WhiteAreas, narrow_lines
from tests.support.drawn_views import bar, disc, grey, line_at, share

MARKING_M = 0.03
# 5, 6 and 7.5 pixels a marking, and rows that are coarser than columns
VIEWS = [
    View(x_near_m=0.36, x_far_m=1.56, half_width_m=0.64, m_per_px=0.006),
    View(x_near_m=0.36, x_far_m=1.56, half_width_m=0.64, m_per_px=0.005),
    View(x_near_m=0.36, x_far_m=1.56, half_width_m=0.64, m_per_px=0.004, m_per_row=0.006),
]
VIEW = VIEWS[0]
CAMERA = GroundCamera.from_config(CarConfig().camera)


def white_areas(view: View = VIEW, contrast: float = 12.0, markings: str = "light") -> WhiteAreas:
    return WhiteAreas(BirdsEye(CAMERA, view), MARKING_M, contrast, markings)


def middle_columns(lines: np.ndarray) -> np.ndarray:
    """The centroid of each row that has any, of a view with one line."""
    filled = lines.any(axis=1)
    columns = np.arange(lines.shape[1])
    return np.where(filled, (lines * columns).sum(axis=1) / np.maximum(lines.sum(axis=1), 1), np.nan)


def with_rim(drawn: np.ndarray) -> np.ndarray:
    """What is painted (h, w), in part, and the pixels that touch it: a view is averaged over three rows."""
    return np.asarray(cv2.dilate(np.where(drawn > 0.0, 255, 0).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)


def rows_in_sight(filter_: WhiteAreas, near: np.ndarray) -> np.ndarray:
    """Rows in which all of `near` (h, w) is well inside the image."""
    return np.asarray(((filter_.mask == 0) & (near > 0)).sum(axis=1) == 0)


@pytest.mark.parametrize("view", VIEWS, ids=["5 px", "6 px", "7.5 px"])
@pytest.mark.parametrize("slope", [0.0, 0.3, -0.3])
def test_a_kept_line_stays_where_it_is(view: View, slope: float) -> None:
    filter_ = white_areas(view)
    shifts = []
    for place in np.linspace(-0.05, 0.05, 5):  # not the same place between the pixels
        drawn = share(view, line_at(place, slope=slope))
        picture = np.round(40.0 + 160.0 * drawn).astype(np.uint8)
        lines = filter_.step(picture).lines
        kept = rows_in_sight(filter_, drawn) & (lines.sum(axis=1) > 0)
        assert kept.sum() > 0.9 * rows_in_sight(filter_, drawn).sum()
        shifts.append((middle_columns(lines) - middle_columns(drawn))[kept].mean())
    assert abs(np.mean(shifts)) < 0.1
    assert np.abs(shifts).max() < 0.5


def test_lines_of_the_right_width_are_kept_whole() -> None:
    for line in (line_at(0.0), line_at(0.0, slope=0.3), line_at(0.5, slope=-0.6)):
        drawn = share(VIEW, line)
        filter_ = white_areas()
        bright, lines, *_ = filter_.step(grey(VIEW, line))
        inner = (drawn == 1.0) & (filter_.mask > 0)
        assert set(np.unique(lines)) <= {0, 255}
        assert (lines[inner] == 255).mean() > 0.97
        assert (bright[inner] == 255).mean() > 0.97
        assert not lines[drawn == 0.0].any()


def test_wide_things_and_specks_are_removed() -> None:
    filter_ = white_areas()
    wide = line_at(-0.25, 3.2 * MARKING_M)
    specks = [disc(0.5 + 0.2 * k, 0.1 * k - 0.1, 0.004) for k in range(4)]
    blob = disc(0.9, 0.25, 2.0 * MARKING_M)
    for shape in (wide, blob):
        bright, lines, *_ = filter_.step(grey(VIEW, line_at(0.0), shape))
        on = (share(VIEW, shape) > 0.0) & (filter_.mask > 0)
        assert (lines[on] > 0).mean() < 0.3  # a disc's top and bottom are as short as a line
        assert (bright[on] > 0).mean() > 0.5
        assert lines.any()
        if shape is wide:
            assert not lines[on].any()
    lines = filter_.step(grey(VIEW, line_at(0.0), *specks)).lines
    assert not lines[(share(VIEW, *specks) > 0.0) & (share(VIEW, line_at(0.0)) == 0.0)].any()


def test_crossing_bars_are_bright_but_no_lines() -> None:
    filter_ = white_areas()
    stop = bar(0.8, 0.04)
    bright, lines, *_ = filter_.step(grey(VIEW, line_at(0.2), line_at(-0.2), stop))
    on = (share(VIEW, stop) == 1.0) & (filter_.mask > 0)
    between = on & (share(VIEW, line_at(0.0, 0.2)) > 0)
    assert (bright[between] > 0).mean() > 0.9
    assert not lines[between].any()


def test_light_that_changes_over_the_floor_has_no_say() -> None:
    filter_ = white_areas()
    columns = np.linspace(0.25, 1.0, VIEW.width_px)  # four times as bright on one side
    drawn = share(VIEW, line_at(0.2), line_at(-0.2))
    for light in (columns, columns[::-1], np.linspace(0.25, 1.0, VIEW.height_px)[:, None]):
        picture = np.round((60.0 + 190.0 * drawn) * light).astype(np.uint8)
        bright, lines, *_ = filter_.step(picture)
        inner = (drawn == 1.0) & rows_in_sight(filter_, drawn)[:, None]
        assert (lines[inner] > 0).mean() > 0.9
        assert not bright[drawn == 0.0].any()


def test_nothing_is_seen_on_a_bare_floor() -> None:
    filter_ = white_areas()
    rng = np.random.default_rng(0)
    for picture in (
        np.zeros((VIEW.height_px, VIEW.width_px), np.uint8),
        np.full((VIEW.height_px, VIEW.width_px), 255, np.uint8),
        np.clip(rng.normal(60.0, 2.0, (VIEW.height_px, VIEW.width_px)), 0, 255).astype(np.uint8),
    ):
        bright, lines, *_ = filter_.step(picture)
        assert not bright.any()
        assert not lines.any()


def test_faint_markings_count_from_the_contrast_on() -> None:
    inner = share(VIEW, line_at(0.0)) == 1.0
    for step, seen in ((8.0, False), (30.0, True)):
        filter_ = white_areas(contrast=12.0)
        lines = filter_.step(grey(VIEW, line_at(0.0), floor=50.0, marking=50.0 + step)).lines
        inner &= rows_in_sight(filter_, inner)[:, None]
        assert (lines[inner] > 0).mean() > 0.95 if seen else not lines.any()


@pytest.mark.parametrize(("noise", "found"), [(1.0, 0.45), (1.5, 0.6), (4.0, 0.6), (16.0, 0.6)])
def test_without_a_contrast_the_noise_decides(noise: float, found: float) -> None:
    """Nothing on bare ground, however noisy; a line of four noises is found, and far below 12 grey levels."""
    filter_, line = white_areas(contrast=0.0), line_at(0.0)
    grain = np.random.default_rng(1).normal(0.0, noise, (VIEW.height_px, VIEW.width_px))
    bare = np.clip(100.0 + grain, 0, 255).round().astype(np.uint8)
    assert np.count_nonzero(filter_.step(bare).lines) < 5e-4 * bare.size
    drawn = share(VIEW, line)
    inner = (drawn == 1.0) & rows_in_sight(filter_, drawn)[:, None]
    painted = np.clip(100.0 + 4.0 * noise * drawn + grain, 0, 255).round().astype(np.uint8)
    assert (filter_.step(painted).lines[inner] > 0).mean() > found  # rounding to grey levels adds to the least noise


def test_dark_markings_are_the_negative() -> None:
    picture = grey(VIEW, line_at(0.2), line_at(-0.2, slope=0.1))
    light = white_areas().step(picture)
    dark = white_areas(markings="dark").step(255 - picture)
    for one, other in zip(light[:2], dark[:2], strict=True):
        assert (one != other).mean() < 0.002
        assert one.any()
    assert not white_areas(markings="dark").step(picture).lines[share(VIEW, line_at(0.2)) == 1.0].any()


def test_both_polarities_at_once() -> None:
    filter_ = white_areas(contrast=0.0, markings="both")
    light, dark = share(VIEW, line_at(0.2)), share(VIEW, line_at(-0.2))
    lines = filter_.step(np.round(120.0 + 80.0 * light - 80.0 * dark).astype(np.uint8)).lines
    for drawn in (light, dark):
        inner = (drawn == 1.0) & rows_in_sight(filter_, drawn)[:, None]
        assert (lines[inner] > 0).mean() > 0.95
    assert not lines[(light == 0.0) & (dark == 0.0)].any()


@pytest.mark.parametrize("side", [+1, -1])
def test_a_line_that_the_pictures_edge_cuts_is_kept_inside_of_it(side: int) -> None:
    filter_, shape = white_areas(), line_at(side * 0.16, slope=side * 0.3)
    visible = BirdsEye(CAMERA, VIEW).mask > 0
    seen = grey(VIEW, shape)
    for row in np.flatnonzero(visible.any(axis=1)):  # the view repeats the image's edge
        inside = np.flatnonzero(visible[row])
        seen[row, : inside[0]], seen[row, inside[-1] + 1 :] = seen[row, inside[0]], seen[row, inside[-1]]
    lines = filter_.step(seen).lines
    drawn = share(VIEW, shape)
    assert not lines[filter_.mask == 0].any()
    assert not lines[drawn == 0.0].any()
    whole = rows_in_sight(filter_, drawn) & (drawn == 1.0).any(axis=1)
    assert whole.sum() > 50
    assert (lines[whole][drawn[whole] == 1.0] > 0).mean() > 0.97
    away = (middle_columns(lines) - middle_columns(drawn))[whole]
    assert abs(np.nanmean(away)) < 0.1


def test_a_lines_runs_are_those_that_two_openings_leave() -> None:
    random, kernels = np.random.default_rng(1), (np.ones((1, 3), np.uint8), np.ones((1, 9), np.uint8))
    steps = random.integers(0, 2, (200, 12)).repeat(random.integers(1, 13, 12), axis=1)
    ridges = np.where((steps > 0) & (random.random(steps.shape) > 0.05), 255, 0).astype(np.uint8)
    visible = np.where(random.random(ridges.shape) > 0.05, 255, 0).astype(np.uint8)
    ridges[:, [0, -1]] = 0  # an opening takes an image to go on beyond its edge
    wide_enough = cv2.morphologyEx(ridges, cv2.MORPH_OPEN, kernels[0])
    too_wide = cv2.morphologyEx(wide_enough, cv2.MORPH_OPEN, kernels[1])
    run = Run(reach=14, beyond=np.array([30], np.int32), narrow=3, wide=9, light=True, dark=False)
    lines = narrow_lines(np.flatnonzero(ridges), ridges, 1.0, run, visible)
    assert too_wide.any()
    np.testing.assert_array_equal(lines, np.where((too_wide == 0) & (visible > 0), wide_enough, 0))


def beam(azimuth_rad: float, width_rad: float, height: float) -> np.ndarray:
    """The light (h, w) [grey levels] of a lamp's beam, which points to the ground below the camera."""
    rows, columns = np.mgrid[0 : VIEW.height_px, 0 : VIEW.width_px]
    ground = VIEW.to_body(np.stack((columns, rows), axis=-1)) - CAMERA.centre_m[:2]
    away = np.arctan2(ground[..., 1], ground[..., 0]) - azimuth_rad
    return np.asarray(height * np.exp(-0.5 * (away / width_rad) ** 2))


@pytest.mark.parametrize("markings", ["light", "dark", "both"])
@pytest.mark.parametrize("side", [+1, -1])
def test_paint_that_crosses_a_beam_is_seen_in_it(side: int, markings: str) -> None:
    """The beam is twice as bright as the paint, and as wide as the box that tells what is bright."""
    filter_, line = white_areas(contrast=0.0, markings=markings), line_at(-side * 0.7, slope=side * 0.9)
    drawn, light = share(VIEW, line), beam(0.0, 0.08, 120.0)
    grain = np.random.default_rng(3).normal(0.0, 2.0, light.shape)
    seen = np.clip(60.0 + light + 60.0 * drawn + grain, 0, 255).round().astype(np.uint8)
    views = filter_.step(255 - seen if markings == "dark" else seen)
    inside = (drawn == 1.0) & (light > 30.0) & rows_in_sight(filter_, drawn)[:, None]
    assert inside.sum() > 50
    for seen_in in views[:3]:
        assert (seen_in[inside] > 0).mean() > 0.8
    assert np.count_nonzero(views.paint[~with_rim(drawn)]) < 100  # of the beam the few rows where the paint crosses it
    assert np.count_nonzero(views.lines[~with_rim(drawn)]) > 200


def test_a_beams_rim_is_no_noise() -> None:
    """Faint paint is found beside beams, too."""
    line = line_at(-0.1, slope=0.15)
    drawn, grain = share(VIEW, line), np.random.default_rng(4).normal(0.0, 2.0, (VIEW.height_px, VIEW.width_px))
    light = beam(0.35, 0.1, 70.0) + beam(-0.35, 0.1, 70.0)
    filter_ = white_areas(contrast=0.0)
    inner = (drawn == 1.0) & (light < 20.0) & rows_in_sight(filter_, drawn)[:, None]
    found = [
        (
            filter_.step(np.clip(60.0 + lit + 14.0 * drawn + grain, 0, 255).round().astype(np.uint8)).lines[inner] > 0
        ).mean()
        for lit in (0.0, light)
    ]
    assert inner.sum() > 50
    assert found[0] > 0.8
    assert found[1] > 0.5


def seams(*places_m: float, slope: float = 0.1) -> np.ndarray:
    """Dark lines (h, w) along the road, as wide as a marking."""
    return share(VIEW, *(line_at(y, slope=slope) for y in places_m))


@pytest.mark.parametrize("contrast", [0.0, 12.0])
@pytest.mark.parametrize("places", [(-0.03, 0.03), (-0.1, -0.03, 0.03), (0.2, 0.26, 0.33), (-0.2, -0.13, -0.07)])
def test_the_road_between_dark_seams_is_no_line(places: tuple[float, ...], contrast: float) -> None:
    """It is above its sides, but the road beyond them is as bright."""
    grain = np.random.default_rng(5).normal(0.0, 2.0, (VIEW.height_px, VIEW.width_px))
    filter_ = white_areas(contrast=contrast)
    lines = filter_.step(np.round(100.0 - 45.0 * seams(*places) + grain).astype(np.uint8)).lines
    assert np.count_nonzero(lines) < 120  # each strip is some 900 pixels
    dark = white_areas(contrast=contrast, markings="dark")
    lines = dark.step(np.round(100.0 + 45.0 * seams(*places) + grain).astype(np.uint8)).lines
    assert np.count_nonzero(lines) < 120


@pytest.mark.parametrize("beside", [(), (-0.05,), (-0.05, 0.05), (0.06, 0.12)])
def test_paint_beside_dark_seams_is_a_line(beside: tuple[float, ...]) -> None:
    grain = np.random.default_rng(5).normal(0.0, 2.0, (VIEW.height_px, VIEW.width_px))
    filter_, drawn = white_areas(contrast=0.0), share(VIEW, line_at(0.0, slope=0.1))
    view = np.round(100.0 - 45.0 * seams(*beside) + 45.0 * drawn + grain).astype(np.uint8)
    inside = (drawn == 1.0) & rows_in_sight(filter_, drawn)[:, None]
    assert inside.sum() > 300
    assert (filter_.step(view).lines[inside] > 0).mean() > 0.9


@pytest.mark.parametrize("side", [+1, -1])
def test_paint_beside_a_white_wall_is_a_line(side: int) -> None:
    """The wall is as bright as the paint, but it is not the ground."""
    filter_, drawn = white_areas(contrast=0.0), share(VIEW, line_at(0.0))
    view = np.round(60.0 + 150.0 * (drawn + share(VIEW, line_at(side * 0.17, 0.2)))).astype(np.uint8)
    inside = (drawn == 1.0) & rows_in_sight(filter_, drawn)[:, None]
    assert inside.sum() > 300
    assert (filter_.step(view).lines[inside] > 0).mean() > 0.9
