"""Evidence for a calibrated pair: derivatives against constructed turns, and rigs that are right, exchanged, turned."""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest

from automodel.geometry import GroundCamera
from automodel.geometry.stereo_rig import Eye, StereoRig, image_of
from automodel.perception.stereo.pair_evidence import (
    Corners,
    Matches,
    PairEvidence,
    _at_parallax,
    _Seen,
    _wrong,
    find_corners,
    match_corners,
    weigh,
)
from tests.support.patterned_wall import parallel, wall
from tests.support.stereo_pictures import mirror_cameras

KNOWN_RAD, ANY_RAD = math.radians(0.2), math.radians(3.0)


def level(ahead_m: np.ndarray) -> np.ndarray:
    """A ground that is known to 5 cm everywhere."""
    return np.full(len(ahead_m), 0.05)


def evidence(rig: StereoRig, left: np.ndarray, right: np.ndarray) -> PairEvidence:
    matches = match_corners(find_corners(left), find_corners(right))
    return weigh(rig, matches, level, KNOWN_RAD, ANY_RAD)


def turned(camera: GroundCamera, axis: int, by_rad: float) -> GroundCamera:
    """The camera after a turn about an axis of the body frame."""
    across = np.roll(np.eye(3), -axis, axis=0)[1:]
    turn = np.eye(3) + math.sin(by_rad) * (np.outer(across[1], across[0]) - np.outer(across[0], across[1]))
    turn += (math.cos(by_rad) - 1.0) * (np.outer(across[0], across[0]) + np.outer(across[1], across[1]))
    there = copy.copy(camera)
    there.cam_from_body = camera.cam_from_body @ turn.T
    return there


def seen_points(rig: StereoRig) -> Matches:
    rng = np.random.default_rng(2)
    points = np.column_stack((rng.uniform(5, 30, 40), rng.uniform(-3, 3, 40), rng.uniform(0, 2, 40)))
    left, right = (np.array([image_of(Eye.of(eye), *point) for point in points]) for eye in (rig.left, rig.right))
    return Matches(left, right, np.arange(40))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_what_a_turn_does_to_matches_is_its_derivative(axis: int) -> None:
    rig, by_rad = mirror_cameras(), 1e-5
    matches = seen_points(rig)

    def as_seen(right: GroundCamera) -> _Seen:
        return _Seen.of(rig.left, right, rig.middle_m, matches, level)

    before, more, less = (as_seen(turned(rig.right, axis, by)) for by in (0.0, by_rad, -by_rad))
    np.testing.assert_allclose(before.off_px, 0.0, atol=1e-4)
    for name in ("off_px", "parallax_px"):
        found = (getattr(more, name) - getattr(less, name)) / (2.0 * by_rad)
        expected = getattr(before, name.replace("_px", "_per_rad"))[:, axis]
        np.testing.assert_allclose(found, expected, rtol=1e-3, atol=0.05)


def test_a_right_match_is_likelier_on_the_ground_than_anywhere_and_not_below_it() -> None:
    def density(parallax_px: float) -> float:
        return float(_at_parallax(parallax_px, 40.0, 2.0, 1.0, 640.0))

    assert density(40.0) > 5.0 * density(20.0) > 0.0
    assert density(60.0) < 1e-6 * density(40.0)
    assert density(-10.0) < 1e-6 * density(0.0)  # behind the cameras

    def wrong(parallax_px: float) -> float:
        return float(_wrong(parallax_px, 640.0))

    far, near = (float(_at_parallax(x, math.inf, 1.0, 1.0, 640.0)) * wrong(x) for x in (0.0, 60.0))
    assert far == pytest.approx(near, rel=0.05)  # a wall may stand anywhere


def test_the_calibrated_pair_is_the_likeliest() -> None:
    found = evidence(parallel(), *wall())
    assert found.matched > 50
    assert found.exchanged < -20.0
    assert found.turned < 0.0


def test_exchanged_images_tell() -> None:
    left, right = wall()
    assert evidence(parallel(), right, left).exchanged > 20.0


@pytest.mark.parametrize("pitch_rad", [-0.035, 0.025])
def test_a_turned_camera_tells_and_by_how_much(pitch_rad: float) -> None:
    found = evidence(parallel(pitch_rad), *wall(seed=4))
    assert found.turned > 20.0
    assert found.exchanged < 5.0
    assert found.turned_rad[1] == pytest.approx(-pitch_rad, abs=0.005)


def test_an_error_of_the_calibration_is_no_other_pair() -> None:
    found = evidence(parallel(KNOWN_RAD), *wall(seed=5))
    assert found.turned < 0.0


def test_nothing_to_see_speaks_for_nothing() -> None:
    grey = np.full((360, 640), 90, np.uint8)
    assert len(find_corners(grey).pixels) == 0
    for left, right in ((grey, grey), (grey, wall()[1]), (wall()[0], grey)):
        found = evidence(parallel(), left, right)
        assert (found.matched, found.exchanged, found.turned) == (0, 0.0, 0.0)


def test_noise_speaks_for_nothing() -> None:
    rng = np.random.default_rng(6)
    left, right = (rng.normal(100, 3, (360, 640)).astype(np.uint8) for _ in range(2))
    found = evidence(parallel(), left, right)
    assert max(found.exchanged, found.turned) < 5.0


def test_corners_that_look_alike_are_all_candidates() -> None:
    looks = np.zeros((3, 32), np.uint8)
    looks[2] = 255
    one = Corners(np.array([[10.0, 10.0], [20.0, 20.0], [30.0, 30.0]]), looks)
    matches = match_corners(one, one)
    assert matches.corner.tolist() == [0, 0, 1, 1, 2]
    assert {tuple(px) for px in matches.other_px[:2]} == {(10.0, 10.0), (20.0, 20.0)}
