"""Stripes, epipolar matches and the ground plane of drawn pairs, from cameras that are neither parallel nor alike."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from automodel.config import Extrinsics
from automodel.estimation.parabola.plane_filter import PlaneFilter
from automodel.geometry import GroundCamera
from automodel.geometry.stereo_rig import Plane, StereoRig, on_ground
from automodel.perception.stereo.ground_plane import PlaneFit, fit_plane
from automodel.perception.stereo.matching import Matches, match, midpoint, mirrored, witnesses
from automodel.perception.stereo.reconstruction import log_odds, radial
from automodel.perception.stereo.stripes import Stripes, StripeSearch, median
from tests.support.highway_pictures import LANE_M, Line, camera_model, draw, mounted
from tests.support.stereo_pictures import LINES, draw_pair, mirror_cameras, straight_ahead

RIG = mirror_cameras()
NOISE_PX = 0.5
LEVEL_PLANE = Plane()


def look(rig: StereoRig, pair: tuple[np.ndarray, ...], plane: Plane = LEVEL_PLANE) -> list[Stripes]:
    height, width = pair[0].shape
    search = StripeSearch(0.12, LANE_M, 1.6, 0.0, (height, width), rows=128)
    return [search.look(image, eye, straight_ahead(rig)) for image, eye in zip(pair, rig.over(plane), strict=True)]


def measure(rig: StereoRig, pair: tuple[np.ndarray, ...], known: PlaneFilter) -> tuple[Matches, PlaneFit]:
    left, right = look(rig, pair, known.plane)
    sigma = known.height_sigma_m(on_ground(left.eye, left.directions) - rig.middle_m[:2])
    matches = match(left, right, sigma, NOISE_PX)
    eyes_m = np.stack((left.eye.centre_m, right.eye.centre_m))
    return matches, fit_plane(matches, eyes_m, rig.middle_m, known.covariance, NOISE_PX, 0.2)


def settled(rig: StereoRig, pair: tuple[np.ndarray, ...], frames: int = 5) -> PlaneFilter:
    known = PlaneFilter(float(rig.middle_m[2]))
    for _ in range(frames):
        known.predict(0.05)
        fit = measure(rig, pair, known)[1]
        known.update(fit.step, fit.covariance)
    return known


def test_stripes_lie_on_the_lines() -> None:
    for stripes in look(RIG, draw_pair(RIG)):
        ground = on_ground(stripes.eye, stripes.directions)
        away = np.abs(ground[:, 1][:, None] - np.array([line.offset_m for line in LINES])).min(axis=1)
        near = ground[:, 0] < 20.0
        assert np.count_nonzero(near) > 60
        assert stripes.count >= 2
        assert np.quantile(away[near], 0.9) < 0.06


def test_a_picture_without_paint_has_no_stripes() -> None:
    for stripes in look(RIG, draw_pair(RIG, lines=())):
        assert stripes.count == 0
        assert len(stripes.pixels) == 0


@settings(deadline=None)  # the first example compiles
@given(st.lists(st.floats(0.0, 1e4, width=32), min_size=1, max_size=60))
def test_a_median_lies_between_the_two_middle_values(values: list[float]) -> None:
    sizes = np.array(values, np.float32)
    found, half = np.float32(median(sizes)), len(sizes) // 2
    below, above = np.nextafter(found, np.array((-np.inf, np.inf), np.float32))  # to the last digit
    assert np.count_nonzero(sizes < below) <= half
    assert np.count_nonzero(sizes <= above) >= half


def test_lines_across_the_road_make_no_stripes() -> None:
    """Zebra bars and chevrons lie flat in the image."""
    pair = draw_pair(RIG, lines=())
    for image in pair:
        image[300:306] = 250
        image[360:372] = 250
    assert all(stripes.count == 0 for stripes in look(RIG, pair))


def test_rows_are_read_one_by_one_where_the_road_is_far() -> None:
    rows = look(RIG, draw_pair(RIG))[0].field.rows
    steps = -np.diff(rows)
    assert (len(rows), rows[0]) == (128, 479.0)
    assert (steps[-5:] == 1.0).all()
    assert steps.min() >= 1.0
    assert steps[0] == steps.max() > 2.0
    assert (np.abs(np.diff(steps)) <= 1.0).all()


def test_a_dash_that_is_two_rows_high_is_a_stripe() -> None:
    eye = mounted(camera_model(640, 480, f_px=560.0), z_m=1.15, pitch_rad=0.12)
    search = StripeSearch(0.12, LANE_M, 1.6, 0.0, (480, 640), rows=128)
    dash = draw(eye, [Line(0.5 * LANE_M, pattern=(4.5, 95.5), phase_m=-38.0)], noise=0.0)
    assert (dash[220:, 200:440].max(axis=1) > 125).sum() <= 3
    stripes = search.look(dash, eye, np.geomspace(4.0, 60.0, 80) + 0j)
    assert (stripes.count, len(stripes.pixels)) == (1, 2)
    x, y = on_ground(stripes.eye, stripes.directions).T
    assert ((x > 37.0) & (x < 43.5)).all()
    np.testing.assert_allclose(y, 0.5 * LANE_M, atol=0.1)


def test_a_leaning_dash_is_in_its_middle_where_it_begins_and_ends() -> None:
    eye = mounted(camera_model(640, 480, f_px=560.0), z_m=1.15, pitch_rad=0.12)
    search = StripeSearch(0.15, LANE_M, 1.6, 0.0, (480, 640), rows=128)
    off_m = []
    for phase_m in np.arange(-30.0, -34.0, -0.5):
        dash = draw(eye, [Line(-0.8 * LANE_M, pattern=(15.0, 185.0), phase_m=phase_m, width_m=0.15)], noise=0.0)
        stripes = search.look(dash, eye, np.geomspace(4.0, 60.0, 80) + 0j)
        assert stripes.count == 1
        off_m.append(on_ground(stripes.eye, stripes.directions)[[0, -1], 1] + 0.8 * LANE_M)
    assert np.abs(off_m).max() < 0.025


@pytest.mark.parametrize("gap_m", [0.1, 0.12, 0.15])
def test_a_double_line_is_two_stripes(gap_m: float) -> None:
    """To a wide filter both are one, whose middle is ground."""
    eye = mounted(camera_model(640, 480, f_px=560.0), z_m=1.15, pitch_rad=0.12)
    lines = [Line(0.5 * LANE_M + side * 0.5 * (gap_m + 0.12), width_m=0.12) for side in (-1, 1)]
    search = StripeSearch(0.12, LANE_M, 1.6, 0.0, (480, 640), rows=128)
    stripes = search.look(draw(eye, lines, noise=0.0), eye, np.geomspace(4.0, 40.0, 80) + 0j)
    assert stripes.count == 2
    assert (stripes.width_px > 0.0).all()


@pytest.mark.parametrize("lean", [0.8, 1.2])
def test_arms_that_end_on_a_line_are_no_part_of_it(lean: float) -> None:
    """The chevrons of a gore: their arms lie across and are the wider on a row."""
    eye = mounted(camera_model(640, 480, f_px=560.0), z_m=1.15, pitch_rad=0.12)
    image = draw(eye, [Line(0.5 * LANE_M)], noise=0.0)
    for x in np.arange(5.0, 14.0, 1.5):
        arm = np.array(((x + lean, 1.8), (x + lean + 0.3, 1.8), (x + 0.3, 2.8), (x, 2.8)))
        cv2.fillPoly(image, [np.rint(eye.ground_to_px(arm)).astype(np.int32)], 230)
    search = StripeSearch(0.12, LANE_M, 1.6, 0.0, (480, 640), rows=128)
    stripes = search.look(image, eye, np.geomspace(4.0, 40.0, 80) + 0j)
    away_m = np.abs(on_ground(stripes.eye, stripes.directions)[:, 1] - 0.5 * LANE_M)
    its = [away_m[stripes.stripe == k] for k in range(stripes.count)]
    on_line = [away for away in its if np.median(away) < 0.1]
    assert sum(map(len, on_line)) > 40
    assert np.concatenate(on_line).max() < 0.35  # with an arm 0.9 and 1 m


@pytest.mark.parametrize("between", [0.0, 0.5], ids=["at a ridge", "between two ridges"])
@pytest.mark.parametrize("f_px", [400.0, 1250.0])
def test_a_lone_line_does_not_lean_the_ground(between: float, f_px: float) -> None:
    """A match that is off along its epipolar line lies aside and higher: a slope across that no ground has."""
    rng, known = np.random.default_rng(0), PlaneFilter(float(RIG.middle_m[2])).covariance
    eyes_m, none = np.stack((RIG.left.centre_m, RIG.right.centre_m)), np.zeros(60, np.intp)
    ground = np.column_stack((np.linspace(6.0, 12.0, 60), np.full(60, 1.7), np.zeros(60)))
    variances, rolls_deg = (1.0, between**2 + (1.0 - between) ** 2), []
    per_m = abs(eyes_m[1, 1] - eyes_m[0, 1]) / eyes_m[0, 2] * f_px / ground[:, 0]
    for _ in range(50):
        rays = []
        for eye, variance in zip(eyes_m, variances, strict=True):
            off_m = rng.normal(0.0, math.sqrt(variance), 60) / f_px * ground[:, 0]
            rays.append(ground + np.column_stack((np.zeros(60), off_m, np.zeros(60))) - eye)
        points = np.array([midpoint(eyes_m[0], one, eyes_m[1], other) for one, other in zip(*rays, strict=True)])
        left_share = np.full(60, variances[1] / sum(variances))
        matches = Matches(none, none, np.arange(60), points, points[:, 2] * per_m, per_m, left_share)
        rolls_deg.append(np.degrees(fit_plane(matches, eyes_m, RIG.middle_m, known, 1.0, 1.0).step[2]))
    assert abs(np.mean(rolls_deg)) < 0.1  # by the left rays' places 0.7 to 1.0


def test_stripes_across_are_looked_for_where_the_road_may_turn_so_far() -> None:
    eye = mounted(camera_model(640, 480, f_px=560.0), z_m=1.15, pitch_rad=0.12)
    ahead = draw(eye, [Line(0.3 * LANE_M)], noise=0.0)
    across = draw(eye, [Line(-18.0)], heading_rad=2.0, noise=0.0)  # a slope of 2: 63 degrees
    counts = []
    for turn_rad in (math.inf, 0.1):
        search = StripeSearch(0.12, LANE_M, 1.6, 0.0, (480, 640), rows=128, turn_rad=turn_rad)
        counts.append([search.look(image, eye, np.geomspace(4.0, 40.0, 80) + 0j).count for image in (ahead, across)])
    assert counts[0][0] >= 1
    assert counts[0][1] >= 1
    assert counts[1][0] == counts[0][0]
    assert counts[1][1] == 0


def test_the_midpoint_of_rays_that_meet_is_where_they_meet() -> None:
    point, one, other = np.array((12.0, -1.0, 0.3)), RIG.left.centre_m, RIG.right.centre_m
    np.testing.assert_allclose(midpoint(one, point - one, other, 2.0 * (point - other)), point, atol=1e-9)


def test_the_midpoint_of_skew_rays_is_halfway() -> None:
    """Two rays that cross at right angles, one metre above each other."""
    ahead, aside = np.array((1.0, 0.0, 0.0)), np.array((0.0, 1.0, 0.0))
    middle = midpoint(np.zeros(3), ahead, np.array((5.0, -3.0, 1.0)), aside)
    np.testing.assert_allclose(middle, (5.0, 0.0, 0.5), atol=1e-12)


@pytest.mark.parametrize("turn_rad", [0.0, 1e-15, -1e-15])
def test_a_ridge_matches_a_stripe_once_where_epipolar_lines_run_along_the_rows(turn_rad: float) -> None:
    """Rectified cameras: an epipolar line meets the ridges of its own row, aside of them by rounding alone.

    So do those at the ends of a stripe.
    """
    mounts = (Extrinsics(x_m=1.7, y_m=y, z_m=1.1, pitch_rad=0.1 + y * turn_rad) for y in (0.3, -0.3))
    lens = mirror_cameras(distortion=0.0).left.camera
    level = StereoRig(*(GroundCamera(lens, mount) for mount in mounts))
    pair = draw_pair(level)
    left, right = look(level, pair)
    known_m = np.full(len(left.stripe), 0.02)
    matches = match(left, right, known_m, NOISE_PX)
    pairs = np.column_stack((matches.ridge, matches.right))
    assert len(np.unique(pairs, axis=0)) == len(pairs)
    rows = {(stripe, row) for stripe, row in zip(right.stripe.tolist(), right.pixels[:, 1].tolist(), strict=True)}
    partner = dict(zip(left.stripe[matches.ridge].tolist(), matches.right.tolist(), strict=True))
    both = [(partner.get(s), v) in rows for s, v in zip(left.stripe.tolist(), left.pixels[:, 1].tolist(), strict=True)]
    assert np.count_nonzero(both) > 100
    assert np.isin(np.flatnonzero(both), matches.ridge).mean() > 0.95
    assert (witnesses(left, right, pair, known_m, NOISE_PX)[both] >= 0).mean() > 0.95


def test_matches_lie_on_the_lines_in_space() -> None:
    matches, fit = measure(RIG, draw_pair(RIG), PlaneFilter(float(RIG.middle_m[2])))
    points = matches.points_m[fit.inliers]
    assert len(points) > 100
    near = points[points[:, 0] < 15.0]
    assert np.abs(near[:, 2]).mean() < 0.02
    away = np.abs(near[:, 1][:, None] - np.array([line.offset_m for line in LINES])).min(axis=1)
    assert away.mean() < 0.02
    assert fit.residual_px < 1.0


@pytest.mark.parametrize(
    "plane",
    [
        Plane(),
        Plane(height_m=0.05),
        Plane(height_m=-0.05),
        Plane(pitch_rad=np.radians(2.0)),
        Plane(pitch_rad=np.radians(-2.0)),
        Plane(roll_rad=np.radians(1.0)),
        Plane(height_m=0.03, pitch_rad=np.radians(-1.0), roll_rad=np.radians(-1.0)),
    ],
)
def test_the_plane_is_recovered(plane: Plane) -> None:
    found = settled(RIG, draw_pair(RIG, plane)).plane
    assert found.height_m == pytest.approx(plane.height_m, abs=0.005)
    assert np.degrees(found.pitch_rad) == pytest.approx(np.degrees(plane.pitch_rad), abs=0.02)
    assert np.degrees(found.roll_rad) == pytest.approx(np.degrees(plane.roll_rad), abs=0.02)


def test_a_bend_and_a_heading_do_not_move_the_plane() -> None:
    found = settled(RIG, draw_pair(RIG, heading_rad=0.04, curvature_per_m=0.003)).plane
    np.testing.assert_allclose(found[1:], 0.0, atol=np.radians(0.3))


def test_a_stripe_above_the_ground_is_no_part_of_the_plane() -> None:
    """The upper edge of a guard rail: straight, bright, parallel to the road, and 0.6 m above it."""
    rail = tuple(
        draw_pair(RIG, Plane(height_m=-0.6), lines=(Line(-1.4 * LANE_M, width_m=0.06, grey=120.0),), noise=0.0, seed=5)
    )
    pair = tuple(np.maximum(road, high) for road, high in zip(draw_pair(RIG), rail, strict=True))
    known = settled(RIG, pair)
    np.testing.assert_allclose(known.plane[1:], 0.0, atol=np.radians(0.3))
    matches, fit = measure(RIG, pair, known)
    high = matches.points_m[:, 2] > 0.3
    assert not fit.inliers[high].any()


def test_no_match_leaves_the_plane_where_it_was() -> None:
    known = PlaneFilter(float(RIG.middle_m[2]))
    before = known.covariance.copy()
    matches, fit = measure(RIG, draw_pair(RIG, lines=()), known)
    assert len(matches.ridge) == 0
    assert np.isnan(fit.residual_px)
    np.testing.assert_array_equal(fit.step, 0.0)
    np.testing.assert_allclose(fit.covariance, before, rtol=1e-9)


def test_the_plane_gets_less_certain_with_time_but_no_less_than_at_the_start() -> None:
    known = PlaneFilter(1.2)
    start = known.covariance.copy()
    known.update(np.array((0.01, 0.002, 0.0)), 1e-6 * np.eye(3))
    known.predict(0.05)
    grown = known.covariance.copy()
    assert (np.diag(grown) > 1e-6).all()
    assert (np.diag(grown) < np.diag(start)).all()
    known.predict(10.0)
    np.testing.assert_allclose(known.covariance, start)


def test_how_far_a_plane_is_from_the_calibrated_one() -> None:
    """Samples of a body's walk about the calibrated plane: chi-square of three degrees of freedom, whose mean is 3."""
    plane_filter = PlaneFilter(1.0)
    assert plane_filter.off_calibration == 0.0
    sigmas = np.sqrt(np.diag(plane_filter.covariance))
    rng = np.random.default_rng(0)
    found = []
    for sample in rng.normal(size=(4000, 3)) * sigmas:
        plane_filter.reset()
        plane_filter.update(sample, np.zeros((3, 3)))
        found.append(plane_filter.off_calibration)
    assert np.mean(found) == pytest.approx(3.0, rel=0.1)
    plane_filter.update(np.zeros(3), np.diag(sigmas**2))  # as uncertain again
    assert plane_filter.off_calibration == pytest.approx(0.5 * found[-1])
    plane_filter.reset()
    plane_filter.update(np.array((0.0, 6.0 * sigmas[1], 0.0)), np.zeros((3, 3)))
    assert plane_filter.off_calibration == pytest.approx(36.0)


def test_what_nothing_measures_returns_to_the_calibration_unless_it_is_held() -> None:
    known = PlaneFilter(1.2)
    known.update(np.array((0.01, 0.002, 0.0)), 1e-6 * np.eye(3))
    known.predict(10.0, held=True)
    assert known.plane == Plane(0.01, 0.002, 0.0)
    known.predict(10.0)
    np.testing.assert_allclose(known.plane, 0.0, atol=1e-8)


def said_of(one: Stripes, other: Stripes, images: tuple[np.ndarray, ...]) -> np.ndarray:
    """What the other image says of the ridges of one, on ground that is known to two centimetres."""
    return witnesses(one, other, (images[0], images[1]), np.full(len(one.stripe), 0.02), NOISE_PX)


def test_paint_on_the_ground_is_borne_out_by_the_other_camera() -> None:
    pair = draw_pair(RIG)
    eyes = look(RIG, pair)
    for k in (0, 1):
        said = said_of(eyes[k], eyes[1 - k], (pair[k], pair[1 - k]))
        assert np.count_nonzero(said > 0) > 10 * np.count_nonzero(said < 0)
        assert np.count_nonzero(said > 0) > 30
        assert (log_odds(eyes[k], said) >= 0.0).all()


def test_what_one_camera_alone_shows_in_the_common_view_is_no_paint() -> None:
    """The right image is another road's: its lines lie elsewhere."""
    one, other = draw_pair(RIG, lines=(Line(0.0),)), draw_pair(RIG, lines=(Line(-0.9 * LANE_M),))
    left, right = look(RIG, one)[0], look(RIG, other)[1]
    said = said_of(left, right, (one[0], other[1]))
    assert np.count_nonzero(said < 0) > 30
    assert (log_odds(left, said) < 0.0).all()


def test_paint_that_the_other_image_shows_without_a_ridge_is_not_refused() -> None:
    """A dash that lies askew in the other image has no ridge there; the paint is bright all the same."""
    pair = draw_pair(RIG)
    left, right = look(RIG, pair)
    right.traces = right.traces._replace(pixels=np.empty((0, 2)), chain=np.empty(0, np.intp))
    said = said_of(left, right, pair)
    near = np.abs(on_ground(left.eye, left.directions)[:, 0] - 6.0) < 6.0
    assert np.count_nonzero(near) > 30
    assert (said[near] == 0).mean() > 0.95


def test_a_kerb_is_no_paint_where_the_other_image_shows_it_at_its_own_height() -> None:
    """Bright in both images, 15 cm above the road."""
    pair = draw_pair(RIG, Plane(height_m=-0.15), lines=(Line(0.5 * LANE_M),))
    left, right = look(RIG, pair)
    said = said_of(left, right, pair)
    assert np.count_nonzero(said < 0) > 20
    assert (log_odds(left, said) < 0.0).all()


def test_what_is_out_of_the_other_view_says_nothing() -> None:
    pair = draw_pair(RIG)
    left, right = look(RIG, pair)
    right.field = right.field._replace(ends=np.full_like(right.field.ends, np.nan))
    said = said_of(left, right, pair)
    np.testing.assert_array_equal(said, 0)
    np.testing.assert_array_equal(log_odds(left, said), 0.0)


def test_a_lamp_that_the_floor_mirrors_looks_the_same_in_both_images() -> None:
    """A streak at the same place of two parallel cameras' images, against a line on the ground."""
    ahead = StereoRig(*(GroundCamera(RIG.left.camera, Extrinsics(x_m=1.7, y_m=y, z_m=1.1)) for y in (0.9, -0.9)))
    pair = draw_pair(ahead, lines=(Line(0.5 * LANE_M),))
    left, right = look(ahead, pair)
    every = np.ones(len(left.stripe), np.bool_)
    assert mirrored(left, every, pair[0], right.eye, pair[1]) < 0.5
    assert mirrored(left, every, pair[0], right.eye, pair[0]) > 0.9


def test_a_mirrored_lamp_is_known_beside_the_paint_that_the_other_image_shows_next_to_it() -> None:
    """A bell of light at the same place of two parallel cameras' images, and in one of them a line on its flank."""
    ahead = StereoRig(*(GroundCamera(RIG.left.camera, Extrinsics(x_m=1.7, y_m=y, z_m=1.1)) for y in (0.9, -0.9)))
    left, right = look(ahead, draw_pair(ahead, lines=(Line(0.5 * LANE_M),)))
    every, rows = np.ones(len(left.stripe), np.bool_), np.arange(480)[:, None]
    middle = np.interp(rows, left.pixels[::-1, 1], left.pixels[::-1, 0])
    width = np.interp(rows, left.pixels[::-1, 1], left.width_px[::-1])
    away = (np.arange(640) - middle) / width
    lamp = (60.0 + 80.0 * np.exp(-2.0 * away**2)).astype(np.uint8)
    beside = np.where((away > 0.5) & (away < 1.6), 230, lamp).astype(np.uint8)
    assert mirrored(left, every, lamp, right.eye, beside) > 0.9
    assert mirrored(left, every, lamp, right.eye, np.full_like(lamp, 60)) < 0.1
    assert mirrored(left, every, lamp, right.eye, np.full_like(lamp, 230)) < 0.1


def test_a_streak_points_to_its_camera() -> None:
    way, foot_m = np.linspace(3.0, 8.0, 12), np.array((1.5, -0.4))
    streak, line = np.column_stack((way, 0.2 * way)), np.column_stack((way, np.full(12, 1.8)))
    shares = radial(np.concatenate((streak, line)) + foot_m, np.repeat((0, 1), 12), foot_m, 0.035)
    assert shares[0] == 1.0
    assert shares[1] < 0.3


@pytest.mark.parametrize("slope", [0.5, 1.0, -1.5])
def test_a_stripe_of_any_direction_is_found(slope: float) -> None:
    """A line that crosses the view ten metres ahead is wider on its rows."""
    line = Line(-10.0 * slope, width_m=0.12 * math.hypot(1.0, slope))
    for stripes in look(RIG, draw_pair(RIG, lines=(line,), heading_rad=slope)):
        assert stripes.count == 1
        ground = on_ground(stripes.eye, stripes.directions)
        assert len(ground) > 5
        np.testing.assert_allclose(ground[:, 1], slope * (ground[:, 0] - 10.0), atol=0.1)
