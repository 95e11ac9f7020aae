"""Solid things: where they are painted, what they hide, and which of their faces show."""

import cv2
import numpy as np
import pytest

from automodel.config import Extrinsics, Intrinsics
from automodel.geometry import CameraModel, GroundCamera
from automodel.training import objects, solids
from automodel.training.cameras import Kind, random_camera
from automodel.training.objects import draw_objects

FOCAL, HEIGHT = 300.0, 0.5


def camera(pitch=0.0, k1=0.0):
    lens = Intrinsics(fx_px=FOCAL, fy_px=FOCAL, cx_px=256.0, cy_px=128.0, distortion=(k1, 0.0, 0.0, 0.0, 0.0))
    return GroundCamera(CameraModel(lens, 512, 256), Extrinsics(x_m=0.0, z_m=HEIGHT, pitch_rad=pitch))


def blank():
    return np.full((256, 512), 120, dtype=np.uint8), np.full((256, 512), 255, dtype=np.uint8)


def test_a_box_hides_exactly_where_a_pinhole_sees_it():
    """A level camera sees a face at depth x as a rectangle: u = cx - f y / x, v = cy + f (height - z) / x."""
    build = solids.Builder(2.0, 0.3)
    build.box((0.0, -0.2, 0.0), (1.0, 0.2, 0.4), 200.0)
    image, mask = blank()
    objects._paint(image, mask, camera(), build.solid(), np.random.default_rng(0))
    left, right = 256 - FOCAL * 0.5 / 2.0, 256 - FOCAL * 0.1 / 2.0
    bottom, top = 128 + FOCAL * HEIGHT / 2.0, 128 + FOCAL * (HEIGHT - 0.4) / 2.0
    wall = np.zeros(mask.shape, dtype=bool)
    wall[round(top) : round(bottom) + 1, round(left) : round(right) + 1] = True
    inside = cv2.erode(wall.astype(np.uint8), np.ones((3, 3))) > 0
    assert (mask[inside] == 0).all()
    below = mask[round(bottom) + 3 :]
    assert (below == 255).all()
    assert (mask[:, : round(left) - 3] == 255).all()
    # Above the rear wall the top shows, as far as its far edge one lane width further on.
    far = 128 + FOCAL * (HEIGHT - 0.4) / 3.0
    assert mask[round((far + top) / 2), round((left + right) / 2)] == 0
    assert mask[round(far) - 4, round((left + right) / 2)] == 255


def test_the_mask_is_cleared_exactly_where_the_box_is_painted():
    build = solids.Builder(2.5, -0.4, 0.5)
    build.box((0.0, -0.2, 0.0), (0.6, 0.2, 0.5), 240.0)
    image, mask = blank()
    objects._paint(image, mask, camera(k1=-0.25), build.solid(), np.random.default_rng(3))
    changed = (image != 120).astype(np.uint8)
    hidden = (mask == 0).astype(np.uint8)
    assert hidden.sum() > 1000
    kernel = np.ones((3, 3), np.uint8)
    assert not (cv2.erode(hidden, kernel) & ~changed & 1).sum() > 0.02 * hidden.sum()
    assert not (cv2.erode(changed, kernel) > hidden).any()


def test_every_face_of_a_box_looks_away_from_its_middle():
    for inset in ((0.0, 0.0, 0.0), (0.1, 0.2, 0.05)):
        faces = solids.box_faces((1.0, -0.5, 0.1), (2.5, 0.7, 0.9), inset)
        middle = np.array([1.75, 0.1, 0.5])
        assert set(faces) == {"rear", "front", "left", "right", "top"}
        for name, quad in faces.items():
            normal = np.cross(quad[1] - quad[0], quad[3] - quad[0])
            assert normal @ (quad.mean(axis=0) - middle) > 0, name
        assert faces["rear"].mean(axis=0)[0] < 1.3
        assert faces["left"].mean(axis=0)[1] > 0.5


def test_faces_turned_away_are_not_painted():
    build = solids.Builder(2.0, 0.0)
    faces = solids.box_faces((0.0, -0.3, 0.0), (1.0, 0.3, 0.8))
    build.face(faces["rear"], 0.0)
    build.face(faces["front"], 255.0)  # painted last: it would cover the rear
    image, mask = blank()
    objects._paint(image, mask, camera(), build.solid(), np.random.default_rng(5))
    assert (mask == 0).any()
    assert image.max() <= 130


def test_a_part_of_a_face_lies_where_its_shares_say():
    build = solids.Builder(0.0, 0.0)
    build.face([(0, 0, 0), (4, 0, 0), (4, 2, 0), (0, 2, 0)], 1.0, (0.25, 0.5, 0.5, 1.0))
    quad = build.solid().quads[0]
    np.testing.assert_allclose(quad[:, :2], [(1, 1), (2, 1), (2, 2), (1, 2)])


@pytest.mark.parametrize("make", [solids.car, solids.truck, solids.carton, solids.table])
def test_things_stand_on_the_ground_at_their_place(make):
    for seed in range(10):
        quads = make(np.random.default_rng(seed), 5.0, -1.0, 0.0).quads
        assert quads[..., 2].min() == pytest.approx(0.0, abs=0.02)
        assert 0.05 < quads[..., 2].max() < 3.0
        assert quads[..., 0].min() == pytest.approx(5.0, abs=0.05)
        assert np.isfinite(quads).all()


@pytest.mark.parametrize("k1", [0.0, -0.3])
def test_objects_only_take_mask_away_and_only_where_they_are(k1):
    kernel = np.ones((5, 5), np.uint8)
    for seed in range(60):
        image, mask = blank()
        draw_objects(image, mask, camera(0.2, k1), np.random.default_rng(seed), 12.0)
        assert set(np.unique(mask)) <= {0, 255}
        brighter = cv2.erode((image > 175).astype(np.uint8), kernel)  # shade only darkens, reflections are faint
        assert (mask[brighter > 0] > 0).sum() <= 3, seed  # where two smoothed edges meet


def test_objects_repeat_for_one_seed():
    for seed in range(20):
        first, second = blank(), blank()
        for pair in (first, second):
            draw_objects(pair[0], pair[1], camera(0.2), np.random.default_rng(seed), 8.0)
        np.testing.assert_array_equal(first[0], second[0])
        np.testing.assert_array_equal(first[1], second[1])


def test_some_images_stay_empty_and_the_lane_mostly_free():
    empty, ahead = 0, []
    for seed in range(200):
        image, mask = blank()
        draw_objects(image, mask, camera(0.2), np.random.default_rng(seed), 10.0)
        empty += int((image == 120).all())
        u, v = np.rint(camera(0.2).ground_to_px([[1.5, 0.5], [1.5, -0.5], [3.0, 0.5], [3.0, -0.5]])).astype(int).T
        ahead.append((mask[v, u] == 0).mean())
    assert 20 < empty < 90
    assert 0.02 < np.mean(ahead) < 0.3


def test_walls_beside_the_camera_are_cut_where_it_stops_seeing():
    for seed in range(30):
        image, mask = blank()
        wall = solids.wall(np.random.default_rng(seed), -3.0, 0.9, 0.0, 30.0)
        objects._paint(image, mask, camera(0.1), wall, np.random.default_rng(seed))
        assert (mask[:, 256:] == 255).all()  # all of it is to the left


def test_a_solid_without_faces_has_no_polygons() -> None:
    camera = random_camera(np.random.default_rng(0), Kind.SCALE, 512, 256)
    assert objects._polygons(camera, np.empty((0, 4, 3))) == []
