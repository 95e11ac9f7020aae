"""Frames, cameras and the ground against OpenCV and hand-made cases."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from automodel.config import CameraConfig, Extrinsics, Intrinsics
from automodel.geometry import SE2, BirdsEye, CameraModel, GroundCamera, View, cam_from_body_rotation, wrap_angle

LENS = Intrinsics(fx_px=410.0, fy_px=420.0, cx_px=322.0, cy_px=177.0, distortion=(-0.31, 0.12, 0.0013, -0.0008, -0.02))
lengths = st.floats(-20.0, 20.0)
angles = st.floats(-10.0, 10.0)
poses = st.builds(SE2, lengths, lengths, angles)


def matrix(pose: SE2) -> np.ndarray:
    """The homogeneous matrix (3, 3) of a pose, from its definition."""
    cos, sin = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
    return np.array([[cos, -sin, pose.x_m], [sin, cos, pose.y_m], [0, 0, 1]])


class TestSE2:
    @given(poses, poses)
    def test_product_is_the_matrices_product(self, a: SE2, b: SE2) -> None:
        assert matrix(a @ b) == pytest.approx(matrix(a) @ matrix(b), abs=1e-9)

    @given(poses, poses, poses)
    def test_is_associative(self, a: SE2, b: SE2, c: SE2) -> None:
        assert matrix((a @ b) @ c) == pytest.approx(matrix(a @ (b @ c)), abs=1e-8)

    @given(poses)
    def test_inverse_and_identity(self, a: SE2) -> None:
        for identity in (a @ a.inverse(), a.inverse() @ a):
            assert matrix(identity) == pytest.approx(np.eye(3), abs=1e-9)
        assert matrix(a @ SE2()) == pytest.approx(matrix(a))
        assert matrix(SE2() @ a) == pytest.approx(matrix(a))

    @given(poses, poses, st.tuples(lengths, lengths))
    def test_apply_carries_points_through_products(self, a: SE2, b: SE2, point: tuple[float, float]) -> None:
        assert (a @ b).apply(point) == pytest.approx(a.apply(b.apply(point)), abs=1e-8)

    def test_apply_keeps_the_shape_and_turns_left(self) -> None:
        pose = SE2(1.0, 2.0, math.pi / 2)
        assert pose.apply((1.0, 0.0)) == pytest.approx([1.0, 3.0])
        assert pose.apply(np.zeros((2, 3, 2))).shape == (2, 3, 2)

    @given(st.floats(-5.0, 5.0), st.floats(-6.0, 6.0))
    def test_arc_is_the_limit_of_many_small_steps(self, distance_m: float, turn_rad: float) -> None:
        n = 1000
        theta = (np.arange(n) + 0.5) / n * turn_rad
        end = SE2.arc(distance_m, turn_rad)
        assert [end.x_m, end.y_m] == pytest.approx(
            [distance_m * np.cos(theta).mean(), distance_m * np.sin(theta).mean()], abs=1e-4
        )
        assert end.yaw_rad == turn_rad

    def test_arc_straight_on(self) -> None:
        assert SE2.arc(2.0, 0.0) == SE2(2.0, 0.0, 0.0)
        assert SE2.arc(2.0, 1e-12).y_m == pytest.approx(1e-12)

    @given(st.floats(-100.0, 100.0))
    def test_wrapped_angle_is_the_same_direction(self, angle: float) -> None:
        wrapped = wrap_angle(angle)
        assert -math.pi <= wrapped <= math.pi
        assert (math.cos(wrapped), math.sin(wrapped)) == pytest.approx((math.cos(angle), math.sin(angle)), abs=1e-9)


class TestCameraModel:
    def test_projects_as_opencv_does(self) -> None:
        camera = CameraModel(LENS, 640, 360)
        rng = np.random.default_rng(1)
        points = np.column_stack((rng.uniform(-0.7, 0.7, 200), rng.uniform(-0.4, 0.4, 200), np.ones(200)))
        points *= rng.uniform(0.2, 9.0, (200, 1))
        expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
        assert camera.project(points) == pytest.approx(expected[:, 0], abs=1e-9)

    def test_rays_undo_project(self) -> None:
        camera = CameraModel(LENS, 640, 360)
        u, v = np.meshgrid(np.linspace(0, 639, 23), np.linspace(0, 359, 17))
        pixels = np.stack((u, v), axis=-1)
        rays = camera.rays(pixels)
        assert rays.shape == (17, 23, 3)
        assert (rays[..., 2] == 1.0).all()
        assert camera.project(3.0 * rays) == pytest.approx(pixels, abs=1e-4)

    def test_opencv_projects_rays_onto_their_pixels(self) -> None:
        camera = CameraModel(LENS, 640, 360)
        pixels = np.array([[3.0, 5.0], [100.0, 80.0], [500.0, 300.0], [322.0, 177.0]])
        back, _ = cv2.projectPoints(camera.rays(pixels), np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
        assert back[:, 0] == pytest.approx(pixels, abs=1e-4)

    def test_without_distortion_it_is_the_pinhole(self) -> None:
        camera = CameraModel(Intrinsics(), 640, 360)
        assert camera.project((0.5, -0.25, 2.0)) == pytest.approx([319.5 + 480 * 0.25, 179.5 - 480 * 0.125])
        assert camera.rays((319.5, 179.5)) == pytest.approx([0, 0, 1])

    def test_what_it_cannot_see_is_nan(self) -> None:
        camera = CameraModel(LENS, 640, 360)
        assert np.isnan(camera.project([(0.0, 0.0, -1.0), (0.0, 0.0, 0.0), (30.0, 0.0, 1.0)])).all()

    def test_a_lens_that_folds_back_has_no_rays_beyond(self) -> None:
        # radius r (1 - 0.5 r^2) rises to 2/3 sqrt(2/3) = 0.544 and no further
        camera = CameraModel(Intrinsics(distortion=(-0.5, 0.0, 0.0, 0.0, 0.0)), 640, 360)
        assert np.isnan(camera.rays((319.5 + 480 * 0.56, 179.5))).all()
        assert camera.rays((319.5 + 480 * 0.4375, 179.5))[0] == pytest.approx(0.5, abs=1e-6)  # 0.5 (1 - 0.125)

    def test_inside_counts_whole_pixels(self) -> None:
        camera = CameraModel(Intrinsics(), 640, 360)
        pixels = [(-0.5, -0.5), (639.5, 359.5), (-0.51, 0.0), (0.0, 359.6), (math.nan, 0.0)]
        assert camera.inside(pixels).tolist() == [True, True, False, False, False]
        assert not camera.inside((5.0, 100.0), margin_px=6.0)


def ground_camera(**extrinsics: float) -> GroundCamera:
    return GroundCamera(CameraModel(Intrinsics(), 640, 360), Extrinsics(**extrinsics))


class TestGroundCamera:
    def test_rotation_is_a_rotation(self) -> None:
        rotation = cam_from_body_rotation(Extrinsics(pitch_rad=0.3, yaw_rad=-0.2, roll_rad=0.1))
        assert rotation @ rotation.T == pytest.approx(np.eye(3))
        assert np.linalg.det(rotation) == pytest.approx(1.0)

    def test_level_camera_looks_ahead(self) -> None:
        rotation = cam_from_body_rotation(Extrinsics(pitch_rad=0.0))
        assert rotation @ [1, 0, 0] == pytest.approx([0, 0, 1])  # ahead
        assert rotation @ [0, 1, 0] == pytest.approx([-1, 0, 0])  # left is minus right
        assert rotation @ [0, 0, 1] == pytest.approx([0, -1, 0])  # up is minus down

    def test_positive_pitch_looks_down(self) -> None:
        camera = ground_camera(x_m=0.2, z_m=0.18, pitch_rad=0.26)
        # the optical axis meets the ground at z / tan(pitch) ahead of the camera
        assert camera.px_to_ground((319.5, 179.5)) == pytest.approx([0.2 + 0.18 / math.tan(0.26), 0.0])

    def test_positive_yaw_looks_left(self) -> None:
        camera = ground_camera(x_m=0.0, z_m=0.2, pitch_rad=0.3, yaw_rad=0.1)
        reach = 0.2 / math.tan(0.3)
        expected = [reach * math.cos(0.1), reach * math.sin(0.1)]
        assert camera.px_to_ground((319.5, 179.5)) == pytest.approx(expected)

    def test_positive_roll_leans_the_right_side_down(self) -> None:
        # what is right of the car then appears higher in the image, what is left lower
        camera, level = ground_camera(roll_rad=0.05), ground_camera()
        right, left = (1.0, -0.3), (1.0, 0.3)
        assert camera.ground_to_px(right)[1] < level.ground_to_px(right)[1]
        assert camera.ground_to_px(left)[1] > level.ground_to_px(left)[1]

    def test_matches_opencvs_pose_convention(self) -> None:
        extrinsics = Extrinsics(x_m=0.1, y_m=-0.03, z_m=0.21, pitch_rad=0.2, yaw_rad=0.15, roll_rad=-0.1)
        camera = GroundCamera(CameraModel(LENS, 640, 360), extrinsics)
        rng = np.random.default_rng(2)
        points = np.column_stack((rng.uniform(0.6, 3.0, 50), rng.uniform(-0.5, 0.5, 50), rng.uniform(0, 0.3, 50)))
        # by the axis directions of a camera that was turned by yaw, then pitch, then roll
        cy, sy, cp, sp = math.cos(0.15), math.sin(0.15), math.cos(0.2), math.sin(0.2)
        ahead = np.array([cp * cy, cp * sy, -sp])
        level_right = np.array([sy, -cy, 0.0])
        level_down = np.cross(ahead, level_right)
        right = math.cos(-0.1) * level_right + math.sin(-0.1) * level_down
        rotation = np.array([right, np.cross(ahead, right), ahead])
        shift = -rotation @ np.array([0.1, -0.03, 0.21])
        expected, _ = cv2.projectPoints(
            points, cv2.Rodrigues(rotation)[0], shift, camera.camera.matrix, camera.camera.distortion
        )
        assert camera.body_to_px(points) == pytest.approx(expected[:, 0], abs=1e-6)

    def test_ground_round_trip_with_distortion(self) -> None:
        camera = GroundCamera(CameraModel(LENS, 640, 360), Extrinsics(yaw_rad=0.05, roll_rad=0.03))
        x, y = np.meshgrid(np.linspace(0.5, 3.0, 9), np.linspace(-0.3, 0.3, 7))
        points = np.stack((x, y), axis=-1)
        assert camera.px_to_ground(camera.ground_to_px(points)) == pytest.approx(points, abs=1e-5)

    def test_homography_is_the_undistorted_projection(self) -> None:
        camera = ground_camera(yaw_rad=0.05, roll_rad=0.03, y_m=0.02)
        points = np.array([(0.5, 0.1), (1.5, -0.4), (6.0, 1.0)])
        mapped = np.column_stack((points, np.ones(3))) @ camera.homography.T
        assert mapped[:, :2] / mapped[:, 2:] == pytest.approx(camera.ground_to_px(points), abs=1e-9)
        assert (mapped[:, 2] > 0).all()

    def test_sky_is_not_ground(self) -> None:
        camera = ground_camera(pitch_rad=0.1)
        horizon = 179.5 - 480 * math.tan(0.1)
        assert np.isnan(camera.px_to_ground([(300.0, horizon - 0.5), (300.0, 0.0)])).all()
        assert np.isfinite(camera.px_to_ground((300.0, horizon + 0.5))).all()

    def test_first_visible_ground(self) -> None:
        camera = GroundCamera.from_config(CameraConfig())
        steepest = 0.26 + math.atan((359 - 179.5) / 480)  # the bottom row's ray in the middle of the image
        assert camera.first_visible_x_m() == pytest.approx(0.20 + 0.18 / math.tan(steepest), abs=1e-6)
        with pytest.raises(ValueError, match="shows no ground"):
            ground_camera(pitch_rad=-0.8).first_visible_x_m()


class TestBirdsEye:
    VIEW = View(x_near_m=0.4, x_far_m=1.6, half_width_m=0.6, m_per_px=0.01)

    @given(st.floats(0.0, 5.0), st.floats(-2.0, 2.0))
    def test_view_round_trip(self, x_m: float, y_m: float) -> None:
        assert self.VIEW.to_body(self.VIEW.to_px((x_m, y_m))) == pytest.approx([x_m, y_m], abs=1e-9)

    def test_view_pixels_have_their_middles_on_integers(self) -> None:
        assert (self.VIEW.height_px, self.VIEW.width_px) == (120, 120)
        assert self.VIEW.to_px((1.6, 0.6)) == pytest.approx([-0.5, -0.5])  # far left corner of the first pixel
        assert self.VIEW.to_px((0.4, -0.6)) == pytest.approx([119.5, 119.5])
        assert self.VIEW.to_body((0.0, 0.0)) == pytest.approx([1.595, 0.595])

    def test_rows_may_be_coarser_than_columns(self) -> None:
        view = View(x_near_m=0.4, x_far_m=1.6, half_width_m=0.6, m_per_px=0.01, m_per_row=0.02)
        assert (view.height_px, view.width_px) == (60, 120)
        assert view.to_px((1.0, 0.0)) == pytest.approx([59.5, 29.5])
        assert view.to_body(view.to_px((0.7, 0.2))) == pytest.approx([0.7, 0.2])

    def test_impossible_views_are_refused(self) -> None:
        with pytest.raises(ValueError, match="View: expected"):
            View(x_near_m=1.0, x_far_m=0.5, half_width_m=0.5, m_per_px=0.01)

    @pytest.mark.parametrize("lens", [Intrinsics(), LENS], ids=["pinhole", "distorted"])
    def test_a_drawn_square_lands_where_the_view_says(self, lens: Intrinsics) -> None:
        camera = GroundCamera(CameraModel(lens, 640, 360), Extrinsics(yaw_rad=0.04, roll_rad=-0.02))
        square = np.array([(0.9, 0.1), (0.9, -0.15), (1.15, -0.15), (1.15, 0.1)])
        border = np.concatenate([np.linspace(a, b, 20) for a, b in zip(square, np.roll(square, -1, 0), strict=True)])
        image = np.zeros((360, 640), dtype=np.uint8)
        outline = np.round(camera.ground_to_px(border) * 16).astype(np.int32)
        cv2.fillPoly(image, [outline], 255, lineType=cv2.LINE_AA, shift=4)
        warped = BirdsEye(camera, self.VIEW).warp(image)
        assert warped.shape == (120, 120)
        rows, columns = np.nonzero(warped > 127)
        corners = self.VIEW.to_px(square)
        assert columns.min() == pytest.approx(corners[:, 0].min() + 0.5, abs=1.5)
        assert columns.max() == pytest.approx(corners[:, 0].max() - 0.5, abs=1.5)
        assert rows.min() == pytest.approx(corners[:, 1].min() + 0.5, abs=1.5)
        assert rows.max() == pytest.approx(corners[:, 1].max() - 0.5, abs=1.5)
        assert (columns.mean(), rows.mean()) == pytest.approx(tuple(corners.mean(axis=0)), abs=0.5)

    def test_an_image_of_another_size_is_refused(self) -> None:
        birdseye = BirdsEye(GroundCamera.from_config(CameraConfig()), self.VIEW)
        for shape in ((360, 639), (361, 640), (360, 640, 3)):
            with pytest.raises(ValueError, match="expected an image"):
                birdseye.warp(np.zeros(shape, np.uint8))

    @pytest.mark.parametrize("shape", [(1, 1), (1, 640), (360, 1)])
    def test_an_image_of_a_single_row_or_column_is_stretched_over_the_view(self, shape: tuple[int, int]) -> None:
        height, width = shape
        camera = GroundCamera(CameraModel(Intrinsics(), width, height), Extrinsics())
        image = np.broadcast_to(np.arange(1, width + 1) % 251 if height == 1 else [[7]], shape).astype(np.uint8)
        warped = BirdsEye(camera, self.VIEW).warp(image)
        assert set(np.unique(warped)) <= set(np.unique(image))

    def test_outside_the_picture_it_is_masked_and_repeats_the_edge(self) -> None:
        camera = GroundCamera.from_config(CameraConfig())
        view = View(x_near_m=0.05, x_far_m=1.5, half_width_m=1.5, m_per_px=0.02)
        birdseye = BirdsEye(camera, view)
        image = np.full((360, 640), 200, dtype=np.uint8)
        image[0] = image[-1] = image[:, 0] = image[:, -1] = 50
        warped = birdseye.warp(image)
        assert warped.shape == (view.height_px, view.width_px)
        assert set(np.unique(birdseye.mask)) == {0, 255}
        inside = cv2.erode(birdseye.mask, np.ones((3, 3), np.uint8)) == 255
        assert (warped[inside] == 200).all()
        assert (warped[birdseye.mask == 0] == 50).all()
        column, row = np.round(view.to_px((0.10, 0.0))).astype(int)
        assert birdseye.mask[row, column] == 0  # nearer than the image's bottom row
