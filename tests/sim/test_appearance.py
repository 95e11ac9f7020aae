from __future__ import annotations

import dataclasses
import itertools
import math
from typing import Any

import numpy as np
import pytest

from automodel.config import CameraConfig
from automodel.geometry import SE2, GroundCamera
from automodel.sim import appearance as appearance_styles
from automodel.sim.appearance import Appearance, Lamp
from automodel.sim.background import Background
from automodel.sim.coverage import covered
from automodel.sim.ground_light import NEUTRAL, GroundSampler, MipPattern, floor_pattern, wear_pattern
from automodel.sim.ground_projection import GroundProjection
from automodel.sim.renderer import Renderer, SensorEffects, blur_kernel, exposure
from automodel.sim.track_files import load_track

CAMERA = GroundCamera.from_config(CameraConfig())
POSE = load_track("tmr").forward.pose(2.0)
LAMP = Lamp(azimuth_rad=POSE.yaw_rad + 0.2, elevation_rad=0.3, width_rad=0.05, height_rad=0.04, strength=100.0)


def picture(look: Appearance, yaw_offset: float = 0.0) -> np.ndarray:
    track = load_track("tmr")
    renderer = Renderer(track.paint(), track.floor, (), CAMERA, look)
    return renderer.render(POSE.x_m, POSE.y_m, POSE.yaw_rad + yaw_offset, speed_mps=1.0).astype(float)


NEUTRAL_PICTURE = picture(Appearance())


@pytest.mark.parametrize(
    "knobs",
    [
        {"floor_grey": 60.0},
        {"floor_contrast": 1.0, "floor_texture": "tiles"},
        {"surround_grey": 130.0},
        {"marking_grey": 180.0},
        {"wear": 0.2},
        {"dirt": 0.5},
        {"light": 0.7},
        {"gradient": 0.2},
        {"lamps": (LAMP,)},
        {"shine": 0.5},
        {"shadow": 0.6, "shadow_seed": 5},
        {"exposure_step": 0.4},
        {"vignetting": 0.3},
        {"defocus_px": 1.0},
        {"exposure_s": 0.01},
        {"read_noise": 3.0},
        {"shot_noise": 0.2},
        {"background": "hall"},
        {"background": "outdoor", "background_grey": 200.0},
    ],
    ids=lambda knobs: "-".join(knobs),
)
def test_every_knob_does_something_alone(knobs: dict[str, Any]) -> None:
    changed = picture(Appearance(**knobs))
    assert np.isfinite(changed).all()
    assert np.abs(changed - NEUTRAL_PICTURE).mean() > 0.05
    assert 20 < changed.mean() < 120  # and it is still a picture of the same scene
    assert np.corrcoef(changed[180:].ravel(), NEUTRAL_PICTURE[180:].ravel())[0, 1] > 0.5


def test_a_neutral_appearance_is_the_clean_one_and_paints_flat_colours() -> None:
    assert Appearance() == Appearance()
    greys = np.unique(NEUTRAL_PICTURE)
    assert {40.0, 230.0, 130.0} <= set(greys.tolist())
    assert np.isin(NEUTRAL_PICTURE, (40, 130, 230)).mean() > 0.9


@pytest.mark.parametrize("style", ["competition", "road", "varied"])
def test_random_appearances_are_repeatable_and_differ(style: str) -> None:
    assert Appearance.random(5, style) == Appearance.random(5, style)
    looks = [Appearance.random(seed, style) for seed in range(30)]
    for field in dataclasses.fields(Appearance):
        if field.name not in ("yellow_bgr", "floor_texture", "background", "haze"):
            assert len({repr(getattr(look, field.name)) for look in looks}) > 1, field.name


def test_a_range_that_changes_leaves_the_other_knobs_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    before = Appearance.random(11)
    monkeypatch.setitem(appearance_styles.STYLES["competition"], "lamps", lambda rng: (rng.random(99), ())[1])
    monkeypatch.setitem(appearance_styles.STYLES["competition"], "floor_grey", lambda rng: 33.0)
    after = Appearance.random(11)
    assert after.lamps == ()
    assert dataclasses.replace(after, lamps=before.lamps, floor_grey=before.floor_grey) == before


@pytest.mark.parametrize(
    ("knobs", "message"),
    [
        ({"floor_texture": "grass"}, "floor_texture: expected one of plain, .*, got 'grass'"),
        ({"background": "sea"}, "background: expected one of .*, got 'sea'"),
        ({"wear": 1.5}, "wear: expected 0 .. 1"),
        ({"read_noise": -1.0}, "read_noise: expected a number >= 0"),
        ({"defocus_px": math.nan}, "defocus_px: expected a number >= 0"),
        ({"exposure_hold_frames": 0}, "exposure_hold_frames: expected 1 or more"),
    ],
)
def test_impossible_knobs_are_refused(knobs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Appearance(**knobs)


def test_an_unknown_style_is_refused() -> None:
    with pytest.raises(ValueError, match=r"style: expected one of competition, road, varied.*, got 'desert'"):
        Appearance.random(1, "desert")


@pytest.mark.parametrize("grey", [20, 120])
def test_noise_has_the_variance_asked_for(grey: int) -> None:
    look = Appearance(read_noise=2.0, shot_noise=0.1)
    effects = SensorEffects(look, (360, 640), 480.0, 1)
    flat = np.full((360, 640), grey, np.uint8)
    first, second = (effects.apply(flat, 0.0, index).astype(float) for index in (1, 2))
    wanted = 4.0 + 0.1 * grey + 1.0 / 12.0  # and rounding
    assert first.var() == pytest.approx(wanted, rel=0.02)
    assert first.mean() == pytest.approx(grey, abs=0.03)
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.01


@pytest.mark.parametrize(("sigma", "smear"), [(0.8, 0.0), (0.5, 3.3), (1.5, 6.0), (0.0, 2.0)])
def test_blur_kernels_have_the_variance_asked_for(sigma: float, smear: float) -> None:
    kernel = blur_kernel(sigma, smear)
    at = np.arange(len(kernel)) - len(kernel) // 2
    assert len(kernel) % 2 == 1
    assert kernel.sum() == pytest.approx(1.0)
    assert kernel @ at == pytest.approx(0.0, abs=1e-6)
    wanted = sigma**2 + smear**2 / 12.0 + 1.0 / 12.0  # and a pixel's own breadth
    assert kernel @ at**2 == pytest.approx(wanted, abs=0.1)


def test_exposure_jumps_and_holds() -> None:
    look = Appearance(exposure_step=0.3, exposure_hold_frames=20)
    gains = np.array([exposure(look, index) for index in range(2000)]).reshape(100, 20)
    assert (gains == gains[:, :1]).all()
    assert gains.min() < 0.75
    assert gains.max() > 1.25
    assert gains.mean() == pytest.approx(1.0, abs=0.06)
    assert exposure(Appearance(), 77) == 1.0


def test_the_background_moves_with_the_heading() -> None:
    background = Background(CAMERA, GroundProjection(CAMERA).seen, Appearance(background="hall", clutter=1.0))
    turn = math.atan2(100.0, 480.0)
    row = 40  # 139.5 px above the middle: there a turn is no pure shift, so positions are worked out
    ahead, turned = (np.asarray(background.look_up(yaw, False), dtype=float)[row] for yaw in (0.3, 0.3 + turn))
    columns = np.arange(640)
    ray = np.column_stack((columns - 319.5, np.full(640, row - 179.5), np.full(640, 480.0))) @ CAMERA.cam_from_body
    azimuth = np.arctan2(ray[:, 1], ray[:, 0])
    expected = np.interp(azimuth + turn, azimuth[::-1], ahead[::-1])
    middle = slice(120, 400)
    assert turned[middle].std() > 5.0
    assert np.median(np.abs(turned - expected)[middle]) < 0.25 * turned[middle].std()


def test_reflections_lie_in_the_mirrored_direction_and_turn_with_the_car() -> None:
    flat = dataclasses.replace(Appearance(), marking_grey=40.0)
    for heading in (0.0, 0.15):
        seen = picture(dataclasses.replace(flat, lamps=(LAMP,)), yaw_offset=heading) - picture(flat, yaw_offset=heading)
        aim, lift = LAMP.azimuth_rad - POSE.yaw_rad - heading, LAMP.elevation_rad
        mirrored = np.array([math.cos(lift) * math.cos(aim), math.cos(lift) * math.sin(aim), -math.sin(lift)])
        u, v = CAMERA.body_to_px(CAMERA.centre_m + mirrored)
        rows, columns = np.mgrid[0:360, 0:640]
        assert (seen * columns).sum() / seen.sum() == pytest.approx(u, abs=4)
        assert (seen * rows).sum() / seen.sum() == pytest.approx(v, abs=6)
        assert seen.max() == pytest.approx(LAMP.strength, rel=0.05)


def test_floors_keep_their_grey_and_wear_takes_its_share() -> None:
    for kind in ("plain", "plastic", "tiles", "wood", "asphalt", "concrete"):
        pattern = floor_pattern(kind, 0.8, 4)
        assert pattern.mean() == pytest.approx(NEUTRAL, abs=1.5)
        assert pattern.std() > 2.0
    for wear in (0.05, 0.3):
        left = wear_pattern(wear, 0.0, 9)
        assert (left < 128).mean() == pytest.approx(wear, abs=0.03)
    assert (wear_pattern(0.0, 0.0, 9) == 255).all()


def test_patterns_stay_on_the_ground() -> None:
    ground = GroundProjection(CAMERA).ground_m
    sampler, pattern = GroundSampler(ground, 0.002), {"floor": MipPattern(floor_pattern("wood", 1.0, 1))}
    pose, other = SE2(3.3, 5.1, 0.7), SE2(3.35, 5.14, 0.55)
    v, u = np.mgrid[240:350:10, 100:540:10]
    here = sampler.sample(pattern, pose)["floor"][v, u].astype(float)
    pixels = CAMERA.ground_to_px((other.inverse() @ pose).apply(ground[v, u])).round().astype(int)
    ok = CAMERA.camera.inside(pixels, 1.0) & (pixels[..., 1] > 240)
    there = sampler.sample(pattern, other)["floor"][pixels[ok][:, 1], pixels[ok][:, 0]]
    assert ok.sum() > 50
    assert np.corrcoef(here[ok], there)[0, 1] > 0.8


def ring(points: list[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    begin = np.array(points, dtype=float)[::-1]  # v points down: this is anticlockwise to the eye
    return begin, np.roll(begin, -1, axis=0)


def test_covered_areas_are_exact() -> None:
    share = covered(ring([(1.25, 0.5), (3.5, 0.5), (3.5, 2.25), (1.25, 2.25)]), np.ones(4), (4, 5))
    across, down = np.array([0, 0.75, 1, 0.5, 0]), np.array([0.5, 1, 0.25, 0])
    assert share == pytest.approx(np.outer(down, across), abs=1e-6)
    triangle = covered(ring([(0.0, 0.0), (4.0, 0.0), (0.0, 2.0)]), np.ones(3), (2, 4))
    assert triangle == pytest.approx(np.array([[1, 1, 0.75, 0.25], [0.75, 0.25, 0, 0]]), abs=1e-6)


def test_covered_area_does_not_depend_on_where_a_sliver_lies() -> None:
    sliver = np.array([(3.0, 2.0), (40.0, 9.1), (40.0, 9.15), (3.0, 2.05)])
    for du, dv in itertools.product(np.linspace(0.0, 1.0, 7), repeat=2):
        share = covered(ring((sliver + np.array([du, dv])).tolist()), np.ones(4), (14, 45))
        assert share.sum() == pytest.approx(37.0 * 0.05, rel=1e-4)


def test_covered_clips_at_the_picture() -> None:
    huge = ring([(-1e5, -2e5), (3e5, -1e5), (2e5, 1e5), (-3e5, 2e5)])
    assert covered(huge, np.ones(4), (20, 30)) == pytest.approx(np.ones((20, 30)), abs=1e-5)
    beside = ring([(-50.0, 3.0), (-2.0, 3.0), (-2.0, 9.0), (-50.0, 9.0)])
    assert not covered(beside, np.ones(4), (20, 30)).any()
    left = covered(ring([(-50.0, 3.0), (2.0, 3.0), (2.0, 90.0), (-50.0, 90.0)]), np.ones(4), (20, 30))
    assert left[3:, :2] == pytest.approx(np.ones((17, 2)), abs=1e-5)
    assert left.sum() == pytest.approx(34.0, abs=1e-4)
