"""Roads that are not flat: heights along the road, what a car on them sees, and the traffic that hides their lines."""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest

from automodel.geometry import GroundCamera
from automodel.geometry.stereo_rig import Plane, StereoRig
from automodel.sim.appearance import Appearance
from automodel.sim.highway import HILLS, Highway, HighwayDrive, LaneChange, Vehicle, traffic
from automodel.sim.hills import Hills, seen_ground
from automodel.sim.renderer import Renderer, Standing
from automodel.sim.track import Obstacle
from tests.sim.test_renderer import BARREL, FLOOR, camera, obstacle, rectangle, scene, stroke

LOOK = Appearance(background="hall", marking_grey=220.0)
SPEED_MPS = 95.0 / 3.6


def test_heights_are_the_integral_of_the_slopes() -> None:
    s = np.linspace(-50.0, 900.0, 9501)
    steps = HILLS.slope(0.5 * (s[1:] + s[:-1])) * np.diff(s)
    np.testing.assert_allclose(np.diff(HILLS.height_m(s)), steps, atol=1e-9)
    assert np.abs(np.diff(HILLS.slope(s)) / np.diff(s)).max() == pytest.approx(1.0 / 4000.0)


def test_a_car_stands_on_the_slope() -> None:
    x = np.array((0.0, 1e-4, 100.0))
    on_slope, on_curve = HILLS.ahead(200.0)(x), HILLS.ahead(60.0)(x)
    assert on_slope[:2] == pytest.approx(0.0, abs=1e-9)
    assert on_curve[:2] == pytest.approx(0.0, abs=1e-9)
    assert HILLS.ahead(60.0)(np.array((50.0,)))[0] == pytest.approx(50.0**2 / 8000.0)
    assert on_slope[2] < -0.5  # behind the crest
    assert Hills(()).ahead(3.0)(x).tolist() == [0.0, 0.0, 0.0]
    with pytest.raises(ValueError, match="slopes: expected arc lengths that increase"):
        Hills(((1.0, 0.0), (1.0, 0.1)))


@pytest.mark.parametrize("radius_m", [-200.0, 300.0])
def test_a_ray_meets_the_bent_ground_where_it_comes_first(radius_m: float) -> None:
    eye = camera(pitch_rad=0.1)
    slopes = np.linspace(-0.3, 0.05, 36)
    rays = np.column_stack((np.ones(36), 0.2 * np.ones(36), slopes)) @ eye.cam_from_body.T
    found = seen_ground(eye, rays, lambda x: x * x / (2.0 * radius_m))
    cx, _, cz = eye.centre_m
    for slope, (x, y) in zip(slopes, found, strict=True):
        # cz + slope (x - cx) = x^2 / 2 r
        roots = np.roots((1.0 / (2.0 * radius_m), -slope, slope * cx - cz))
        ahead = [root.real for root in roots if abs(root.imag) < 1e-12 and root.real > cx]
        if ahead and min(ahead) < 300.0:
            assert (x, y) == pytest.approx((min(ahead), 0.2 * (min(ahead) - cx)), rel=2e-3)
        elif not ahead:
            assert math.isnan(x)


@pytest.mark.parametrize("distortion", [(0.0,) * 5, BARREL])
@pytest.mark.parametrize(
    "plane", [Plane(), Plane(pitch_rad=0.015), Plane(roll_rad=-0.02), Plane(0.02, -0.01, 0.01)], ids=str
)
def test_a_body_that_moves_is_another_place_of_the_camera(distortion: tuple[float, ...], plane: Plane) -> None:
    rest = camera(distortion=distortion, yaw_rad=0.1)
    moved = StereoRig(rest, rest).over(plane)[0]
    args = (scene(), FLOOR, [obstacle(rectangle(1.5, 1.7, 0.3, 0.5))])
    seen = Renderer(*args, rest, LOOK, nod_max_rad=0.04).render(0.2, 0.0, 0.1, standing=Standing(camera=moved))
    expected, at_rest = (Renderer(*args, eye, LOOK).render(0.2, 0.0, 0.1) for eye in (moved, rest))
    inner = slice(3, -3)
    off = np.abs(seen.astype(float) - expected)[inner, inner].mean()
    assert off < 1.5
    if any(plane):
        assert off < 0.25 * np.abs(at_rest.astype(float) - expected)[inner, inner].mean()


def tilted(eye: GroundCamera, slope: float) -> GroundCamera:
    """The camera over ground that rises by `slope` ahead, as it stands over that ground's plane."""
    there, angle = copy.copy(eye), math.atan(slope)
    cos, sin = math.cos(angle), math.sin(angle)
    turn = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
    there.cam_from_body, there.centre_m = eye.cam_from_body @ turn.T, turn @ eye.centre_m
    return there


@pytest.mark.parametrize("slope", [-0.03, 0.02])
def test_a_plane_that_rises_is_seen_from_a_camera_that_looks_down(slope: float) -> None:
    eye = camera()
    look = Appearance(marking_grey=220.0, background_grey=40.0, floor_grey=40.0)  # what is no ground is not compared
    standing = Standing(height_m=lambda x: slope * x)
    seen = Renderer(scene(), FLOOR, [], eye, look, nod_max_rad=0.05).render(0.2, 0.0, 0.1, standing=standing)
    expected, flat = (
        Renderer(scene(), FLOOR, [], one, look).render(0.2, 0.0, 0.1) for one in (tilted(eye, slope), eye)
    )
    off = np.abs(seen.astype(float) - expected)[3:-3, 3:-3].mean()
    assert off < 0.25 * np.abs(flat.astype(float) - expected)[3:-3, 3:-3].mean()


def test_a_crest_hides_what_lies_behind_it() -> None:
    bars = [stroke(rectangle(x, x + 0.3, -9.0, 9.0)) for x in (0.8, 6.0)]
    eye, look = camera(pitch_rad=0.05), Appearance(marking_grey=220.0, background_grey=40.0, floor_grey=40.0)
    renderer = Renderer(bars, FLOOR, [], eye, look, nod_max_rad=0.05)
    flat = renderer.render(0.0, 0.0, 0.0).max(axis=1) > 120
    hilly = renderer.render(0.0, 0.0, 0.0, standing=Standing(height_m=lambda x: -x * x / 40.0)).max(axis=1) > 120
    starts = [np.count_nonzero(np.diff(rows.astype(int)) == 1) for rows in (flat, hilly)]
    assert starts == [2, 1]  # the farther bar lies 0.9 m down, behind a crest that the camera sees at 2.7 m


def test_a_camera_without_a_margin_cannot_see_hills() -> None:
    eye = Renderer([], FLOOR, [], camera(160), Appearance())
    with pytest.raises(ValueError, match="nod_max_rad"):
        eye.render(0.0, 0.0, 0.0, standing=Standing(height_m=lambda x: 0.01 * x))


def test_a_nod_beside_a_standing_is_refused() -> None:
    eye = Renderer([], FLOOR, [], camera(160), Appearance(), nod_max_rad=0.05)
    with pytest.raises(ValueError, match="nod_rad: expected 0 beside standing"):
        eye.render(0.0, 0.0, 0.0, nod_rad=0.01, standing=Standing())


def test_traffic_stands_where_it_is_on_the_ground_as_it_is() -> None:
    eye = camera(z_m=1.2)
    box = Obstacle(polygon_m=rectangle(10.0, 12.0, -0.9, 0.9), height_m=0.5, grey=200, base_m=0.3)
    look = Appearance(floor_grey=40.0, background_grey=40.0)
    renderer = Renderer([], FLOOR, [], eye, look, nod_max_rad=0.06)
    empty = renderer.render(0.0, 0.0, 0.0)
    for rise in (0.0, 0.02):
        standing = Standing(height_m=lambda x, rise=rise: rise * x, traffic=((box,),))  # type: ignore[misc]
        rows, columns = np.nonzero(renderer.render(0.0, 0.0, 0.0, standing=standing).astype(int) - empty > 60)
        low, high = eye.body_to_px([(10.0, 0.9, 0.3 + 11.0 * rise), (10.0, -0.9, 0.8 + 11.0 * rise)])
        assert (columns.min(), rows.max()) == pytest.approx(low, abs=1.5)
        assert columns.max() == pytest.approx(high[0], abs=1.5)
    with_it = renderer.render(0.0, 0.0, 0.0, standing=Standing(traffic=((box,),)))
    assert np.count_nonzero(with_it != empty) > 1000  # without hills, too


def test_a_later_part_and_a_nearer_vehicle_hide_others() -> None:
    eye = camera(z_m=1.2)
    near, far = rectangle(8.0, 9.0, -0.5, 0.5), rectangle(12.0, 13.0, -2.0, 2.0)
    group = tuple(Obstacle(polygon_m=near, height_m=2.0, grey=grey) for grey in (30, 220))
    behind = (Obstacle(polygon_m=far, height_m=2.5, grey=90),)
    u, v = np.round(eye.body_to_px((8.0, 0.0, 1.0))).astype(int)
    renderer, greys = Renderer([], FLOOR, [], eye, Appearance()), []
    for vehicles in ((group, behind), (behind, group)):
        greys.append(int(renderer.render(0.0, 0.0, 0.0, standing=Standing(traffic=vehicles))[v, u]))
    assert greys[0] == greys[1] > 100


@pytest.mark.parametrize("seed", range(12))
def test_nobody_collides_on_the_highway(seed: int) -> None:
    _, lanes = Highway().build()
    drive, others = HighwayDrive(lanes[0], SPEED_MPS, (LaneChange(from_s=12.5),)), traffic(SPEED_MPS, seed)
    assert {other.kind for other in others} == {"car", "truck"}
    beside = 0
    for t_s in np.arange(0.0, 25.0, 0.5):
        pose = drive.pose(t_s)
        for other in others:
            parts = other.parts(lanes, t_s)
            if not parts:
                continue
            corners = np.concatenate([part.polygon_m for part in parts])
            own = (corners - (pose.x_m, pose.y_m)) @ [
                [math.cos(pose.yaw_rad), -math.sin(pose.yaw_rad)],
                [math.sin(pose.yaw_rad), math.cos(pose.yaw_rad)],
            ]
            gap = max(own[:, 0].min() - 3.6, -0.8 - own[:, 0].max(), own[:, 1].min() - 0.9, -0.9 - own[:, 1].max())
            assert gap > 0.3
            beside += abs(own[:, 0].mean()) < 30.0
    assert beside > 20  # it is in view for most of the drive


def test_a_vehicle_that_is_not_on_the_road_has_no_parts() -> None:
    _, lanes = Highway().build()
    car = Vehicle(kind="car", lane=1, gap_m=-10.0, speed_mps=20.0, grey=100)
    assert car.parts(lanes, 0.0) == ()
    assert len(car.parts(lanes, 1.0)) == 5
    assert car.parts(lanes, 1000.0) == ()
