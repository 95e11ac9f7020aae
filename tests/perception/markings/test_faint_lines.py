"""Lines that are fainter than the noise of a pixel, in drawn views."""

from __future__ import annotations

import numpy as np
import pytest

from automodel.config import CarConfig
from automodel.geometry import BirdsEye, GroundCamera, View
from automodel.perception.line_scan import LineScan
from automodel.perception.markings.binary_views import MarkingViews, WhiteAreas
from automodel.perception.markings.faint_lines import FaintLines
from tests.support.drawn_views import Shape, disc, line_at, share

MARKING_M, RADIUS_M = 0.05, 0.4
VIEW = View(x_near_m=0.4, x_far_m=1.4, half_width_m=0.6, m_per_px=0.0125)
CAMERA = GroundCamera.from_config(CarConfig().camera)
BIRDSEYE = BirdsEye(CAMERA, VIEW)
NOISE = 12.0  # grey levels of a pixel of the image


def ground() -> np.ndarray:
    """The ground (h, w, 2) [m] under the image's pixels; far behind where there is none."""
    rows, columns = np.mgrid[0 : CAMERA.camera.height_px, 0 : CAMERA.camera.width_px]
    return np.nan_to_num(CAMERA.px_to_ground(np.stack((columns, rows), axis=-1)), nan=-9.0)


GROUND = ground()


def looks(markings: str = "light") -> tuple[WhiteAreas, FaintLines]:
    areas = WhiteAreas(BIRDSEYE, MARKING_M, markings=markings)
    return areas, FaintLines(BIRDSEYE, areas, MARKING_M, RADIUS_M, LineScan.SLOPE)


def noisy(seed: int, *painted: tuple[Shape, float], light: np.ndarray | float = 0.0) -> np.ndarray:
    """The view of a noisy image of the ground, painted by so many grey levels, and lit so beside that."""
    image = np.full(GROUND.shape[:2], 90.0) + light
    for shape, height in painted:
        image += height * shape(GROUND[..., 0], GROUND[..., 1])
    image += np.random.default_rng(seed).normal(0.0, NOISE, image.shape)
    return BIRDSEYE.warp(np.clip(np.round(image), 0, 255).astype(np.uint8))


def seen(look: tuple[WhiteAreas, FaintLines], view: np.ndarray) -> tuple[MarkingViews, MarkingViews]:
    """What pixels show alone, and with the faint lines."""
    areas = look[0].step(view)
    return areas, look[1].step(view, areas)


def rows_with(lines: np.ndarray, there: np.ndarray, visible: np.ndarray) -> float:
    """The share of the rows of a painted thing in view in which some of it is found."""
    painted = np.asarray((there > 0.5) & (visible > 0))
    found = np.asarray((painted & (lines > 0)).any(axis=1))
    return float(found[painted.any(axis=1)].mean())


@pytest.mark.parametrize("slope", [0.0, 0.4, -0.9, 1.5])
def test_a_line_is_found_of_which_pixels_show_specks(slope: float) -> None:
    look, line = looks(), line_at(-0.9 * slope, MARKING_M, slope)
    drawn, away = share(VIEW, line), share(VIEW, line_at(-0.9 * slope, 3.0 * MARKING_M, slope)) == 0.0
    specks, found = [], []
    for seed in range(4):
        alone, both = seen(look, noisy(seed, (line, 10.0)))
        specks.append(rows_with(alone.lines, drawn, look[0].mask))
        found.append(rows_with(both.lines, drawn, look[0].mask))
        assert (both.lines[away] > 0).sum() < 10
    assert max(specks) < 0.55
    assert min(found) > 0.5
    assert np.mean(found) > 0.65


def test_the_tightest_bend_is_found() -> None:
    look, bend = looks(), line_at(0.25, MARKING_M, -0.8, 0.8 / RADIUS_M)
    drawn = share(VIEW, bend)
    found = [rows_with(seen(look, noisy(seed, (bend, 10.0)))[1].lines, drawn, look[0].mask) for seed in range(4)]
    assert np.mean(found) > 0.6


def test_noise_alone_is_no_line() -> None:
    look, scan = looks(), LineScan(VIEW, 0.4, MARKING_M)
    added = lines = 0
    for seed in range(60):
        alone, both = seen(look, noisy(seed))
        added += int((both.lines > alone.lines).sum())
        lines += len(scan.step(both.lines, both.bright))
    assert lines == 0
    assert added < 20


@pytest.mark.parametrize("what", ["edge", "slope", "lamp"])
def test_light_that_changes_is_no_line(what: str) -> None:
    x, y = GROUND[..., 0], GROUND[..., 1]
    light = {
        "edge": 60.0 * (y > 0.1 * x),
        "slope": np.clip(100.0 * y, -80.0, 80.0),
        "lamp": 120.0 * np.exp(-((y - 0.1) ** 2 + (x - 0.9) ** 2) / (2.0 * 0.15**2)),
    }[what]
    look = looks()
    for seed in range(4):
        alone, both = seen(look, noisy(seed, light=light))
        assert (both.lines > alone.lines).sum() < 10


def test_a_bright_speck_makes_no_line() -> None:
    look, scan, speck = looks(), LineScan(VIEW, 0.4, MARKING_M), disc(0.9, 0.1, 0.5 * MARKING_M)
    for seed in range(8):
        alone, both = seen(look, noisy(seed, (speck, 150.0)))
        assert alone.bright.any()
        assert len(scan.step(both.lines, both.bright)) == len(scan.step(alone.lines, alone.bright))
        assert (both.lines > alone.lines).sum() < 10


def test_what_pixels_show_is_not_made_longer_or_wider() -> None:
    look, line = looks(), line_at(0.1, MARKING_M, 0.2)
    alone, both = seen(look, noisy(1, (line, 90.0)))
    assert rows_with(alone.lines, share(VIEW, line), look[0].mask) > 0.9
    assert np.array_equal(alone.lines, both.lines)
    x, y = GROUND[..., 0], GROUND[..., 1]
    lamp = 60.0 * np.exp(-0.5 * (((x - 0.9) / 0.1) ** 2 + ((y - 0.1) / 0.02) ** 2))
    for seed in range(4):
        alone, both = seen(look, noisy(seed, light=lamp))
        assert alone.bright.any()
        assert (both.lines > alone.lines).sum() < 10
        assert not (both.lines < alone.lines).any()


def test_beside_a_bright_line_a_much_fainter_one_is_none() -> None:
    look, faint, bright = looks(), line_at(0.12, MARKING_M), line_at(-0.2, MARKING_M)
    drawn, brighter = share(VIEW, faint), (bright, 120.0)
    for seed in range(3):
        _, both = seen(look, noisy(seed, (faint, 14.0), brighter))
        assert rows_with(both.lines, drawn, look[0].mask) < 0.1
        _, both = seen(look, noisy(seed, (faint, 14.0), (bright, 20.0)))
        assert rows_with(both.lines, drawn, look[0].mask) > 0.8


@pytest.mark.parametrize(("markings", "light", "dark"), [("light", 1, 0), ("dark", 0, 1), ("both", 1, 1)])
def test_light_and_dark_lines(markings: str, light: int, dark: int) -> None:
    look, line = looks(markings), line_at(0.05, MARKING_M, 0.1)
    drawn = share(VIEW, line)
    for height, found in ((10.0, light), (-10.0, dark)):
        _, both = seen(look, noisy(3, (line, height)))
        share_of = rows_with(both.lines, drawn, look[0].mask)
        assert share_of > 0.7 if found else share_of < 0.1


def test_an_image_without_noise_has_none() -> None:
    look = looks()
    alone, both = seen(look, np.full((VIEW.height_px, VIEW.width_px), 77, np.uint8))
    assert not both.lines.any()
    assert np.array_equal(alone.bright, both.bright)


@pytest.mark.parametrize("slope", [0.0, 0.4, -0.9])
@pytest.mark.parametrize("step", [12.0, 18.0])
def test_the_road_between_faint_seams_is_no_line(slope: float, step: float) -> None:
    """The road beyond them is as bright."""
    look = looks()
    seams = [(line_at(1.6 * side * MARKING_M - 0.9 * slope, 0.8 * MARKING_M, slope), -step) for side in (-1.0, 1.0)]
    for seed in range(4):
        assert np.count_nonzero(seen(look, noisy(seed, *seams))[1].lines) < 30  # of some 300
