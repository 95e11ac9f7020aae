"""The motion of a camera over a textured floor: images are drawn from the floor's map, for a pose that is known."""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
import pytest

from automodel.config import CarConfig
from automodel.estimation.image_motion import ImageMotion
from automodel.geometry import SE2, GroundCamera
from automodel.signals import Frame, Motion, MotionSource
from automodel.types import FloatArray, Image

CAR = CarConfig()
CAMERA = GroundCamera.from_config(CAR.camera)
HEIGHT, WIDTH, LANE = CAR.camera.height_px, CAR.camera.width_px, CAR.lane.width_m
RATE_HZ = 30.0
PX_PER_M, SIDE_PX = 250.0, 1500
PIXELS: FloatArray = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=-1).reshape(-1, 2).astype(float)
GROUND = CAMERA.px_to_ground(PIXELS)


def floor(contrast: float = 40.0) -> Image:
    """A map of 6 x 6 m with spots of a few centimetres."""
    rough = np.random.default_rng(7).normal(size=(SIDE_PX, SIDE_PX))
    spots = cv2.GaussianBlur(rough, (0, 0), 3.0)
    return np.clip(110.0 + contrast * spots / spots.std(), 0, 255).astype(np.uint8)


def drawn(floor_map: Image, pose: SE2, noise: int = 0) -> Image:
    """What the camera sees from a pose; `noise` is a seed, 0 for none."""
    known = np.asarray(np.isfinite(GROUND).all(axis=1))
    places = pose.apply(np.where(known[:, None], GROUND, 0.0)) * PX_PER_M + 0.5 * SIDE_PX
    u, v = (places[:, i].reshape(HEIGHT, WIDTH).astype(np.float32) for i in (0, 1))
    image = cv2.remap(floor_map, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    grey: FloatArray = np.where(known.reshape(HEIGHT, WIDTH), image, 90).astype(np.float64)
    if noise:
        grey = grey + np.random.default_rng(noise).normal(0.0, 3.0, grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def frames(speed: float, yaw_rate: float, count: int, floor_map: Image, noisy: bool = True) -> list[Frame]:
    pose, seen = SE2(0.0, 0.0, 0.4), []
    for index in range(count):
        image = drawn(floor_map, pose, index + 1 if noisy else 0)
        seen.append(Frame(t_ns=round(index * 1e9 / RATE_HZ), index=index, image=image))
        pose = pose @ SE2.arc(speed / RATE_HZ, yaw_rate / RATE_HZ)
    return seen


def unknown(frame: Frame) -> Motion:
    return Motion(t_ns=frame.t_ns, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)


def watched(seen: list[Frame], camera: GroundCamera = CAMERA) -> list[Motion]:
    looking = ImageMotion(camera, LANE)
    return [looking.step(frame, unknown(frame)) for frame in seen]


@pytest.mark.parametrize(("speed", "yaw_rate"), [(0.6, 0.0), (1.0, 0.7), (0.5, -1.2), (-0.3, 0.2)])
def test_the_motion_is_that_of_the_camera_over_the_floor(speed: float, yaw_rate: float) -> None:
    told = watched(frames(speed, yaw_rate, 8, floor()))[3:]
    assert all(motion.source is MotionSource.IMAGES for motion in told)
    assert np.mean([motion.speed_mps for motion in told]) == pytest.approx(speed, abs=0.03)
    assert np.mean([motion.yaw_rate_radps for motion in told]) == pytest.approx(yaw_rate, abs=0.03)


def test_a_car_that_stands_is_seen_to_stand() -> None:
    told = watched(frames(0.0, 0.0, 6, floor()))[2:]
    assert all(motion.known for motion in told)
    assert [motion.speed_mps for motion in told] == pytest.approx([0.0] * len(told), abs=0.02)


def test_noise_on_a_bare_floor_is_no_motion() -> None:
    bare = floor(contrast=0.0)
    assert not any(motion.known for motion in watched(frames(0.8, 0.3, 6, bare)))


def bare_road() -> Image:
    """A floor without texture on which two lines run as `frames` drives with no yaw rate."""
    y, x = (np.mgrid[0:SIDE_PX, 0:SIDE_PX] - 0.5 * SIDE_PX) / PX_PER_M
    aside = np.abs(np.abs(y * math.cos(0.4) - x * math.sin(0.4)) - 0.5 * LANE)  # from the middle of the nearest line
    paint = np.clip((0.01 - aside) * PX_PER_M / 2.0 + 0.5, 0.0, 1.0)
    return (110.0 + 120.0 * paint).round().astype(np.uint8)


@pytest.mark.parametrize("speed", [0.4, 0.8, 1.6])
def test_lines_on_a_bare_floor_contradict_no_right_motion_and_bear_out_no_standstill(speed: float) -> None:
    """They look the same from one frame to the next: no window tells how they move along themselves."""
    seen = frames(speed, 0.0, 8, bare_road())
    assert agrees(seen, speed, 0.0) <= {True, None}
    assert agrees(seen, 0.0, 0.0) <= {False, None}


def test_spots_so_far_ahead_that_all_motions_agree_with_them_contradict_none() -> None:
    """Two lamps that stand are not enough, and the spots add nothing to them."""
    far = np.array([(1.35, 0.2 * i) for i in (-1.5, -0.5, 0.5, 1.5)])
    pixels = CAMERA.ground_to_px(far)
    assert np.hypot(*(CAMERA.ground_to_px(far - (0.2 / RATE_HZ, 0.0)) - pixels).T).max() < 1.0
    image = np.full((HEIGHT, WIDTH), 90, np.uint8)
    for u, v in (*pixels.round().astype(int).tolist(), (260, 250), (420, 250)):
        cv2.circle(image, (u, v), 4, 160, -1)
    seen = [Frame(t_ns=round(index * 1e9 / RATE_HZ), index=index, image=image) for index in range(4)]
    assert agrees(seen, 0.2, 0.0) == {None}


def test_lamps_that_are_mirrored_in_the_floor_do_not_stop_the_car() -> None:
    seen = []
    for frame in frames(0.8, 0.4, 8, floor()):  # at the same places in each image
        image = frame.image.copy()
        for u in range(60, WIDTH, 90):
            cv2.circle(image, (u, round(0.55 * HEIGHT)), 12, 250, -1)
        seen.append(dataclasses.replace(frame, image=image))
    told = watched(seen)[3:]
    assert all(motion.known for motion in told)
    assert np.mean([motion.speed_mps for motion in told]) == pytest.approx(0.8, abs=0.05)


def test_a_motion_that_is_known_is_passed_on_and_its_images_are_not_looked_at() -> None:
    looking = ImageMotion(CAMERA, LANE)
    nothing = np.zeros((HEIGHT, WIDTH), np.uint8)
    for index in range(3):
        frame = Frame(t_ns=index * 33_000_000, index=index, image=nothing)
        given = Motion(t_ns=frame.t_ns, speed_mps=1.0, yaw_rate_radps=0.2)
        assert looking.step(frame, given) is given


def test_where_the_odometry_ends_the_images_go_on() -> None:
    seen = frames(0.7, 0.3, 6, floor())
    looking = ImageMotion(CAMERA, LANE)
    for frame in seen[:3]:
        looking.step(frame, Motion(t_ns=frame.t_ns, speed_mps=0.7, yaw_rate_radps=0.3))
    told = [looking.step(frame, unknown(frame)) for frame in seen[3:]]
    assert all(motion.source is MotionSource.IMAGES for motion in told)
    assert told[-1].speed_mps == pytest.approx(0.7, abs=0.05)


def test_a_gap_and_an_image_of_another_size_tell_nothing() -> None:
    seen = frames(0.7, 0.0, 4, floor())
    late = dataclasses.replace(seen[3], t_ns=seen[2].t_ns + 2_000_000_000)
    small = dataclasses.replace(seen[3], image=seen[3].image[::2, ::2].copy())
    for last in (late, small):
        looking = ImageMotion(CAMERA, LANE)
        told = [looking.step(frame, unknown(frame)) for frame in (*seen[:3], last)]
        assert told[2].known
        assert not told[3].known


def test_what_the_right_camera_of_a_pair_sees_alone_is_not_compared_with_what_the_left_one_saw() -> None:
    seen = frames(0.6, 0.3, 16, floor())
    alone = [*seen[:8], *(dataclasses.replace(frame, eye=1) for frame in seen[8:10]), *seen[10:]]
    found = watched(alone)
    assert found[7].source is MotionSource.IMAGES
    assert {one.source for one in found[8:11]} == {MotionSource.NONE}
    assert found[-1].source is MotionSource.IMAGES
    motions = ImageMotion(CAMERA, 0.4)
    told = Motion(t_ns=0, speed_mps=0.6, yaw_rate_radps=0.3)
    motions.step(seen[7], told)
    assert motions.agrees(alone[8], told) is None


def test_colours_and_large_images_are_seen_alike() -> None:
    large = dataclasses.replace(
        CAR.camera,
        width_px=2 * WIDTH,
        height_px=2 * HEIGHT,
        intrinsics=dataclasses.replace(
            CAR.camera.intrinsics,
            fx_px=2.0 * CAR.camera.intrinsics.fx_px,
            fy_px=2.0 * CAR.camera.intrinsics.fy_px,
            cx_px=2.0 * CAR.camera.intrinsics.cx_px + 0.5,
            cy_px=2.0 * CAR.camera.intrinsics.cy_px + 0.5,
        ),
    )
    seen = frames(0.8, 0.5, 7, floor())
    colours = [
        dataclasses.replace(
            frame,
            image=cv2.cvtColor(cv2.resize(frame.image, None, fx=2.0, fy=2.0), cv2.COLOR_GRAY2BGR).astype(np.uint8),
        )
        for frame in seen
    ]
    told = watched(colours, GroundCamera.from_config(large))[-1]
    assert told.speed_mps == pytest.approx(0.8, abs=0.05)
    assert told.yaw_rate_radps == pytest.approx(0.5, abs=math.radians(3.0))


@pytest.mark.parametrize("speed", [1e300, -1e300, 1e9])
@pytest.mark.parametrize("yaw_rate", [0.0, 1e300])
def test_an_absurd_motion_that_was_told_breaks_nothing(speed: float, yaw_rate: float) -> None:
    looking = ImageMotion(CAMERA, LANE)
    for one in frames(0.6, 0.3, 2, floor()):
        told = Motion(t_ns=one.t_ns, speed_mps=speed, yaw_rate_radps=yaw_rate)
        motion = looking.step(one, unknown(one) if one.index else told)
    assert math.isfinite(motion.speed_mps + motion.yaw_rate_radps)


def agrees(seen: list[Frame], speed: float, yaw_rate: float, camera: GroundCamera = CAMERA) -> set[bool | None]:
    """What the ground between neighbouring frames says of a motion."""
    looking, said = ImageMotion(camera, LANE), set()
    for frame in seen:
        told = Motion(t_ns=frame.t_ns, speed_mps=speed, yaw_rate_radps=yaw_rate)
        if frame.index:
            said.add(looking.agrees(frame, told))
        looking.step(frame, told)
    return said


@pytest.mark.parametrize(("speed", "yaw_rate"), [(0.8, 0.0), (0.6, 0.9), (-0.3, 0.2), (0.0, 0.0)])
def test_the_ground_bears_out_a_right_motion(speed: float, yaw_rate: float) -> None:
    assert agrees(frames(speed, yaw_rate, 6, floor()), speed, yaw_rate) == {True}


@pytest.mark.parametrize("told", [(0.0, 0.4), (-0.8, 0.4), (0.4, 0.4), (1.6, 0.4), (0.8, -0.8), (math.nan, 0.4)])
def test_the_ground_contradicts_a_wrong_motion(told: tuple[float, float]) -> None:
    assert agrees(frames(0.8, 0.4, 6, floor()), *told) == {False}


@pytest.mark.parametrize("speed", [1e300, -1e300, 1e9, 20.0, -math.inf])
@pytest.mark.parametrize("yaw_rate", [0.0, 1e300, -1e9, 50.0])
def test_the_ground_contradicts_an_absurd_motion(speed: float, yaw_rate: float) -> None:
    assert agrees(frames(0.8, 0.4, 2, floor()), speed, yaw_rate) == {False}


@pytest.mark.parametrize("ground", [True, False])
def test_lamps_contradict_no_motion_that_some_of_the_ground_bears_out(ground: bool) -> None:
    """Most corners stand still; those of a strip of texture move as the car does, if there is one.

    What stands still in the image may be on the lens as well: it contradicts no motion either.
    """
    seen = []
    for frame in frames(0.8, 0.4, 6, floor(), noisy=False):
        image = np.full_like(frame.image, 90)
        if ground:
            strip = slice(round(0.6 * HEIGHT), HEIGHT)
            image[strip] = frame.image[strip]
        for k, u in enumerate(range(30, WIDTH, 60)):
            cv2.circle(image, (u, round((0.45 + 0.04 * (k % 3)) * HEIGHT)), 6, 140, -1)
        seen.append(dataclasses.replace(frame, image=image))
    said = agrees(seen, 0.8, 0.4)
    assert False not in said if ground else said == {None}


@pytest.mark.parametrize(("glare", "said"), [(90, {None}), (0, {False})])
def test_what_moves_in_a_lamps_glare_contradicts_no_motion(glare: int, said: set[bool | None]) -> None:
    """A wide and soft reflection stands still, and what shines through it seems to move by half."""
    height, width = np.mgrid[0:HEIGHT, 0:WIDTH]
    bell = np.exp(-0.5 * (((height - 0.6 * HEIGHT) / 45.0) ** 2 + ((width - 0.5 * WIDTH) / 45.0) ** 2))
    seen = []
    for frame in frames(0.4, 0.4, 6, floor()):
        noise = np.random.default_rng(frame.index).normal(0.0, 3.0, bell.shape)
        image = np.where(bell > 0.5, frame.image + 0.0, 110.0 + noise) + glare * bell
        seen.append(dataclasses.replace(frame, image=np.clip(np.rint(image), 0, 255).astype(np.uint8)))
    assert agrees(seen, 0.8, 0.4) == said


@pytest.mark.parametrize(("pitch_deg", "height"), [(1.5, 1.0), (-1.5, 1.0), (0.0, 1.08), (0.0, 0.92)])
def test_a_camera_that_is_set_a_little_wrong_contradicts_no_right_motion(pitch_deg: float, height: float) -> None:
    place = CAR.camera.extrinsics
    turned = dataclasses.replace(place, pitch_rad=place.pitch_rad + math.radians(pitch_deg), z_m=height * place.z_m)
    camera = GroundCamera.from_config(dataclasses.replace(CAR.camera, extrinsics=turned))
    assert False not in agrees(frames(0.8, 0.4, 6, floor()), 0.8, 0.4, camera)


def test_a_bare_floor_and_a_first_frame_say_nothing_of_a_motion() -> None:
    assert agrees(frames(0.8, 0.4, 4, floor(contrast=0.0)), 0.8, 0.4) == {None}
    first = frames(0.8, 0.4, 1, floor())[0]
    assert ImageMotion(CAMERA, LANE).agrees(first, Motion(t_ns=0, speed_mps=0.8, yaw_rate_radps=0.4)) is None
