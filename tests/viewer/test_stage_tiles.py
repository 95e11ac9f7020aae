"""The stages of a pipeline as tiles: where marks lie, what is said of an eye without an image, and one size for all."""

from __future__ import annotations

import numpy as np
import pytest

from automodel.signals import Frame, LaneEstimate, LaneStatus, Role, StageMark, StageView, StereoFrame
from automodel.viewer.stage_tiles import COLOURS, draw_stages

GREY = np.full((90, 160), 100, np.uint8)
PAIR = StereoFrame(t_ns=0, index=0, left=GREY, right=GREY)
WIDTH, HEIGHT, TITLE = 480, 270, 26  # of an image in a tile: three times as large


def view(stage: str, eye: int, *marks: StageMark) -> StageView:
    return StageView(stage=stage, eye=eye, marks=marks)


def mark(role: Role, *pixels: tuple[float, float], joined: bool = False) -> StageMark:
    return StageMark(role=role, pixels=np.array(pixels), joined=joined)


def place(stage: int, eye: int, u: float, v: float) -> tuple[int, int]:
    """Row and column of an image's pixel in the tile of a stage of a pair."""
    row = stage // 2 * (HEIGHT + TITLE) + TITLE + 3 * (v + 0.5)
    return int(row), int((stage % 2) * 2 * WIDTH + eye * WIDTH + 3 * (u + 0.5))


def test_points_and_lines_have_the_colour_of_their_role_in_the_tile_of_their_stage_and_eye() -> None:
    views = [
        view("a", 0, mark(Role.FOUND, (40, 30))),
        view("b", 0),
        view("c", 0, mark(Role.LEFT_OUT, (100, 60))),
        view("a", 1, mark(Role.USED, (20, 10), (60, 10), joined=True)),
        view("b", 1, mark(Role.EXPECTED, (20, 10), (np.nan, np.nan), (60, 10), joined=True)),
        view("c", 1),
    ]
    picture = draw_stages(PAIR, views, 2)
    assert picture.shape[1] == 4 * WIDTH
    assert picture.shape[0] > 2 * (HEIGHT + TITLE)
    assert tuple(picture[place(0, 0, 40, 30)]) == COLOURS[Role.FOUND]
    assert tuple(picture[place(2, 0, 100, 60)]) == COLOURS[Role.LEFT_OUT]
    assert np.abs(picture[place(0, 1, 40, 10)].astype(int) - COLOURS[Role.USED]).max() < 60
    dim = picture[place(0, 0, 100, 60)]
    assert (dim == 60).all()  # the image itself, darker
    assert (picture[place(1, 1, 40, 10)] == dim).all()  # the gap of a parted line
    assert (picture[place(3, 0, 40, 10)] == 0).all()  # there is no fourth stage


def test_an_eye_that_was_not_looked_at_says_so_and_nothing_changes_the_size() -> None:
    both = [view("a", eye, mark(Role.FOUND, (40, 30))) for eye in (0, 1)]
    sizes = {draw_stages(PAIR, both, 2).shape}
    unseen = draw_stages(PAIR, both[:1], 2)
    text = unseen[TITLE : TITLE + HEIGHT, WIDTH : 2 * WIDTH]
    assert (text == 240).any()
    sizes.add(unseen.shape)
    for eye in (0, 1):
        alone = Frame(t_ns=0, index=0, image=GREY, eye=eye)
        picture = draw_stages(alone, [both[eye]], 2)
        gone = picture[TITLE : TITLE + HEIGHT, (1 - eye) * WIDTH : (2 - eye) * WIDTH]
        assert (gone[0] == 0).all()
        assert (gone == 240).any()
        sizes.add(picture.shape)
    assert len(sizes) == 1


@pytest.mark.parametrize("estimate", [None, LaneEstimate(t_ns=0, status=LaneStatus.LOST)])
def test_one_camera_and_no_stage_at_all(estimate: LaneEstimate | None) -> None:
    picture = draw_stages(Frame(t_ns=0, index=0, image=GREY), [], 1, estimate, None, "7.00 s")
    assert picture.shape[1] == 2 * WIDTH
    assert (picture.shape[0] % 2, picture.shape[1] % 2) == (0, 0)
