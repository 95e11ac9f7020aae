from __future__ import annotations

import numpy as np
import pytest

from automodel.runtime.input_checks import FLAT_LEVELS, ImageCheck, contrast

MS = 1_000_000
PERIOD_NS = 16_666_667
HEIGHT, WIDTH = 90, 160


def road(seed: int = 0, noise: float = 2.0) -> np.ndarray:
    """A bright line on a dark floor, with a sensor's noise."""
    picture = np.full((HEIGHT, WIDTH), 60.0)
    picture[:, 70:76] = 200.0
    return np.clip(picture + np.random.default_rng(seed).normal(0.0, noise, picture.shape), 0, 255).astype(np.uint8)


def blank(level: float, noise: float, seed: int = 0) -> np.ndarray:
    noisy = level + np.random.default_rng(seed).normal(0.0, noise, (HEIGHT, WIDTH))
    return np.clip(noisy, 0, 255).astype(np.uint8)


def said(pictures: list[np.ndarray], period_ns: int = PERIOD_NS, noiseless: bool = False) -> list[str | None]:
    check = ImageCheck(WIDTH, HEIGHT, 0.06, noiseless=noiseless)
    return [check.step(picture, index * period_ns) for index, picture in enumerate(pictures)]


def test_pictures_of_a_road_are_well() -> None:
    assert said([road(seed) for seed in range(20)]) == [None] * 20


def test_a_picture_that_repeats_is_told_when_the_last_new_one_is_as_old_as_a_frame_may_be() -> None:
    texts = said([road(0), *[road(1)] * 6])
    # picture 1 was new at 16.7 ms; 66.7 ms and 83.3 ms later pictures 5 and 6 are still the same
    assert [text is not None for text in texts] == [False] * 5 + [True, True]
    assert texts[5] == "the camera repeats the same image for 0.067 s"


@pytest.mark.parametrize(("period_ms", "first"), [(16, 4), (20, 3), (33, 2), (50, 2)])
def test_the_time_counts_not_the_number_of_pictures(period_ms: int, first: int) -> None:
    texts = said([road(0)] * 8, period_ns=period_ms * MS)
    assert [index for index, text in enumerate(texts) if text is not None] == list(range(first, 8))


def test_one_bit_makes_another_picture() -> None:
    pictures = []
    for index in range(20):
        picture = road(0).copy()
        picture[17, 31] ^= index % 2
        pictures.append(picture)
    assert said(pictures) == [None] * 20


def test_a_camera_that_has_no_noise_may_see_the_same_picture_for_ever() -> None:
    assert said([road(0)] * 50, noiseless=True) == [None] * 50
    assert said([blank(9.0, 0.0)] * 5, noiseless=True) == ["the image is blank"] * 5


def test_the_first_other_picture_makes_it_well() -> None:
    texts = said([*[road(0)] * 10, road(1), road(2)])
    assert texts[9] is not None
    assert texts[10:] == [None, None]


@pytest.mark.parametrize("level", [0.0, 2.0, 50.0, 128.0, 253.0, 255.0])
@pytest.mark.parametrize("noise", [0.0, 2.0, 5.0])
def test_blank_pictures_are_told_after_the_same_time(level: float, noise: float) -> None:
    texts = said([road(0), *(blank(level, noise, seed) for seed in range(6))])
    assert [text is not None for text in texts] == [False] * 4 + [True] * 3
    assert texts[4] == "the image is blank for 0.067 s"


def test_blank_from_the_first_picture_on_is_told_at_once() -> None:
    assert said([blank(0.0, 2.0)]) == ["the image is blank"]


def test_single_bad_pictures_are_ridden_through() -> None:
    pictures = []
    for index in range(30):
        pictures.append(blank(0.0, 1.0) if index % 3 else road(index))
    assert said(pictures) == [None] * 30


def test_contrast_is_that_of_the_brightest_and_the_darkest_part() -> None:
    halves = np.zeros((180, 320, 3), dtype=np.uint8)
    halves[:90, :, 1] = 40
    assert contrast(halves) == 40
    assert contrast(np.full((37, 61), 9, dtype=np.uint8)) == 0
    assert contrast(blank(100.0, 5.0)) < FLAT_LEVELS


def test_the_size_must_be_the_cameras() -> None:
    check = ImageCheck(WIDTH, HEIGHT, 0.06)
    assert check.misfit(road()) is None
    assert check.misfit(np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)) is None
    assert check.misfit(road()[:45]) == "the image has 160x45 pixels; the camera has 160x90"
    assert check.misfit(road().T) is not None
