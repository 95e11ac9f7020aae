"""What each stage of a pipeline found, drawn on the images that it was given: a tile a stage."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from automodel.signals import Command, Frame, LaneEstimate, Role, StageMark, StageView, StereoFrame
from automodel.types import Image
from automodel.viewer.overlay import (
    BLUE,
    GREY,
    STATUS_COLOURS,
    VERMILION,
    WHITE,
    YELLOW,
    Colour,
    even,
    in_colour,
    status_lines,
    status_strip,
)

COLOURS: dict[Role, Colour] = {
    Role.EXPECTED: WHITE,
    Role.FOUND: YELLOW,
    Role.USED: BLUE,
    Role.LEFT_OUT: VERMILION,
}
COLUMNS = 2  # of stages, each with an image a camera
_IMAGE_PX = 480  # width of an image in a tile: two stages of a pair are as wide as a screen
_STRIP_PX = 2 * _IMAGE_PX  # of the text below, as legible as the titles
_TITLE_PX = 26
_DIM = 0.6  # of the image's brightness, so that marks stand out
_SHIFT = 4  # bits below the pixel in drawing coordinates
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def draw_stages(
    frame: Frame | StereoFrame,
    views: Sequence[StageView],
    cameras: int,
    estimate: LaneEstimate | None = None,
    command: Command | None = None,
    note: str = "",
) -> Image:
    """A picture in BGR: the stages in their order, `COLUMNS` beside each other, each with the images of all `cameras`.

    Marks have the colour of their role (`COLOURS`). An image that no view is of was not looked at, and says so. Below
    is a strip as that of `overlay.draw`. The picture's size is even, and the same for frames of the same size as long
    as there are views.
    """
    images = {0: frame.left, 1: frame.right} if isinstance(frame, StereoFrame) else {frame.eye: frame.image}
    stages = list(dict.fromkeys(view.stage for view in views)) or [""]
    shown = next(iter(images.values()))
    size = _IMAGE_PX, round(_IMAGE_PX * shown.shape[0] / shown.shape[1])
    tiles = []
    for number, stage in enumerate(stages, 1):
        marks = {view.eye: view.marks for view in views if view.stage == stage}
        tile = [_image(images.get(eye), marks.get(eye), size) for eye in range(cameras)]
        tiles.append(_titled(np.hstack(tile), f"{number} {stage}" if stage else "no stage was reached"))
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % COLUMNS)
    rows = [np.hstack(tiles[first : first + COLUMNS]) for first in range(0, len(tiles), COLUMNS)]
    canvas = np.vstack(rows)
    colour = GREY if estimate is None else STATUS_COLOURS[estimate.status]
    legend = [(role.value, COLOURS[role]) for role in Role]
    strip = status_strip(_STRIP_PX, status_lines(estimate, command, note), colour, legend)
    strip = np.pad(strip, ((0, 0), (0, max(canvas.shape[1] - _STRIP_PX, 0)), (0, 0)), mode="edge")
    return even(np.vstack((canvas, strip[:, : canvas.shape[1]])))


def _image(image: Image | None, marks: Sequence[StageMark] | None, size: tuple[int, int]) -> Image:
    """The image of a camera, with its marks; None where it gave none, or was not looked at."""
    if image is None:
        return _said(np.zeros((size[1], size[0], 3), np.uint8), "no image")
    scale = size[0] / image.shape[1]
    smooth = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
    canvas: Image = np.round(_DIM * cv2.resize(in_colour(image, 1), size, interpolation=smooth)).astype(np.uint8)
    if marks is None:
        return _said(canvas, "not looked at")
    for mark in marks:
        _draw(canvas, mark, scale)
    return canvas


def _draw(canvas: Image, mark: StageMark, scale: float) -> None:
    pixels = (mark.pixels + 0.5) * scale - 0.5
    far = 4.0 * max(canvas.shape[:2])
    with np.errstate(invalid="ignore"):
        there = np.asarray((np.abs(pixels) <= far).all(axis=1))
    places = np.round(np.where(there[:, None], pixels, 0.0) * 2**_SHIFT).astype(np.int32)
    colour = COLOURS[mark.role]
    if mark.joined:
        for i in np.flatnonzero(there[:-1] & there[1:]):
            cv2.polylines(canvas, [places[i : i + 2]], False, colour, 1, cv2.LINE_AA, _SHIFT)
    else:
        for u, v in places[there].tolist():
            cv2.circle(canvas, (u, v), 2 * 2**_SHIFT, colour, -1, cv2.LINE_AA, _SHIFT)


def _titled(tile: Image, title: str) -> Image:
    bar = np.full((_TITLE_PX, tile.shape[1], 3), 24, np.uint8)
    cv2.putText(bar, title, (8, _TITLE_PX - 8), _FONT, 0.55, WHITE, 1, cv2.LINE_AA)
    return np.vstack((bar, tile))


def _said(canvas: Image, text: str) -> Image:
    width = cv2.getTextSize(text, _FONT, 0.7, 1)[0][0]
    place = (canvas.shape[1] - width) // 2, canvas.shape[0] // 2
    cv2.putText(canvas, text, place, _FONT, 0.7, WHITE, 1, cv2.LINE_AA)
    return canvas
