"""A lane from line integrals, on images of roads whose lane is known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from automodel.perception.rows.brightness import Brightness
from automodel.perception.rows.lane_pair_search import FittedLane, LaneSearchConfig, LineIntegralSearch
from tests.support.highway_pictures import DASHES, DOTS, LANE_M, SOLID, Line, camera_model, draw, lane, mounted

HIGHWAY = LaneSearchConfig(lane_width_m=LANE_M, marking_m=0.12, reference_x_m=1.4, radius_lanes=50.0, taper=0.02)


class Counting(Brightness):
    """Remembers which pixels were read."""

    def __init__(self) -> None:
        self.seen: set[int] = set()
        super().__init__("grey", False)
        self.seen.clear()  # what was read to compile

    def read(self, image, pixels):
        self.seen.update(np.unique(np.clip(pixels, 0, image.size - 1)).tolist())
        return super().read(image, pixels)


def start(picture: np.ndarray, dark: bool = False) -> FittedLane | None:
    return LineIntegralSearch(mounted(), HIGHWAY).step(picture, Brightness("grey", dark))


def off_m(found: FittedLane, x_m: float, heading: float, curvature: float, offset: float = 0.0) -> float:
    """How far the lane's middle is misplaced at body x."""
    ahead = x_m - HIGHWAY.reference_x_m
    offset_m, heading_rad, kappa, _ = found.mean
    y = -offset_m + heading_rad * ahead + 0.5 * kappa * ahead * ahead
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
    assert found.mean[3] == pytest.approx(LANE_M, abs=0.12)
    assert found.mean[0] == pytest.approx(offset - heading * 1.4, abs=0.1)
    assert abs(off_m(found, 10.0, heading, curvature, offset)) < 0.08
    assert abs(off_m(found, 20.0, heading, curvature, offset)) < 0.3


def test_dark_joints_beside_dots_are_no_lines() -> None:
    found = start(draw(mounted(), [*lane(0.2, DOTS, DOTS, 0.4), *CRACKS], 0.01, seed=2))
    assert found is not None
    assert found.mean[0] == pytest.approx(0.2 - 0.014, abs=0.08)
    assert found.mean[3] == pytest.approx(LANE_M, abs=0.12)


def test_a_lane_of_another_width() -> None:
    for width in (3.2, 4.2):
        lines = [Line(0.5 * width, DASHES, 1.0), Line(-0.5 * width)]
        found = start(draw(mounted(), lines, 0.0, seed=1))
        assert found is not None
        assert found.mean[3] == pytest.approx(width, abs=0.1)
        assert found.mean[0] == pytest.approx(0.0, abs=0.06)


def test_faint_paint_is_enough_where_the_road_is_even() -> None:
    found = start(draw(mounted(), lane(0.1, DASHES, DASHES, 2.0, grey=22.0), seed=3))
    assert found is not None
    assert found.mean[0] == pytest.approx(0.1, abs=0.08)


def test_a_bare_road_has_no_lane() -> None:
    for seed in range(6):
        assert start(draw(mounted(), [], seed=seed)) is None
        noise = np.random.default_rng(seed).integers(0, 255, (288, 512)).astype(np.uint8)
        assert start(noise) is None
    assert start(np.zeros((288, 512), np.uint8)) is None


def test_one_line_is_not_taken_for_two() -> None:
    for seed in range(3):
        assert start(draw(mounted(), [Line(-0.5 * LANE_M)], seed=seed)) is None


def test_the_start_reads_less_than_12_percent() -> None:
    busy = draw(mounted(), [*lane(0.2, DOTS, DASHES), *NEXT])
    for picture in (busy, np.zeros_like(busy), np.random.default_rng(1).integers(0, 255, busy.shape).astype(np.uint8)):
        counting = Counting()
        LineIntegralSearch(mounted(), HIGHWAY).step(picture, counting)
        assert 0.03 < len(counting.seen) / picture.size < 0.12


def test_what_is_read_does_not_grow_with_the_picture() -> None:
    shares = []
    for width, height, focal in ((512, 288, 450.0), (1024, 576, 900.0)):
        camera = mounted(camera_model(width, height, focal))
        counting = Counting()
        LineIntegralSearch(camera, HIGHWAY).step(np.zeros((height, width), np.uint8), counting)
        shares.append(len(counting.seen) / (width * height))
    assert shares[1] < 0.45 * shares[0]


def test_a_camera_that_looks_over_the_road_is_refused() -> None:
    with pytest.raises(ValueError, match="pitch_rad"):
        LineIntegralSearch(mounted(pitch_rad=-0.8), HIGHWAY)


def test_dark_lines_on_a_bright_floor() -> None:
    picture = 255 - draw(mounted(), lane(0.3), seed=1)
    found = start(picture, dark=True)
    assert found is not None
    assert found.mean[0] == pytest.approx(0.3, abs=0.06)
