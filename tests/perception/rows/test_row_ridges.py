"""Ridges against markings of known place and width, drawn with the exact share of each pixel that they cover."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from automodel.perception.markings.ridge_noise import MEDIAN
from automodel.perception.rows.brightness import Brightness
from automodel.perception.rows.row_ridges import (
    AROUND,
    BAR,
    GATE,
    LEVEL,
    LINE,
    PER_MARKING,
    REACH,
    WINDOW,
    Ridges,
    RowRidgeFilter,
    best_ridges,
    lay_run,
    measure_ridges,
    run_thresholds,
)
from automodel.types import FloatArray

GROUND, PAINT, CONTRAST, WIDTH = 80.0, 90.0, 15.0, 640
SUB_PIXEL = [-0.5, -0.3, -0.1, 0.0, 0.2, 0.4]


def covered(at: FloatArray, low: float, high: float) -> FloatArray:
    """The share of each pixel, centred `at` (n,) and 1 wide, that lies between `low` and `high`."""
    return np.clip(np.minimum(at + 0.5, high) - np.maximum(at - 0.5, low), 0.0, 1.0)


def least(rows: int) -> NDArray[np.float32]:
    """The least height of a ridge on each row."""
    return np.full(rows, CONTRAST * WINDOW, np.float32)


def ridge_of(values: NDArray[np.float32]) -> Ridges:
    """The ridge in the middle of one column of brightness."""
    fields = measure_ridges(np.ascontiguousarray(values.T), np.zeros(1, np.intp), np.array([AROUND]), least(1))
    return Ridges(*fields)


def run_ridges(picture: NDArray[np.uint8], first: FloatArray, step: float = 1.0, dark: bool = False) -> Ridges:
    """The best ridges of runs about the pixels `first` (n,), with samples every `step` px."""
    pixels = np.empty((len(first), 2 * REACH + 1), np.intp)
    for run, middle in zip(pixels, first, strict=True):
        lay_run(run, middle, step)
    values, gates = Brightness("grey", dark).read(picture, pixels).astype(np.float32), np.full(len(first), GATE)
    return Ridges(*best_ridges(values, least(len(first)), gates))


def around(*markings: tuple[float, float]) -> NDArray[np.float32]:
    """One column of brightness about sample 0 with markings (middle, width) [samples]."""
    at = np.arange(-AROUND, AROUND + 1.0)
    share = sum((covered(at, m - 0.5 * b, m + 0.5 * b) for m, b in markings), np.zeros(len(at)))
    return (GROUND + PAINT * share)[:, None].astype(np.float32)


def row(middle: float, breadth: float = PER_MARKING, paint: float = PAINT) -> NDArray[np.uint8]:
    """An image of one row with one marking at pixel `middle`."""
    at = np.arange(float(WIDTH))
    low, high = middle - 0.5 * breadth, middle + 0.5 * breadth
    return np.rint(GROUND + paint * covered(at, low, high))[None].astype(np.uint8)


def found(picture: NDArray[np.uint8], pixel: int, step: float = 1.0, dark: bool = False) -> tuple[float, bool]:
    """Pixel of the best ridge about `pixel`, and whether it is a line's; the run has samples every `step` px."""
    ridges = run_ridges(picture, np.array([pixel + 0.5]), step, dark)
    return pixel + step * float(ridges.place[0]), bool(ridges.flags[LINE, 0])


@pytest.mark.parametrize("middle", SUB_PIXEL)
def test_a_marking_is_found_to_a_quarter_of_a_sample(middle: float) -> None:
    ridges = ridge_of(around((middle, PER_MARKING)))
    assert ridges.flags[:, 0].tolist() == [True, False]
    assert ridges.place[0] == pytest.approx(middle, abs=0.25)


def test_places_are_right_on_average_and_turn_round_with_the_picture() -> None:
    at = np.linspace(-1.0, 1.0, 41)
    places = np.array([float(ridge_of(around((m, PER_MARKING))).place[0]) for m in at])
    assert (np.diff(places) > -1e-4).all()
    assert places == pytest.approx(-places[::-1], abs=1e-4)
    assert np.sqrt(np.mean((places - at) ** 2)) < 0.15


def test_the_height_is_how_far_the_paint_is_above_the_ground() -> None:
    one, half = ridge_of(around((0.0, PER_MARKING))), ridge_of(0.5 * around((0.0, PER_MARKING)))
    assert one.height[0] == pytest.approx(5 * PAINT, rel=1e-5)  # five samples, all of them paint
    assert half.height[0] == pytest.approx(0.5 * one.height[0])


@pytest.mark.parametrize("breadth", [2.0, 14.0, 40.0])
def test_what_is_too_thin_or_too_broad_is_no_line(breadth: float) -> None:
    assert not ridge_of(around((0.0, breadth))).flags[LINE, 0]


def test_bars_side_by_side_are_bars_and_no_line() -> None:
    bars = [(k * 2.0 * PER_MARKING, float(PER_MARKING)) for k in range(-2, 3)]
    assert ridge_of(around(*bars)).flags[:, 0].tolist() == [False, True]
    assert (LINE, BAR) == (0, 1)


def test_a_uniform_row_and_steps_have_no_ridge() -> None:
    assert not ridge_of(around()).flags.any()
    for place in range(-8, 9):
        for low, high in ((place, 99.0), (-99.0, place)):
            step = around((0.5 * (low + high), high - low))
            assert not ridge_of(step).flags.any(), (low, high)


def test_fainter_than_the_contrast_is_nothing() -> None:
    marking = around((0.0, PER_MARKING)) - GROUND
    assert ridge_of(marking * np.float32(1.05 * CONTRAST / PAINT)).flags[LINE, 0]
    assert not ridge_of(marking * np.float32(0.95 * CONTRAST / PAINT)).flags.any()


@pytest.mark.parametrize("apart", [-14, -5, 0, 6, 14])
@pytest.mark.parametrize("part", SUB_PIXEL)
def test_a_run_finds_the_marking_of_its_row_to_sub_pixel(apart: int, part: float) -> None:
    place, line = found(row(300.0 + apart + part), 300)
    assert line
    assert place == pytest.approx(300.0 + apart + part, abs=0.25)


@pytest.mark.parametrize("step", [0.47, 1.7, 2.55, 4.1])
def test_a_run_has_its_samples_in_the_markings_own_scale(step: float) -> None:
    middles = np.arange(296.0, 304.0, 0.17)
    errors = np.array([found(row(middle, step * PER_MARKING), 300, step)[0] - middle for middle in middles])
    assert np.abs(errors).max() < 0.5 * max(step, 1.0)  # single pixels are read, so edges hop from sample to sample
    assert abs(float(errors.mean())) < 0.1 * max(step, 1.0)  # and no side is preferred
    assert found(row(300.3, step * PER_MARKING), 300, step)[1]
    assert not found(row(300.3, 3.0 * step * PER_MARKING), 300, step)[1]
    assert not found(row(300.3, max(step, 1.0) * PER_MARKING / 3.0), 300, max(step, 1.0))[1]  # of whole pixels


def test_no_marking_beyond_the_gate_is_found() -> None:
    assert found(row(300.0 + GATE), 300)[1]
    assert not found(row(300.0 + GATE + 6), 300)[1]


def test_dark_markings_are_found_by_those_who_look_for_them_alone() -> None:
    dark, bright = row(303.2, paint=-60.0), row(303.2, paint=60.0)
    place, line = found(dark, 300, dark=True)
    assert line
    assert place == pytest.approx(303.2, abs=0.25)
    assert not found(bright, 300, dark=True)[1]
    assert found(bright, 300)[1]
    assert not found(dark, 300)[1]


@pytest.mark.parametrize("dark", [False, True])
def test_uniform_rows_and_edges_give_no_line(dark: bool) -> None:
    flat = np.full((1, WIDTH), 128, np.uint8)
    assert not found(flat, 300, dark=dark)[1]
    for edge in range(285, 316):
        for left, right in ((40, 200), (200, 40)):
            picture = np.where(np.arange(WIDTH) < edge, left, right)[None].astype(np.uint8)
            assert not found(picture, 300, dark=dark)[1], edge


def test_runs_keep_their_order_and_their_rows() -> None:
    picture = np.concatenate([row(100.0 + 50.0 * k + 0.3 * k) for k in range(4)])
    first = np.array([100.5, WIDTH + 150.5, 2 * WIDTH + 200.5, 3 * WIDTH + 250.5])
    ridges = run_ridges(picture, first)
    assert ridges.flags[LINE].all()
    assert ridges.place == pytest.approx(0.3 * np.arange(4), abs=0.25)


@pytest.mark.parametrize(("colour", "weight"), [("blue", (1, 0, 0)), ("green", (0, 1, 0)), ("red", (0, 0, 1))])
def test_a_colour_is_read_from_its_own_channel(colour: str, weight: tuple[int, int, int]) -> None:
    rng = np.random.default_rng(2)
    picture = rng.integers(0, 256, (3, 4, 3)).astype(np.uint8)
    pixels = np.array([[0, 5], [11, 3]])
    wanted = picture.reshape(-1, 3)[pixels] @ np.array(weight)
    assert Brightness(colour, False).read(picture, pixels).tolist() == wanted.tolist()
    assert Brightness(colour, True).read(picture, pixels).tolist() == (-wanted).tolist()


def test_grey_is_the_weighted_sum_of_the_colours_and_reads_no_further_than_the_picture() -> None:
    picture = np.array([[[200, 10, 30], [0, 100, 0], [50, 50, 255]]], np.uint8)  # blue, green, red
    wanted = [round(0.299 * r + 0.587 * g + 0.114 * b) for b, g, r in picture[0].tolist()]
    assert Brightness("grey", False).read(picture, np.array([[-4, 0, 1, 2, 9]]))[0].tolist() == [
        wanted[0],
        *wanted,
        wanted[2],
    ]


def test_the_filter_along_whole_rows_peaks_in_the_middle_of_the_marking() -> None:
    rows = np.concatenate((row(100.0), row(140.0)))[:, :200]
    ridge_filter = RowRidgeFilter(2, 200)
    heights = ridge_filter.heights(rows, 20, 180)
    assert (heights.argmax(axis=1) + 20).tolist() == [100, 140]
    wanted = [
        5.0 * (r[m - 2 : m + 3].mean() - max(r[m - 8 : m - 3].mean(), r[m + 4 : m + 9].mean()))
        for r, m in ((rows[0].astype(float), 100), (rows[1].astype(float), 143))
    ]
    assert [heights[0, 80], heights[1, 123]] == pytest.approx(wanted)
    ridges = ridge_filter.measure(rows, np.array([0, 1, 1]), np.array([101, 139, 60]), least(2))
    assert ridges.place[:2] == pytest.approx([-1.0, 1.0], abs=0.25)
    assert ridges.flags[LINE].tolist() == [True, True, False]


@pytest.mark.parametrize("noise", [4.0, 20.0])
def test_the_threshold_of_a_run_is_that_of_its_ends(noise: float) -> None:
    rng, k = np.random.default_rng(3), 40
    values = rng.normal(100.0, noise, (2 * k, 2 * REACH + 1)).astype(np.float32)
    bare = run_thresholds(values, 1.0)
    values[:, REACH - 3 : REACH + 4] += 90.0
    np.testing.assert_allclose(run_thresholds(values, 1.0), bare, rtol=1e-5)
    assert bare.mean() == pytest.approx(MEDIAN * math.sqrt(WINDOW) * noise, rel=0.1)
    assert run_thresholds(np.zeros_like(values), 1.0) == pytest.approx(LEVEL)
