"""A metric grid over the picture: whoever knows the floor sees at once whether it lies on it."""

from __future__ import annotations

import cv2
import numpy as np

from automodel.geometry import GroundCamera
from automodel.types import FloatArray, Image
from calibration.ground import distances_m
from calibration.pictures import in_bgr, write_text

__all__ = ["ground_picture"]


_LINE, _AXIS, _SEEN, _MODEL = (110, 210, 110), (60, 170, 255), (80, 80, 255), (255, 220, 60)


def ground_picture(
    image: Image, camera: GroundCamera, points_m: FloatArray | None = None, pixels: FloatArray | None = None
) -> Image:
    """The picture (h, w) or (h, w, 3) with lines of equal x and of equal y [m] of the body frame, the x axis bold.

    With measured `points_m` (n, 2) and their `pixels` (n, 2): where each was seen (a ring) and where the camera that
    was found expects it (a cross).
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
    """Draw a line on the ground; returns the ends (2, 2) of what of it lies in the picture."""
    pixels = camera.ground_to_px(line_m)
    inside = camera.camera.inside(pixels)
    near = inside | np.append(inside[1:], False) | np.append(False, inside[:-1])  # one beyond the picture's edge, too
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
