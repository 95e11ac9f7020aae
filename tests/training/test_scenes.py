import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from automodel.config import Extrinsics, Intrinsics
from automodel.geometry import CameraModel, GroundCamera
from automodel.training import distractors, scenes
from automodel.training import distractors as signs
from automodel.training.cameras import Kind, WideLens, random_camera
from automodel.training.layouts import random_road
from automodel.training.roads import Road, edge_style, painted, random_ribbon
from automodel.training.scenes import GroundView, Sample, atlas, augmented, lit_ground, make_sample
from automodel.training.shapes import UNKNOWN, Canvas, Ink, Patch, Ribbon, Stripe, box, worn

WIDTH, HEIGHT = 512, 256
FOCAL, CX, CY, CAMERA_Z = 300.0, 255.5, 90.0, 0.5


def level_camera(width: int = WIDTH, height: int = HEIGHT) -> GroundCamera:
    """Looks straight along x from half a lane width up: (x, y) is seen at CX - f y / x, CY + f z / x."""
    intrinsics = Intrinsics(fx_px=FOCAL, fy_px=FOCAL, cx_px=CX, cy_px=CY)
    lens = WideLens(intrinsics, width, height)
    return GroundCamera(lens, Extrinsics(x_m=0.0, y_m=0.0, z_m=CAMERA_Z, pitch_rad=0.0))


def straight_ribbon(reach: float = 60.0) -> Ribbon:
    s = np.arange(-4.0, reach, 0.1)
    return Ribbon(s, np.column_stack((s, np.zeros_like(s))), np.zeros_like(s))


def straight_road() -> Road:
    return Road(kind=Kind.ROAD, ribbon=straight_ribbon(), left=0.5, right=0.5, reach=60.0)


def line(d: float, *, half_width: float = 0.03, pattern: tuple[float, ...] = (), ink: Ink = Ink.PAINT) -> Stripe:
    ribbon = straight_ribbon()
    points = ribbon.place(ribbon.s, d)
    return Stripe(points=points, half_width=half_width, ink=ink, pattern=pattern, marking=True)


def row_of(x: float) -> int:
    return round(CY + FOCAL * CAMERA_Z / x)


def column_of(x: float, y: float) -> float:
    return CX - FOCAL * y / x


def drawn(*shapes: Stripe | Patch) -> Canvas:
    canvas = Canvas(level_camera())
    for shape in shapes:
        if isinstance(shape, Stripe):
            canvas.stripe(shape)
        else:
            canvas.patch(shape)
    return canvas


def test_the_same_seed_gives_the_same_picture_and_another_seed_another() -> None:
    first, again, other = make_sample(7), make_sample(7), make_sample(8)
    assert np.array_equal(first.image, again.image)
    assert np.array_equal(first.mask, again.mask)
    assert not np.array_equal(first.image, other.image)


@pytest.mark.parametrize("size", [(512, 256), (256, 128)])
def test_images_and_masks_are_grey_bytes_of_the_size_asked_for(size: tuple[int, int]) -> None:
    sample = make_sample(3, *size)
    assert sample.image.shape == sample.mask.shape == size[::-1]
    assert sample.image.dtype == sample.mask.dtype == np.uint8


@pytest.fixture(scope="module")
def samples() -> list[Sample]:
    return [make_sample(seed) for seed in range(100, 150)]


def test_fifty_images_are_varied_and_have_sane_masks(samples: list[Sample]) -> None:
    marked = np.array([(s.mask > 127).mean() for s in samples])
    means = np.array([s.image.mean() for s in samples])
    assert 0.0 < np.mean(marked < 1e-4) < 0.3  # some images have no line
    assert 0.005 < np.median(marked) < 0.05
    assert marked.max() < 0.25
    assert means.std() > 20.0
    assert np.mean([s.image.std() > 5.0 for s in samples]) > 0.9


def test_marking_is_brighter_than_what_is_beside_it_in_most_images(samples: list[Sample]) -> None:
    brighter = []
    for sample in samples:
        core = sample.mask > 250
        if core.sum() > 200:
            beside = (cv2.dilate(sample.mask, np.ones((15, 15), np.uint8)) > 0) & (sample.mask == 0)
            brighter.append(sample.image[core].mean() > sample.image[beside].mean())
    assert len(brighter) > 15
    assert np.mean(brighter) > 0.85


@pytest.mark.parametrize("x", [1.2, 2.0, 4.0, 8.0])
def test_a_straight_line_is_labelled_where_projection_by_hand_puts_it(x: float) -> None:
    y, half = 0.3, 0.05
    label = drawn(line(y, half_width=half)).label().astype(float)
    v = row_of(x)
    seen_x = FOCAL * CAMERA_Z / (v - CY)
    row = label[v] / 255.0
    centre = (row * np.arange(WIDTH)).sum() / row.sum()
    assert centre == pytest.approx(column_of(seen_x, y), abs=0.3)
    assert row.sum() == pytest.approx(2 * half * FOCAL / seen_x, abs=0.8)
    assert row.max() == 1.0


def test_nothing_is_labelled_at_and_above_the_horizon() -> None:
    label = drawn(line(0.3), line(-0.3)).label()
    assert not label[: int(CY)].any()
    assert label[int(CY) + 4 :].any(axis=1).all()


def test_far_paint_has_its_true_coverage_and_a_label_wide_enough_to_learn() -> None:
    half, v = 0.01, row_of(25.0)
    canvas = drawn(line(0.4, half_width=half))
    cover, label = canvas.coverage(Ink.PAINT), canvas.label() / 255.0
    assert cover is not None
    across = np.hypot(1.0, 0.4 / CAMERA_Z)  # a row cuts the slanted line wider than it is
    seen_width = 2 * half * FOCAL / (FOCAL * CAMERA_Z / (v - CY))
    assert cover[v - 1 : v + 2].sum() / 3.0 == pytest.approx(seen_width, rel=0.5)
    assert label[v].sum() > 1.2 * across


def test_the_gaps_between_dashes_are_not_labelled() -> None:
    # points begin at x = -4: with 1 of paint and 1 of gap, 0..1 and 2..3 are painted
    label = drawn(line(-0.4, half_width=0.05, pattern=(1.0, 1.0))).label()
    for x, wanted in ((1.5, 0), (2.5, 255), (3.5, 0), (4.5, 255), (7.5, 0)):
        assert label[row_of(x), round(column_of(x, -0.4))] == wanted
    shifted = drawn(replace(line(-0.4, half_width=0.05, pattern=(1.0, 1.0)), phase=1.0)).label()
    assert shifted[row_of(1.5), round(column_of(1.5, -0.4))] == 255
    assert shifted[row_of(2.5), round(column_of(2.5, -0.4))] == 0


def test_dashes_too_small_to_see_cover_their_share_and_are_not_labelled() -> None:
    canvas = drawn(line(0.0, half_width=0.2, pattern=(0.02, 0.06)))
    cover, far = canvas.coverage(Ink.PAINT), row_of(20.0)
    assert cover is not None
    assert cover[far, round(CX)] == pytest.approx(0.25, abs=0.03)
    assert canvas.label()[far].max() == 0


def test_a_stripe_wider_than_the_view_reaches_both_edges_of_the_picture() -> None:
    cover = drawn(line(0.0, half_width=30.0, ink=Ink.ROADBED)).coverage(Ink.ROADBED)
    assert cover is not None
    assert cover[int(CY) + 8 :].min() == 1.0


def test_a_patch_is_filled_where_projection_by_hand_puts_it_and_has_no_label() -> None:
    canvas = drawn(Patch(outlines=(box(2.0, 3.0, -0.2, 0.2),), ink=Ink.BRIGHT))
    cover = canvas.coverage(Ink.BRIGHT)
    assert cover is not None
    assert cover[row_of(2.5), round(CX)] == 1.0
    assert cover[row_of(1.8)].max() == cover[row_of(3.4)].max() == 0.0
    assert cover[row_of(2.5)].sum() == pytest.approx(0.4 * FOCAL / 2.5, abs=2.0)
    assert not canvas.label().any()


@pytest.mark.parametrize("seed", range(6))
def test_distractors_are_drawn_but_never_labelled(seed: int) -> None:
    rng, road = np.random.default_rng(seed), straight_road()
    shapes: list[Stripe | Patch] = []
    for sign in (signs.zebra, signs.stop_line, signs.triangles, signs.arrow, signs.writing, signs.hatching):
        shapes += sign(rng, road)
    for _ in range(15):
        shapes += distractors.random_distractors(rng, road)
    ground = lit_ground(rng, level_camera(), road, shapes)
    assert len(shapes) > 20
    assert not ground.mask.any()
    assert drawn(*shapes).coverage(Ink.PAINT) is not None


def test_worn_paint_keeps_its_label_and_paint_that_is_gone_loses_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def mask_with(kept: np.ndarray) -> np.ndarray:
        monkeypatch.setattr(scenes, "_wear", lambda _rng, _view: kept)
        monkeypatch.setattr(scenes, "light", lambda *_: None)
        monkeypatch.setattr(scenes, "augment", lambda image, *_: image.copy())
        monkeypatch.setattr(scenes, "_contrast", lambda *_: 90.0)
        ground = lit_ground(np.random.default_rng(5), level_camera(), straight_road(), [line(0.4), line(-0.4)])
        return augmented((ground.image, ground.mask, ground.seen, ground.whole), 1).mask

    spots = np.kron(np.random.default_rng(0).random((HEIGHT // 4, WIDTH // 4)) > 0.6, np.ones((4, 4)))
    whole = mask_with(np.ones((HEIGHT, WIDTH), np.float32))
    scuffed = mask_with(spots.astype(np.float32))
    gone = mask_with(np.zeros((HEIGHT, WIDTH), np.float32))
    near = np.s_[int(CY) + 30 :]
    assert (whole[near] > 250).sum() > 1000
    assert (scuffed[near] > 127).sum() > 0.95 * (whole[near] > 127).sum()
    assert gone.max() == UNKNOWN
    assert (gone[whole > 127] == UNKNOWN).all()


def test_wear_takes_the_share_of_paint_that_it_is_asked_to() -> None:
    noise = np.random.default_rng(1).integers(0, 256, (512, 512)).astype(np.uint8)
    for lost in (0.1, 0.5, 0.9):
        assert worn(noise, lost, 4.0).mean() / 255.0 == pytest.approx(1.0 - lost, abs=0.02)


def test_a_lens_without_bend_is_the_pinhole_and_one_bent_to_the_end_is_equidistant() -> None:
    intrinsics = Intrinsics(fx_px=200.0, fy_px=180.0, cx_px=255.5, cy_px=127.5)
    points = np.random.default_rng(2).uniform((-1.0, -1.0, 0.6), (1.0, 1.0, 3.0), (50, 3))
    pinhole = CameraModel(intrinsics, WIDTH, HEIGHT).project(points)
    assert WideLens(intrinsics, WIDTH, HEIGHT).project(points) == pytest.approx(pinhole)
    theta = 1.2
    fisheye = WideLens(intrinsics, WIDTH, HEIGHT, 1e-4)
    assert fisheye.project([[math.sin(theta), 0.0, math.cos(theta)]])[0] == pytest.approx(
        (255.5 + 200.0 * theta, 127.5)
    )


@pytest.mark.parametrize("bend", [0.05, 0.5, 1.0])
def test_a_lens_sends_pixels_to_rays_and_back(bend: float) -> None:
    lens = WideLens(Intrinsics(fx_px=250.0, fy_px=180.0, cx_px=250.0, cy_px=100.0), WIDTH, HEIGHT, bend)
    pixels = np.random.default_rng(3).uniform((0, 0), (WIDTH, HEIGHT), (40, 2))
    assert lens.project(lens.rays(pixels)) == pytest.approx(pixels, abs=1e-6)
    assert np.isnan(lens.project([0.0, 0.0, -1.0])).all()


def test_a_lens_with_no_bend_at_all_is_refused() -> None:
    with pytest.raises(ValueError, match="bend"):
        WideLens(Intrinsics(), WIDTH, HEIGHT, 0.0)


@pytest.mark.parametrize("kind", list(Kind))
def test_random_cameras_see_ground_at_the_bottom_and_every_pixel_has_a_ray(kind: Kind) -> None:
    rng = np.random.default_rng(4)
    rows = []
    for _ in range(30):
        camera = random_camera(rng, kind, WIDTH, HEIGHT)
        corners = [(0, 0), (WIDTH - 1, 0), (0, HEIGHT - 1), (WIDTH - 1, HEIGHT - 1)]
        assert np.isfinite(camera.camera.rays(corners)).all()
        ground = camera.px_to_ground([0.5 * WIDTH, HEIGHT - 1.0])
        assert np.isfinite(ground).all()
        rows.append(camera.body_to_px([1e6, 0.0, camera.centre_m[2]])[1])
    assert np.nanstd(rows) > 15.0  # horizons all over the picture


def test_the_ground_under_a_pixel_is_where_the_camera_says() -> None:
    camera = random_camera(np.random.default_rng(9), Kind.SCALE, WIDTH, HEIGHT)
    view = GroundView(camera, farthest=300.0)
    for u, v in ((100, 250), (255, 200), (400, 230)):
        assert view.distance[v, u] == pytest.approx(np.hypot(*camera.px_to_ground([u, v])), rel=0.01)


def test_a_tile_is_laid_in_place_and_repeats() -> None:
    camera, size = level_camera(), 0.5
    ramp = np.repeat((np.arange(512) // 2).astype(np.uint8)[None, :], 512, axis=0)  # brighter along the tile's columns
    seen = GroundView(camera, farthest=300.0).laid(atlas(ramp), size, 0.0, (0.0, 0.0))
    for v in (170, 185, 200, 230, 250):
        x = FOCAL * CAMERA_Z / (v - CY)
        along = (x / size) % 1.0
        if 0.1 < along < 0.9:
            assert seen[v, 255] / 256.0 == pytest.approx(along, abs=0.03)


def test_far_ground_takes_the_tiles_mean_and_no_false_pattern() -> None:
    checks = (np.indices((512, 512)).sum(axis=0) % 2 * 255).astype(np.uint8)
    seen = GroundView(level_camera(), farthest=300.0).laid(atlas(checks), 0.5, 0.3, (0.1, 0.2))
    far = seen[int(CY) + 2 : int(CY) + 15].astype(float)
    assert far.mean() == pytest.approx(127.5, abs=3.0)
    assert far.std() < 5.0


def test_a_ribbon_keeps_its_offsets_and_bends_no_tighter_than_told() -> None:
    rng = np.random.default_rng(11)
    for _ in range(20):
        ribbon = random_ribbon(rng, Kind.SCALE, room=1.5)
        curvature = np.diff(ribbon.heading_rad) / np.diff(ribbon.s)
        assert np.abs(curvature).max() < 1.0 / 1.5
        side = ribbon.place(ribbon.s, 0.7)
        assert np.hypot(*(side - ribbon.points).T) == pytest.approx(0.7)
        assert np.abs(ribbon.points).min(axis=0).max() < 2.0  # the car is on the road


def test_the_straight_frame_at_a_place_of_a_ribbon_touches_it() -> None:
    s = np.arange(0.0, 3.0, 0.001)
    circle = Ribbon(s, np.column_stack((np.sin(s), 1.0 - np.cos(s))), s)  # radius 1, bending left
    at, ahead = 0.5 * math.pi, circle.local(0.5 * math.pi, [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    assert ahead == pytest.approx(np.array([[1.0, 1.0], [1.0, 2.0], [0.0, 1.0]]), abs=2e-3)
    assert circle.place(at, 1.0) == pytest.approx(np.array([0.0, 1.0]), abs=2e-3)


@pytest.mark.parametrize("kind", list(Kind))
def test_most_roads_have_lines_and_a_few_have_none(kind: Kind) -> None:
    rng = np.random.default_rng(12)
    roads = [random_road(rng, kind) for _ in range(120)]
    bare = np.mean([not road.stripes for road in roads])
    assert 0.0 < bare < 0.2
    for road in roads:
        for stripe in road.stripes:
            assert stripe.marking
            assert np.isfinite(stripe.points).all()


@pytest.mark.parametrize("count", [0, 1])
def test_a_line_of_which_hardly_anything_is_left_is_not_painted(count: int) -> None:
    rng = np.random.default_rng(0)
    assert painted(rng, edge_style(rng, Kind.ROAD), np.zeros((count, 2))) == []
