"""One eye of a pair that is dark or stuck is left out, and looked through again once it is good."""

from __future__ import annotations

import numpy as np
import pytest

from automodel.runtime.eye_check import EyeCheck
from automodel.signals import Frame, StereoFrame
from automodel.types import Image

RNG = np.random.default_rng(2)
RAMP = np.tile(np.linspace(20, 220, 160), (90, 1))
ROAD = [(RAMP + RNG.normal(0, 2, RAMP.shape)).clip(0, 255).astype(np.uint8) for _ in range(40)]
DARK = [(2.0 + RNG.normal(0, 2, RAMP.shape)).clip(0, 255).astype(np.uint8) for _ in range(20)]


def pair(index: int, one: Image, other: Image, eye: int = 0) -> StereoFrame:
    """`one` is the image of `eye`."""
    left, right = (one, other) if eye == 0 else (other, one)
    return StereoFrame(t_ns=1000 * index, index=index, left=left, right=right)


def test_two_good_eyes_are_a_pair() -> None:
    check = EyeCheck()
    for index in range(20):
        frame = pair(index, ROAD[index], ROAD[20 + index])
        assert check.step(frame) is frame
    assert (check.trouble, check.warning) == ("", "")


@pytest.mark.parametrize("eye", [0, 1])
@pytest.mark.parametrize("why", ["the image is blank", "the same image again and again"])
def test_a_bad_eye_is_left_out_from_its_first_bad_image_up_to_its_last(eye: int, why: str) -> None:
    check, side = EyeCheck(), ("left", "right")[eye]
    for index in range(20):
        bad = 5 <= index < 15
        spoilt = DARK[index] if why == "the image is blank" else ROAD[4]
        frame = pair(index, spoilt if bad else ROAD[index], ROAD[20 + index], eye)
        seen = check.step(frame)
        assert check.trouble == (f"{side} camera: {why}" if bad else "")
        if not bad:
            assert seen is frame
            continue
        assert isinstance(seen, Frame)
        assert (seen.t_ns, seen.index, seen.eye) == (frame.t_ns, index, 1 - eye)
        assert np.array_equal(seen.image, ROAD[20 + index])
    assert check.warning == f"10 images of the {side} camera were left out: {why}"


def test_of_two_bad_eyes_the_pair_stays_and_what_was_said_last() -> None:
    check = EyeCheck()
    first = pair(0, DARK[0], DARK[1])
    assert check.step(first) is first
    assert check.trouble == ""
    assert isinstance(check.step(pair(1, ROAD[1], DARK[2])), Frame)
    both = pair(2, ROAD[1], DARK[3])
    assert check.step(both) is both
    assert check.trouble == "right camera: the image is blank"
    check.step(pair(3, ROAD[3], ROAD[4]))
    assert check.trouble == ""


def test_two_cameras_without_noise_repeat_their_images_together() -> None:
    check, still = EyeCheck(), pair(0, ROAD[0], ROAD[1])
    assert [check.step(still) is still for _ in range(5)] == [True] * 5


def test_the_image_of_one_camera_alone_stays_and_a_later_pair_is_compared_with_it() -> None:
    check = EyeCheck()
    check.step(pair(0, ROAD[0], ROAD[1]))
    alone = Frame(t_ns=1, index=1, image=ROAD[2], eye=1)
    assert check.step(alone) is alone
    seen = check.step(pair(2, ROAD[3], ROAD[2]))
    assert isinstance(seen, Frame)
    assert seen.eye == 0
    assert check.trouble == "right camera: the same image again and again"
    check.step(Frame(t_ns=3, index=3, image=ROAD[4]))  # the source says by itself why it is alone
    assert check.trouble == ""
