"""Pictures of a calibration for people, (h, w, 3) BGR, and the folder that they are written to."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path

import cv2
import numpy as np

from automodel.config import ConfigError
from automodel.console.messages import say
from automodel.geometry import CameraModel, GroundCamera
from automodel.output_files import output_path
from automodel.sources.images import with_channels
from automodel.types import FloatArray, Image
from calibration.ground import distances_m
from calibration.views import CELLS, View, coverage

FOLDER = "calibration_pictures"
_WHITE, _GREY = (255, 255, 255), (90, 90, 90)
_EPIPOLAR_LINES = 12  # of a picture; more hide the board
_LINE, _AXIS, _SEEN, _MODEL = (110, 210, 110), (60, 170, 255), (80, 80, 255), (255, 220, 60)


def picture_folder(out: Path | None, car_file: Path) -> Path:
    """The folder `out`, or `FOLDER` beside car.toml; raises ConfigError where it cannot be created or written."""
    folder = out if out is not None else car_file.parent / FOLDER
    existing = folder
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    if not existing.is_dir():
        raise ConfigError(f"--out {folder}: {existing} is not a folder")
    if not os.access(existing, os.W_OK):
        raise ConfigError(f"--out {folder}: cannot be written; look at the permissions")
    return folder


def write_pictures(folder: Path, pictures: Mapping[str, Image], *, quiet: bool = False) -> None:
    """Write each as `<name>.png` and report its path; raises ConfigError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be written: {error.strerror}") from None
    for name, picture in pictures.items():
        path = folder / f"{name}.png"
        with output_path(path) as part:
            part.write_bytes(cv2.imencode(".png", picture)[1].tobytes())
        if not quiet:
            say(str(path))


def in_bgr(image: Image) -> Image:
    """A copy of an image, (h, w, 3)."""
    return with_channels(image, True).copy()


def write_text(picture: Image, text: str, place: tuple[int, int], scale: float = 1.0) -> None:
    """Text on a dark ground, its lower left corner at `place` (u, v)."""
    size, thickness = 0.55 * scale, max(round(scale), 1)
    (width, height), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, thickness)
    u, v = place
    cv2.rectangle(picture, (u - 3, v - height - 3), (u + width + 3, v + below), (30, 30, 30), -1)
    cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, _WHITE, thickness, cv2.LINE_AA)


def coverage_picture(views: Iterable[View], size: tuple[int, int]) -> Image:
    """Every corner that was seen in images of `size` (w, h), and the cells of the image without any."""
    views = list(views)
    width, height = size
    picture = np.full((height, width, 3), 40, np.uint8)
    counts = coverage(views)
    rows, columns = CELLS
    for row in range(rows):
        for column in range(columns):
            corner = (column * width // columns, row * height // rows)
            other = ((column + 1) * width // columns - 1, (row + 1) * height // rows - 1)
            if counts[row, column]:
                cv2.rectangle(picture, corner, other, (50, 70, 50), -1)
            cv2.rectangle(picture, corner, other, _GREY, 1)
    for number, view in enumerate(views):
        hue = np.array([[[(number * 47) % 180, 190, 255]]], np.uint8)
        colour = tuple(int(c) for c in cv2.cvtColor(hue, cv2.COLOR_HSV2BGR)[0, 0])
        for u, v in np.rint(view.found.corners_px).astype(int):
            cv2.circle(picture, (int(u), int(v)), max(2, width // 400), colour, -1, cv2.LINE_AA)
    seen = 100.0 * float((counts > 0).mean())
    write_text(picture, f"{len(views)} views, {seen:.0f} % of the image", (8, height - 10), width / 1000)
    return picture


def undistorted_picture(image: Image, camera: CameraModel) -> Image:
    """The image beside the same image without distortion, in which straight things are straight."""
    before = in_bgr(image)
    after = np.asarray(cv2.undistort(before, camera.matrix, camera.distortion), np.uint8)
    scale = camera.width_px / 1000
    for picture, text in ((before, "as the camera sees it"), (after, "without distortion")):
        write_text(picture, text, (10, round(10 + 20 * max(scale, 0.5))), max(scale, 0.5))
    return np.hstack((before, after))


def ground_picture(
    image: Image, camera: GroundCamera, points_m: FloatArray | None = None, pixels: FloatArray | None = None
) -> Image:
    """The image (h, w) or (h, w, 3) with a metric grid of the body frame on the ground, its x axis bold.

    With measured `points_m` (n, 2) and their `pixels` (n, 2): a ring where each was seen, and a cross where the
    calibrated camera projects it.
    """
    picture = in_bgr(image)
    full = distances_m(float(camera.centre_m[2]))[0] > 1.0
    step, half, far = (2.5, 5.0, 30.0) if full else (0.25, 1.0, 3.0)
    scale = picture.shape[1] / 1000
    x0, y0 = (float(camera.centre_m[0]), 0.0)
    first = max(step * np.ceil((x0 + 0.02) / step), step)
    for x in np.arange(first, first + far + 0.5 * step, step):
        ends = _draw(picture, camera, np.column_stack((np.full(81, x), np.linspace(-half, half, 81))), _LINE, 1)
        if ends is not None and round(x / step) % 2 == 0:
            right, v = ends[0]
            write_text(
                picture, f"x {x:g} m", (min(int(right) + 4, picture.shape[1] - round(70 * scale)), int(v)), scale
            )
    for y in np.arange(-half, half + 0.5 * step, step):
        axis = abs(y - y0) < 1e-9
        line = np.column_stack((np.geomspace(x0 + 0.1 * step, first + far, 200), np.full(200, y)))
        _draw(picture, camera, line, _AXIS if axis else _LINE, 2 if axis else 1)
    if points_m is not None and pixels is not None:
        _mark(picture, camera.ground_to_px(points_m), pixels, scale)
    write_text(
        picture, f"lines every {step:g} m; bold: straight ahead (y = 0)", (8, round(24 * max(scale, 0.6))), scale
    )
    return picture


def _draw(
    picture: Image, camera: GroundCamera, line_m: FloatArray, colour: tuple[int, int, int], width: int
) -> FloatArray | None:
    """Draw a line on the ground; returns the ends (2, 2) of its visible part."""
    return _draw_px(picture, camera.camera, camera.ground_to_px(line_m), colour, width)


def _draw_px(
    picture: Image, camera: CameraModel, pixels: FloatArray, colour: tuple[int, ...], width: int = 1
) -> FloatArray | None:
    """Draw a line through pixels (n, 2), also outside the image; returns the ends (2, 2) of its visible part."""
    inside = camera.inside(pixels)
    near = inside | np.append(inside[1:], False) | np.append(False, inside[:-1])  # one point beyond the border, too
    run = pixels[near & ~np.isnan(pixels[:, 0])]
    if len(run) < 2:
        return None
    cv2.polylines(picture, [np.rint(run * 16).astype(np.int32)], False, colour, width, cv2.LINE_AA, 4)
    shown = pixels[inside]
    return np.stack((shown[0], shown[-1])) if len(shown) else None


def _mark(picture: Image, expected: FloatArray, seen: FloatArray, scale: float) -> None:
    size = max(round(7 * scale), 3)
    for number, (model, point) in enumerate(zip(expected, seen, strict=True), 1):
        u, v = (round(float(c)) for c in point)
        cv2.circle(picture, (u, v), size, _SEEN, max(round(1.5 * scale), 1), cv2.LINE_AA)
        if np.isfinite(model).all():
            place = (round(float(model[0])), round(float(model[1])))
            cv2.drawMarker(picture, place, _MODEL, cv2.MARKER_CROSS, 2 * size, max(round(scale), 1), cv2.LINE_AA)
        if len(seen) <= 20:
            write_text(picture, str(number), (u + size + 3, v - size), scale)


def epipolar_picture(
    images: tuple[Image, Image],
    cameras: tuple[GroundCamera, GroundCamera],
    corners: tuple[FloatArray, FloatArray],
    error_px: float,
) -> Image:
    """Left and right image (h, w) or (h, w, 3) side by side, with rings at `corners` (n, 2) [px] that both cameras see.

    Through those of the right image go the epipolar lines of the left ones, bent by the lens.
    """
    left, right = (in_bgr(image) for image in images)
    one, other = cameras
    scale = left.shape[1] / 1000
    chosen = np.linspace(0, len(corners[0]) - 1, min(len(corners[0]), _EPIPOLAR_LINES)).astype(int)
    depths_m = np.geomspace(0.01, 1e4, 2000)[:, None]
    for number, (u, v) in zip(chosen, corners[0][chosen], strict=True):
        hue = np.array([[[(int(number) * 47) % 180, 190, 255]]], np.uint8)
        colour = tuple(int(c) for c in cv2.cvtColor(hue, cv2.COLOR_HSV2BGR)[0, 0])
        ray = one.cam_from_body.T @ one.camera.rays((u, v))
        _draw_px(right, other.camera, other.body_to_px(one.centre_m + depths_m * ray), colour)
        for picture, place in ((left, (u, v)), (right, corners[1][number])):
            middle = round(float(place[0])), round(float(place[1]))
            cv2.circle(picture, middle, max(round(7 * scale), 3), colour, max(round(1.5 * scale), 1), cv2.LINE_AA)
    for picture, text in (
        (left, "left: corners"),
        (right, f"right: their epipolar lines; pairs left out: {error_px:.2f} px off"),
    ):
        write_text(picture, text, (8, round(24 * max(scale, 0.6))), scale)
    return np.hstack((left, right))


def lanes_picture(
    images: tuple[Image, Image], cameras: tuple[GroundCamera, GroundCamera], lines_px: FloatArray, ends_px: FloatArray
) -> Image:
    """Left and right image (h, w) or (h, w, 3) side by side: what the left camera sees of the road, and where that is
    in the right one.

    `lines_px` (n, 2) are points of lines in the left image, `ends_px` (m, 2) ends of dashes, which get rings.
    """
    left, right = (in_bgr(image) for image in images)
    one, other = cameras
    scale = left.shape[1] / 1000
    for marks, ends in ((lines_px, False), (ends_px, True)):
        there = other.ground_to_px(one.px_to_ground(marks))
        for picture, camera, pixels in ((left, one, marks), (right, other, there)):
            for u, v in np.rint(pixels[camera.camera.inside(pixels)]).astype(int).tolist():
                size = max(round(7 * scale), 3) if ends else max(round(2 * scale), 1)
                cv2.circle(picture, (u, v), size, _SEEN if ends else _LINE, 1 if ends else -1, cv2.LINE_AA)
    for picture, text in (
        (left, "left: lines, and ends of dashes (rings)"),
        (right, "right: the same points of the ground by the calibration"),
    ):
        write_text(picture, text, (8, round(24 * max(scale, 0.6))), scale)
    return np.hstack((left, right))
