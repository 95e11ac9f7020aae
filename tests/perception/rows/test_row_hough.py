"""A lane from nothing, on images of roads whose lane is known."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from automodel.perception.rows.brightness import Brightness
from automodel.perception.rows.lane_pair_search import InitialLane, LaneSearchConfig, LineIntegralSearch
from automodel.perception.rows.row_hough import RowHough, accumulate, best_pair, best_single, row_peaks, row_votes
from tests.support.highway_pictures import DASHES, DOTS, LANE_M, SOLID, Line, camera_model, draw, lane, mounted

HIGHWAY = LaneSearchConfig(lane_width_m=LANE_M, marking_m=0.12, reference_x_m=1.4, radius_lanes=50.0)
SCALE = LaneSearchConfig(lane_width_m=0.4, marking_m=0.03, reference_x_m=0.13, radius_lanes=1.4)


class Counting(Brightness):
    """Remembers which pixels were read."""

    def __init__(self) -> None:
        super().__init__("grey", False)
        self.seen: set[int] = set()

    def read(self, image, pixels):
        self.seen.update(np.unique(np.clip(pixels, 0, image.size - 1)).tolist())
        return super().read(image, pixels)


def start(picture: np.ndarray, config: LaneSearchConfig = HIGHWAY, camera=None) -> InitialLane | None:
    return RowHough(camera or mounted(), config, Brightness("grey", False)).step(picture)


def off_m(found: InitialLane, x_m: float, heading: float, curvature: float, offset: float = 0.0) -> float:
    """How far the lane's middle is misplaced at body x."""
    ahead = x_m - HIGHWAY.reference_x_m
    y = -found.offset_m + found.heading_rad * ahead + 0.5 * found.curvature_per_m * ahead * ahead
    return y - (heading * x_m + 0.5 * curvature * x_m * x_m - offset)


CRACKS = [Line(0.5 * LANE_M + 0.35, SOLID, 0.0, 0.05, -35.0), Line(-0.5 * LANE_M - 0.35, SOLID, 0.0, 0.05, -35.0)]
NEXT = [Line(1.5 * LANE_M, SOLID), Line(-1.5 * LANE_M, DASHES)]


@pytest.mark.parametrize("patterns", [(SOLID, SOLID), (DASHES, SOLID), (DASHES, DASHES), (DOTS, SOLID), (DOTS, DOTS)])
@pytest.mark.parametrize(
    ("offset", "heading", "curvature"), [(0.0, 0.0, 0.0), (0.6, 0.03, 0.001), (-0.7, -0.05, -0.003), (0.3, 0.0, 0.004)]
)
def test_dashes_and_dots_make_a_lane(patterns, offset: float, heading: float, curvature: float) -> None:
    lines = [
        *lane(offset, patterns[0], patterns[1], phase_m=3.1),
        *[dataclasses.replace(n, offset_m=n.offset_m - offset) for n in NEXT],
    ]
    found = start(draw(mounted(), lines, heading, curvature, seed=4))
    assert found is not None
    assert found.pair
    assert found.fitted
    assert found.width_m == pytest.approx(LANE_M, abs=0.12)
    assert found.offset_m == pytest.approx(offset - heading * 1.4, abs=0.1)
    assert abs(off_m(found, 10.0, heading, curvature, offset)) < 0.08
    assert abs(off_m(found, 20.0, heading, curvature, offset)) < 0.3


def test_dark_joints_beside_dots_are_no_lines() -> None:
    found = start(draw(mounted(), [*lane(0.2, DOTS, DOTS, 0.4), *CRACKS], 0.01, seed=2))
    assert found is not None
    assert found.offset_m == pytest.approx(0.2 - 0.014, abs=0.08)
    assert found.width_m == pytest.approx(LANE_M, abs=0.12)


def test_a_lane_of_another_width() -> None:
    for width in (3.2, 4.2):
        lines = [Line(0.5 * width, DASHES, 1.0), Line(-0.5 * width)]
        found = start(draw(mounted(), lines, 0.0, seed=1))
        assert found is not None
        assert found.width_m == pytest.approx(width, abs=0.1)
        assert found.offset_m == pytest.approx(0.0, abs=0.06)


def test_faint_paint_is_enough_where_the_road_is_even() -> None:
    found = start(draw(mounted(), lane(0.1, DASHES, DASHES, 2.0, grey=22.0), seed=3))
    assert found is not None
    assert found.offset_m == pytest.approx(0.1, abs=0.08)


def test_a_bare_road_has_no_lane() -> None:
    for seed in range(6):
        assert start(draw(mounted(), [], seed=seed)) is None
        noise = np.random.default_rng(seed).integers(0, 255, (288, 512)).astype(np.uint8)
        assert start(noise) is None
    assert start(np.zeros((288, 512), np.uint8)) is None


def test_one_line_is_not_taken_for_two() -> None:
    for seed in range(3):
        found = start(draw(mounted(), [Line(-0.5 * LANE_M)], seed=seed))
        assert found is not None
        assert not found.fitted
        assert found.offset_m == pytest.approx(0.0, abs=0.4)  # the car keeps about a lane's middle


def test_the_start_reads_less_than_12_percent() -> None:
    busy = draw(mounted(), [*lane(0.2, DOTS, DASHES), *NEXT])
    for picture in (busy, np.zeros_like(busy), np.random.default_rng(1).integers(0, 255, busy.shape).astype(np.uint8)):
        counting = Counting()
        RowHough(mounted(), HIGHWAY, counting).step(picture)
        assert 0.03 < len(counting.seen) / picture.size < 0.12


def test_what_is_read_does_not_grow_with_the_picture() -> None:
    shares = []
    for width, height, focal in ((512, 288, 450.0), (1024, 576, 900.0)):
        camera = mounted(camera_model(width, height, focal))
        counting = Counting()
        RowHough(camera, HIGHWAY, counting).step(np.zeros((height, width), np.uint8))
        shares.append(len(counting.seen) / (width * height))
    assert shares[1] < 0.45 * shares[0]


def test_tight_bends_have_no_line_sums() -> None:
    camera = mounted(camera_model(640, 360, 480.0), z_m=0.18, pitch_rad=0.26, x_m=0.2)
    assert RowHough(camera, SCALE, Brightness("grey", False))._integrals is None
    assert isinstance(RowHough(mounted(), HIGHWAY, Brightness("grey", False))._integrals, LineIntegralSearch)


@pytest.mark.parametrize(("curvature", "offset"), [(0.0, 0.03), (0.5, 0.0), (-0.6, -0.04)])
def test_a_scale_car_s_bend(curvature: float, offset: float) -> None:
    camera = mounted(camera_model(640, 360, 480.0), z_m=0.18, pitch_rad=0.26, x_m=0.2)
    lines = [Line(0.2 - offset, width_m=0.03), Line(-0.2 - offset, width_m=0.03)]
    found = start(draw(camera, lines, 0.0, curvature), SCALE, camera)
    assert found is not None
    assert found.pair
    assert not found.fitted
    ahead = found.measured_at_m
    y = -found.offset_m + found.heading_rad * ahead + 0.5 * found.curvature_per_m * ahead * ahead
    x = ahead + SCALE.reference_x_m
    assert y == pytest.approx(0.5 * curvature * x * x - offset, abs=0.035)


def test_a_camera_that_looks_over_the_road_is_refused() -> None:
    with pytest.raises(ValueError, match="pitch_rad"):
        RowHough(mounted(pitch_rad=-0.8), HIGHWAY, Brightness("grey", False))


def test_both_polarities_stay_with_the_one_that_makes_lines() -> None:
    light = draw(mounted(), lane(0.3), seed=1)
    search = RowHough(mounted(), HIGHWAY, Brightness("grey", False), both=True)
    for picture, dark in ((255 - light, True), (light, False), (255 - light, True)):
        for _ in range(2):
            found = search.step(picture)
            assert found is not None
            assert found.dark is dark
            assert found.offset_m == pytest.approx(0.3, abs=0.06)


def test_dark_lines_on_a_bright_floor() -> None:
    picture = 255 - draw(mounted(), lane(0.3), seed=1)
    found = RowHough(mounted(), HIGHWAY, Brightness("grey", True)).step(picture)
    assert found is not None
    assert found.offset_m == pytest.approx(0.3, abs=0.06)
    assert math.isfinite(found.edge)


LATERAL = np.linspace(-1.0, 1.0, 21)
FEWEST, OFF, UNIT = 6, 3.0, 0.8


def table(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Votes for lines (4, 5, 21), and what each curvature and heading loses, and where the car is on its axis."""
    rng = np.random.default_rng(seed)
    lines = rng.integers(0, 12, (4, 5, len(LATERAL))).astype(np.int32)
    return lines, rng.uniform(0.0, 4.0, (4, 5)), rng.uniform(-0.2, 0.2, (4, 5))


def test_peaks_are_the_highest_around_them_and_above_the_least() -> None:
    height = np.array([[0, 5, 9, 5, 0, 0, 7, 7, 0], [3, 0, 0, 0, 8, 0, 0, 0, 2]], np.int32)
    within = np.ones(height.shape, bool)
    row, column = row_peaks(height, within, np.full(2, 2.5, np.float32), 3)
    assert list(zip(row.tolist(), column.tolist(), strict=True)) == [(0, 2), (0, 6), (0, 7), (1, 0), (1, 4)]
    within[1, 4] = False
    assert len(row_peaks(height, within, np.full(2, 2.5, np.float32), 3)[0]) == 4
    assert len(row_peaks(height, within, np.full(2, 9.0, np.float32), 3)[0]) == 0


def test_ridges_vote_about_their_place_and_nowhere_else() -> None:
    said = row_votes(np.array([0, 1]), np.array([4.4, 9.0]), np.array([2, 3]), 2, 10)
    assert said[:10].tolist() == [0, 0, 1, 1, 1, 1, 1, 0, 0, 0]
    assert said[10:].tolist() == [0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 0]


def test_lines_sum_what_their_rows_say() -> None:
    rng = np.random.default_rng(1)
    said = rng.integers(0, 3, 41).astype(np.int32)
    places = rng.integers(0, 41, (4, 2, 3, 5)).astype(np.int32)
    assert (accumulate(said, places) == said[places].sum(axis=0)).all()


@pytest.mark.parametrize("seed", range(5))
def test_the_best_pair_is_the_best_of_all(seed: int) -> None:
    lines, loss, aside = table(seed)
    apart, width_loss = np.array([6, 8, 10]), np.array([1.0, 0.0, 1.5])
    totals = {}
    for c, h, a, w in np.ndindex(*lines.shape, len(apart)):
        left = a + int(apart[w])
        if left < len(LATERAL) and min(lines[c, h, a], lines[c, h, left]) >= FEWEST:
            middle = 0.5 * (LATERAL[a] + LATERAL[left])
            if abs(aside[c, h] - middle) <= 0.5 * (LATERAL[left] - LATERAL[a]):
                lost = loss[c, h] + OFF * (aside[c, h] - middle) ** 2 + width_loss[w]
                totals[c, h, a, w] = float(lines[c, h, a] + lines[c, h, left] - lost)
    score, c, h, a, w = best_pair(lines, FEWEST, loss, aside, LATERAL, apart, width_loss, OFF)
    assert (c, h, a, w) == max(totals, key=totals.__getitem__)
    assert score == pytest.approx(totals[c, h, a, w])
    assert best_pair(lines, 99, loss, aside, LATERAL, apart, width_loss, OFF)[0] == -np.inf


@pytest.mark.parametrize("seed", range(5))
def test_the_best_single_line_is_the_best_of_all(seed: int) -> None:
    lines, loss, aside = table(seed)
    distance = LATERAL - aside[..., None]
    offset = np.where(distance > 0.0, 0.5 * UNIT - distance, -0.5 * UNIT - distance)
    total = np.where(
        (lines >= FEWEST) & (np.abs(offset) <= 0.45 * UNIT), lines - loss[..., None] - OFF * offset**2, -np.inf
    )
    score, c, h, a, side = best_single(lines, FEWEST, loss, aside, LATERAL, 0.5 * UNIT, 0.45 * UNIT, OFF)
    assert total[c, h, a] == total.max()
    assert score == pytest.approx(float(total.max()))
    assert side == (1 if distance[c, h, a] > 0.0 else -1)
    assert best_single(lines, 99, loss, aside, LATERAL, 0.5 * UNIT, 0.45 * UNIT, OFF)[0] == -np.inf
