from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from automodel.config import CameraConfig, Extrinsics, Intrinsics
from automodel.geometry import SE2, GroundCamera
from automodel.geometry.stereo_rig import Plane, StereoRig
from automodel.sim.appearance import Appearance
from automodel.sim.paint import Paint
from automodel.sim.renderer import Renderer
from automodel.sim.track import Obstacle
from automodel.sim.track_files import load_track

FLOOR = (-50.0, -50.0, 50.0, 50.0)
BARREL = (-0.28, 0.06, 0.001, -0.0015, 0.0)


def stroke(polygon_m: np.ndarray, colour: str = "white") -> Paint:
    return Paint(polygon_m=polygon_m, colour=colour, kind="line")


def obstacle(polygon_m: np.ndarray, height_m: float = 0.2) -> Obstacle:
    return Obstacle(polygon_m=polygon_m, height_m=height_m, grey=150)


def rectangle(x0: float, x1: float, y0: float, y1: float) -> np.ndarray:
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])


def camera(width: int = 640, distortion: tuple[float, ...] = (0.0,) * 5, **extrinsics: float) -> GroundCamera:
    height, scale = width * 9 // 16, width / 640
    lens = Intrinsics(
        fx_px=480 * scale,
        fy_px=480 * scale,
        cx_px=0.5 * (width - 1),
        cy_px=0.5 * (height - 1),
        distortion=distortion,
    )
    return GroundCamera.from_config(
        CameraConfig(width_px=width, height_px=height, intrinsics=lens, extrinsics=Extrinsics(**extrinsics))
    )


# a scene that is given twice: as polygons, and as a rule that says what is painted where
RING_M, HALF_M = 1.4, 0.015


def scene() -> list[Paint]:
    strokes = [stroke(rectangle(-3.0, 40.0, y - HALF_M, y + HALF_M)) for y in (-0.2, 0.6)]
    strokes += [stroke(rectangle(x, x + 0.2, 0.2 - HALF_M, 0.2 + HALF_M)) for x in np.arange(-2.0, 12.0, 0.4)]
    strokes.append(stroke(rectangle(1.1, 1.14, -0.2, 0.2)[::-1]))  # a stop line, drawn the other way round
    turn = np.linspace(0.0, 2.0 * math.pi, 401)[:-1]
    for a, b in zip(turn, np.roll(turn, -1), strict=True):
        corners = [(RING_M - HALF_M, a), (RING_M + HALF_M, a), (RING_M + HALF_M, b), (RING_M - HALF_M, b)]
        strokes.append(stroke(np.array([(3.0 + r * math.cos(t), -2.0 + r * math.sin(t)) for r, t in corners])))
    return strokes


def painted(ground: np.ndarray) -> np.ndarray:
    x, y = ground[..., 0], ground[..., 1]
    lines = ((np.abs(y + 0.2) < HALF_M) | (np.abs(y - 0.6) < HALF_M)) & (x > -3.0) & (x < 40.0)
    dashes = (np.abs(y - 0.2) < HALF_M) & ((x + 2.0) % 0.4 < 0.2) & (x > -2.0) & (x < 12.0)
    stop = (x > 1.1) & (x < 1.14) & (np.abs(y) < 0.2)
    ring = np.abs(np.hypot(x - 3.0, y + 2.0) - RING_M) < HALF_M
    return lines | dashes | stop | ring


def brute_force(eye: GroundCamera, pose: SE2, samples: int = 8) -> np.ndarray:
    """Share of each pixel that is painted, by point samples."""
    height, width = eye.camera.height_px, eye.camera.width_px
    fine = (np.arange(samples) + 0.5) / samples - 0.5
    share = np.zeros((height, width))
    for dv in fine:
        for du in fine:
            u, v = np.meshgrid(np.arange(width) + du, np.arange(height) + dv)
            ground = pose.apply(eye.px_to_ground(np.stack((u, v), axis=-1)))
            with np.errstate(invalid="ignore"):
                share += painted(ground)
    return share / samples**2


@pytest.mark.parametrize(
    ("eye", "pose"),
    [
        (camera(320), SE2(0.0, 0.0, 0.0)),
        (camera(320), SE2(0.3, -0.1, -0.6)),
        (camera(320, roll_rad=0.08, yaw_rad=-0.1, y_m=0.05), SE2(0.2, 0.05, 0.3)),
        (camera(160, BARREL), SE2(0.1, 0.0, -0.2)),
        (camera(160, BARREL, pitch_rad=0.9, roll_rad=-0.1), SE2(0.6, 0.0, 0.2)),
        (camera(160, (0.2, 0.05, 0.0, 0.0, 0.0), pitch_rad=0.0), SE2(1.0, -1.9, 0.9)),
    ],
    ids=["straight", "turned", "rolled", "barrel", "steep", "cushion"],
)
def test_mask_equals_the_brute_force_reference(eye: GroundCamera, pose: SE2) -> None:
    mask = Renderer(scene(), FLOOR, (), eye, Appearance()).render_mask(pose.x_m, pose.y_m, pose.yaw_rad) / 255.0
    truth = brute_force(eye, pose)
    edges = (truth > 0.0) & (truth < 1.0)
    assert 0.01 < truth.mean() < 0.3
    assert np.abs(mask - truth).mean() < 0.002
    assert np.abs(mask - truth)[edges].mean() < 0.03  # 64 samples themselves are good to about 0.02
    assert np.abs(mask - truth).max() < 0.2
    assert abs((mask - truth).sum()) < 0.005 * truth.sum()


@pytest.mark.parametrize("distortion", [(0.0,) * 5, BARREL], ids=["pinhole", "barrel"])
def test_lines_lie_where_they_are(distortion: tuple[float, ...]) -> None:
    eye = camera(distortion=distortion)
    for y_m in (-0.21, 0.003, 0.2):
        line = stroke(rectangle(-1.0, 60.0, y_m - 0.015, y_m + 0.015))
        mask = Renderer([line], FLOOR, (), eye, Appearance()).render_mask(0.0, 0.0, 0.0).astype(float)
        rows, u = np.arange(75, 345, 15), np.arange(-0.5, 639.5, 0.05)  # 0.3 m to 4 m ahead
        on_row = eye.px_to_ground(np.stack(np.meshgrid(u, rows), axis=-1))[..., 1]
        inside = np.abs(on_row - y_m) < 0.015
        rows, inside = rows[inside.any(axis=1)], inside[inside.any(axis=1)]
        truth = inside @ u / inside.sum(axis=1)
        found = (mask[rows] @ np.arange(640)) / mask[rows].sum(axis=1)
        ground = eye.px_to_ground(np.column_stack((found, rows)))
        near = ground[:, 0] < 1.0
        whole = np.abs(truth - 319.5) < 270  # the stroke is wholly in the picture
        assert (near & whole).any()
        assert np.abs(found - truth)[near & whole].max() < 0.1
        assert np.abs(found - truth)[~near & whole].max() < 0.3
        if not any(distortion):  # else the middle of the stroke on a row is not quite its centreline
            assert np.abs(ground[near & whole, 1] - y_m).max() < 0.001


def test_a_rendered_line_lies_where_it_is_with_all_blurs_on() -> None:
    look = Appearance(defocus_px=0.8, exposure_s=0.01, wear=0.0, floor_grey=30.0, marking_grey=200.0)
    eye = camera()
    lines = [stroke(rectangle(-1.0, 9.0, y - 0.015, y + 0.015)) for y in (-0.06, 0.05)]
    lines.append(stroke(rectangle(0.685, 0.715, -0.3, 0.3)))
    picture = Renderer(lines, FLOOR, (), eye, look).render(0.0, 0.0, 0.0, speed_mps=1.5).astype(float) - 30.0
    u, v = eye.ground_to_px([(0.5, -0.06), (0.7, 0.0)]).round().astype(int).T
    columns = np.arange(u[0] - 40, u[0] + 41)
    found = picture[v[0], columns] @ columns / picture[v[0], columns].sum()
    assert eye.px_to_ground((found, v[0]))[1] == pytest.approx(-0.06, abs=0.001)
    rows = np.arange(v[1] - 25, v[1] + 26)
    weight = picture[rows, u[1]]
    ground_x = eye.px_to_ground(np.column_stack((np.full(len(rows), u[1]), rows)))[:, 0]
    width_m = np.gradient(ground_x)
    assert (weight * width_m) @ ground_x / (weight @ width_m) == pytest.approx(0.7, abs=0.001)


def test_motion_blurs_along_the_way_and_not_across() -> None:
    eye = camera()
    lines = [stroke(rectangle(0.55, 0.58, -0.3, 0.3)), stroke(rectangle(0.65, 3.0, -0.015, 0.015))]
    renderer = Renderer(lines, FLOOR, (), eye, Appearance(exposure_s=0.02))
    still, moving = (renderer.render(0.0, 0.0, 0.0, speed_mps=v)[60:] - 40.0 for v in (0.0, 1.0))
    column = int(eye.ground_to_px((0.565, 0.1))[0])
    assert np.count_nonzero(moving[:, column] > 5) > np.count_nonzero(still[:, column] > 5) + 6
    assert moving[:, column].sum() == pytest.approx(still[:, column].sum(), rel=0.05)
    row = int(eye.ground_to_px((0.8, 0.0))[1]) - 60
    assert np.abs(moving[row] - still[row]).max() < 3


def test_turning_smears_by_the_angle_turned() -> None:
    line = [stroke(rectangle(0.3, 9.0, -0.015, 0.015))]
    renderer = Renderer(line, FLOOR, (), camera(), Appearance(exposure_s=0.02))
    still, turning = (renderer.render(0.0, 0.0, 0.0, 0.0, w).astype(float)[150] - 40.0 for w in (0.0, 1.5))
    columns = np.arange(640)

    def variance(profile: np.ndarray) -> float:
        mean = profile @ columns / profile.sum()
        return float(profile @ (columns - mean) ** 2 / profile.sum())

    assert variance(turning) - variance(still) == pytest.approx((480 * 0.03) ** 2 / 12.0, rel=0.05)
    assert turning @ columns / turning.sum() == pytest.approx(still @ columns / still.sum(), abs=0.05)


def test_far_dashes_fade_instead_of_flickering() -> None:
    renderer = Renderer(scene(), FLOOR, (), camera(), Appearance())
    rows = slice(56, 62)  # 10 to 20 m ahead: a row of pixels is longer than a dash
    seen = np.array([renderer.render_mask(x, 0.2, 0.0)[rows, 250:390].astype(float) for x in np.arange(0, 0.4, 0.02)])
    assert seen.sum(axis=(1, 2)).std() < 0.03 * seen.sum(axis=(1, 2)).mean()


def test_the_clean_picture_is_the_mask_in_grey_levels() -> None:
    look = Appearance(floor_grey=40.0, marking_grey=230.0, background_grey=90.0)
    renderer = Renderer(scene(), FLOOR, (), camera(), look)
    picture, mask = renderer.render(0.1, 0.0, 0.2), renderer.render_mask(0.1, 0.0, 0.2)
    assert picture.dtype == mask.dtype == np.uint8
    assert picture.shape == mask.shape == (360, 640)
    assert np.abs(picture[60:] - (40.0 + mask[60:] / 255.0 * 190.0)).max() <= 1.0
    assert (picture[:50] == 90).all()
    assert not mask[:50].any()


def test_a_scene_far_from_the_origin_looks_the_same() -> None:
    there, here = np.array([51234.0, -80321.0]), Renderer(scene(), FLOOR, (), camera(), Appearance())
    moved = [stroke(s.polygon_m + there) for s in scene()]
    mask = Renderer(moved, FLOOR, (), camera(), Appearance()).render_mask(there[0] + 0.2, there[1], 0.3)
    assert np.abs(mask.astype(int) - here.render_mask(0.2, 0.0, 0.3)).max() <= 1


def test_full_scale_lines_run_to_the_horizon() -> None:
    lens = Intrinsics(fx_px=1150, fy_px=1150, cx_px=639.5, cy_px=359.5)
    extrinsics = Extrinsics(x_m=1.5, z_m=1.2, pitch_rad=0.02)
    eye = GroundCamera.from_config(CameraConfig(width_px=1280, height_px=720, intrinsics=lens, extrinsics=extrinsics))
    dashes = [stroke(rectangle(x, x + 6.0, -1.825, -1.675)) for x in np.arange(0.0, 3000.0, 18.0)]
    edge = [stroke(rectangle(x, x + 20.0, 1.6, 1.9)) for x in np.arange(-100.0, 3000.0, 20.0)]
    mask = Renderer(dashes + edge, (0.0, -9.0, 3000.0, 9.0), (), eye, Appearance()).render_mask(1000.0, 0.0, 0.0)
    for distance in (20.0, 80.0, 200.0):
        v = round(eye.ground_to_px((distance, 1.75))[1])
        row = mask[v, : int(eye.ground_to_px((distance, 0.0))[0])].astype(float)
        centre = row @ np.arange(len(row)) / row.sum()
        assert eye.px_to_ground((centre, v))[1] == pytest.approx(1.75, abs=0.1 * distance / 1150.0 + 0.01)
        assert row.sum() / 255.0 == pytest.approx(1150.0 * 0.3 / (distance - 1.5), rel=0.1)


def test_the_same_arguments_give_the_same_picture() -> None:
    look, track = Appearance.random(3), load_track("tmr")
    one, other = (Renderer(track.paint(), track.floor, (), camera(), look) for _ in range(2))
    pose = track.start
    first = one.render(pose.x_m, pose.y_m, pose.yaw_rad, 1.0, 0.5, 7)
    for k in range(5):  # whatever was drawn before has no effect
        other.render(pose.x_m + k, pose.y_m - k, 0.3 * k, 1.0, 0.5, k)
    assert np.array_equal(other.render(pose.x_m, pose.y_m, pose.yaw_rad, 1.0, 0.5, 7), first)
    assert not np.array_equal(one.render(pose.x_m, pose.y_m, pose.yaw_rad, 1.0, 0.5, 8), first)


def test_obstacles_hide_what_is_behind_them() -> None:
    eye = camera()
    line = [stroke(rectangle(0.3, 6.0, -0.015, 0.015))]
    box = obstacle(rectangle(0.9, 1.1, -0.1, 0.1), height_m=0.08)
    look = Appearance(floor_grey=40.0)
    with_box, without = (Renderer(line, FLOOR, boxes, eye, look) for boxes in ((box,), ()))
    picture, mask = with_box.render(0.0, 0.0, 0.0), with_box.render_mask(0.0, 0.0, 0.0)
    front_u, front_v = eye.body_to_px([(0.9, 0.0, 0.04)])[0].round().astype(int)
    assert without.render_mask(0.0, 0.0, 0.0)[front_v, front_u] > 0
    assert mask[front_v, front_u] == 0
    assert 60 < picture[front_v, front_u] < 150
    top_u, top_v = eye.body_to_px([(1.0, 0.0, 0.08)])[0].round().astype(int)
    assert picture[top_v, top_u] == 150  # the top is lit most
    before = eye.ground_to_px((0.6, 0.0)).round().astype(int)
    assert picture[before[1], before[0]] == 230
    corners = eye.body_to_px([(0.9, y, z) for y in (-0.1, 0.1) for z in (0.0, 0.08)])
    differing = np.argwhere(picture != without.render(0.0, 0.0, 0.0))
    assert abs(differing[:, 0].max() - corners[:, 1].max()) < 1.5
    assert abs(differing[:, 1].min() - corners[:, 0].min()) < 1.5
    assert abs(differing[:, 1].max() - corners[:, 0].max()) < 1.5


def test_obstacles_behind_or_around_the_camera_do_no_harm() -> None:
    boxes = (obstacle(rectangle(-1.0, -0.5, -0.1, 0.1)), obstacle(rectangle(0.1, 0.35, 0.05, 0.3), height_m=0.4))
    for distortion in ((0.0,) * 5, BARREL):
        renderer = Renderer([], FLOOR, boxes[:1], camera(distortion=distortion), Appearance())
        assert np.array_equal(
            renderer.render(0.0, 0.0, 0.0),
            Renderer([], FLOOR, (), camera(distortion=distortion), Appearance()).render(0.0, 0.0, 0.0),
        )
        beside = Renderer([], FLOOR, boxes, camera(distortion=distortion), Appearance()).render(0.0, 0.0, 0.0)
        assert (beside[200:300, :40] != 40).all()
        assert (beside[200:300, 600:] == 40).all()


def test_colour() -> None:
    paint = [stroke(rectangle(0.3, 6.0, 0.1, 0.13), "yellow"), stroke(rectangle(0.3, 6.0, -0.13, -0.1))]
    look = Appearance(marking_grey=200.0, floor_grey=40.0, yellow_bgr=(60.0, 190.0, 225.0))
    colour, grey = (Renderer(paint, FLOOR, (), camera(), look, colour=c).render(0.0, 0.0, 0.0) for c in (True, False))
    assert colour.shape == (360, 640, 3)
    for y_m, expected in ((0.115, (60, 190, 225)), (-0.115, (200, 200, 200)), (0.0, (40, 40, 40))):
        u, v = camera().ground_to_px((0.6, y_m)).round().astype(int)
        assert tuple(colour[v, u].tolist()) == expected
        assert grey[v, u] == pytest.approx(np.dot(expected, (0.114, 0.587, 0.299)), abs=1)
    with pytest.raises(ValueError, match=r"expected one of white, yellow.*, got 'green'"):
        Renderer([stroke(rectangle(0, 1, 0, 1), "green")], FLOOR, (), camera(), look)


def test_cameras_without_ground_or_without_sky() -> None:
    up = Renderer(scene(), FLOOR, (), camera(320, pitch_rad=-0.6), Appearance.random(1))
    assert up.render(0.0, 0.0, 0.0).shape == (180, 320)
    assert not up.render_mask(0.0, 0.0, 0.0).any()
    down = Renderer(scene(), FLOOR, (), camera(320, pitch_rad=1.2), Appearance.random(1))
    assert down.render(0.2, 0.2, 0.0).shape == (180, 320)
    assert down.render_mask(0.2, 0.2, 0.0).any()


def test_the_floor_ends_where_it_ends() -> None:
    look = replace(Appearance(), surround_grey=120.0)
    picture = Renderer([], (-1.0, -2.0, 2.0, 0.3), (), camera(), look).render(0.0, 0.0, 0.0)
    for point, grey in (((1.8, 0.0), 40), ((2.3, 0.0), 120), ((0.8, 0.25), 40), ((0.8, 0.35), 120)):
        u, v = camera().ground_to_px(point).round().astype(int)
        assert picture[v, u] == pytest.approx(grey, abs=1), point


@pytest.mark.parametrize("seed", range(8))
def test_the_lane_stands_out_at_a_competition(seed: int) -> None:
    track = load_track("tmr")
    renderer = Renderer(track.paint(), track.floor, track.obstacles, camera(), Appearance.random(seed))
    pose = track.forward.pose(3.1 * seed)
    picture = renderer.render(pose.x_m, pose.y_m, pose.yaw_rad, 1.0, 0.3, seed)[120:].astype(float)
    mask = renderer.render_mask(pose.x_m, pose.y_m, pose.yaw_rad)[120:]
    assert np.median(picture[mask == 255]) > np.median(picture[mask == 0]) + 50


@pytest.mark.parametrize("distortion", [(0.0,) * 5, BARREL])
@pytest.mark.parametrize("nod_deg", [-1.2, 0.0, 0.7])
def test_a_nod_is_another_pitch(distortion: tuple[float, ...], nod_deg: float) -> None:
    nod = math.radians(nod_deg)
    looks = Appearance(background="hall", marking_grey=220.0)
    args = (scene(), FLOOR, [obstacle(rectangle(1.5, 1.7, 0.3, 0.5))])
    nodding = Renderer(*args, camera(distortion=distortion), looks, nod_max_rad=math.radians(1.5))
    pitched = Renderer(*args, camera(distortion=distortion, pitch_rad=Extrinsics().pitch_rad + nod), looks)
    at_rest = Renderer(*args, camera(distortion=distortion), looks)
    seen, expected, rest = (eye.render(0.2, 0.0, 0.1) for eye in (nodding, pitched, at_rest))
    seen = nodding.render(0.2, 0.0, 0.1, nod_rad=nod)
    inner = slice(3, -3)
    off = np.abs(seen.astype(float) - expected)[inner, inner].mean()
    assert off < 1.0
    if nod:
        assert off < 0.2 * np.abs(rest.astype(float) - expected)[inner, inner].mean()
    mask = nodding.render_mask(0.2, 0.0, 0.1, nod)
    assert np.abs(mask.astype(float) - pitched.render_mask(0.2, 0.0, 0.1))[inner, inner].mean() < 1.0


def test_a_camera_that_looks_aside_pitches_with_its_car() -> None:
    """Against a camera whose attitude over the road is that of a body that is pitched."""
    nod, looks = math.radians(1.3), Appearance(background="hall", marking_grey=220.0)
    rest = camera(yaw_rad=0.3, roll_rad=-0.1)
    pitched = StereoRig(rest, rest).over(Plane(pitch_rad=nod))[0]
    args = (scene(), FLOOR, [obstacle(rectangle(1.5, 1.7, 0.3, 0.5))])
    seen = Renderer(*args, rest, looks, nod_max_rad=math.radians(1.5)).render(0.2, 0.0, 0.1, nod_rad=nod)
    expected, at_rest = (Renderer(*args, eye, looks).render(0.2, 0.0, 0.1) for eye in (pitched, rest))
    inner = slice(3, -3)
    off = np.abs(seen.astype(float) - expected)[inner, inner].mean()
    assert off < 0.1 * np.abs(at_rest.astype(float) - expected)[inner, inner].mean()


def test_a_nod_beyond_its_limit_is_refused() -> None:
    eye = Renderer([], FLOOR, [], camera(160), Appearance(), nod_max_rad=0.01)
    with pytest.raises(ValueError, match="nod_rad: expected at most"):
        eye.render(0.0, 0.0, 0.0, nod_rad=0.02)


def test_haze_fades_contrasts_as_koschmieder_says() -> None:
    stripes = [stroke(rectangle(x, x + 0.1, -5.0, 5.0)) for x in (0.6, 1.5, 3.0)]
    look = Appearance(floor_grey=40.0, marking_grey=240.0, background_grey=160.0)
    eye = camera()
    clear, hazy = (
        Renderer(stripes, FLOOR, [], eye, replace(look, haze=haze)).render(0.0, 0.0, 0.0).astype(float)
        for haze in (0.0, 0.3)
    )
    for x in (0.65, 1.55, 3.05):
        u, v = np.round(eye.ground_to_px((x, 0.0))).astype(int)
        left = math.exp(-0.3 * math.dist((x, 0.0, 0.0), eye.centre_m))
        assert hazy[v, u] == pytest.approx(left * clear[v, u] + (1.0 - left) * 160.0, abs=1.5)
    assert hazy[:40] == pytest.approx(160.0, abs=1.5)
