"""What a calibration looks like: pictures for people, as arrays (h, w, 3) BGR."""

from __future__ import annotations

import io
from collections.abc import Iterable

import cv2
import numpy as np

from automodel.geometry import CameraModel
from automodel.types import Image
from calibration.camera import CameraCalibration
from calibration.views import CELLS, View, coverage

__all__ = ["coverage_picture", "in_bgr", "residual_picture", "undistorted_picture", "write_text"]


_WHITE, _GREY = (255, 255, 255), (90, 90, 90)


def in_bgr(image: Image) -> Image:
    """A copy (h, w, 3) of a picture."""
    return image.copy() if image.ndim == 3 else np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)


def write_text(picture: Image, text: str, place: tuple[int, int], scale: float = 1.0) -> None:
    """Text on a dark ground, its lower left end at `place` (u, v)."""
    size, thickness = 0.55 * scale, max(round(scale), 1)
    (width, height), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, thickness)
    u, v = place
    cv2.rectangle(picture, (u - 3, v - height - 3), (u + width + 3, v + below), (30, 30, 30), -1)
    cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, _WHITE, thickness, cv2.LINE_AA)


def coverage_picture(views: Iterable[View], size: tuple[int, int]) -> Image:
    """Where in a picture of `size` (w, h) corners were seen: every corner, and the cells that have none."""
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
    write_text(picture, f"{len(views)} views, {seen:.0f} % of the picture", (8, height - 10), width / 1000)
    return picture


def residual_picture(found: CameraCalibration) -> Image:
    """Every corner's miss as an arrow at its place, and every view's error in the fit and left out of it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14, 5.2), layout="constrained", dpi=90)
    FigureCanvasAgg(figure)
    plane, bars = figure.subplots(1, 2, width_ratios=(3, 2))
    corners = np.concatenate([error.view.found.corners_px for error in found.views])
    misses = np.concatenate([error.misses_px for error in found.views])
    grow = 0.04 * found.width_px / max(float(np.quantile(np.linalg.norm(misses, axis=1), 0.95)), 1e-6)
    lengths = np.linalg.norm(misses, axis=1)
    arrows = plane.quiver(
        *corners.T, *(grow * misses).T, lengths, angles="xy", scale_units="xy", scale=1, width=0.002, cmap="viridis"
    )
    figure.colorbar(arrows, ax=plane, label="miss [px]")
    plane.set(xlim=(0, found.width_px), ylim=(found.height_px, 0), aspect="equal", xlabel="u [px]", ylabel="v [px]")
    plane.set_title(f"corners seen minus projected, {grow:.0f} times", fontsize=10)
    place = np.arange(len(found.views))
    bars.barh(place - 0.2, [error.rms_px for error in found.views], 0.4, label=f"in the fit: {found.rms_px:.2f} px")
    label = f"left out of it: {found.cross_validated_px:.2f} px"
    bars.barh(place + 0.2, [error.held_out_px for error in found.views], 0.4, label=label)
    bars.set_yticks(place, [error.view.name for error in found.views], fontsize=7 if len(place) < 40 else 4)
    bars.invert_yaxis()
    bars.set_xlabel("rms [px]")
    bars.legend(fontsize=8)
    png = io.BytesIO()
    figure.savefig(png, format="png")
    return np.asarray(cv2.imdecode(np.frombuffer(png.getvalue(), np.uint8), cv2.IMREAD_COLOR), np.uint8)


def undistorted_picture(image: Image, camera: CameraModel) -> Image:
    """The picture as it is beside the picture without distortion: there straight things are straight."""
    before = in_bgr(image)
    after = np.asarray(cv2.undistort(before, camera.matrix, camera.distortion), np.uint8)
    scale = camera.width_px / 1000
    for picture, text in ((before, "as the camera sees it"), (after, "without distortion")):
        write_text(picture, text, (10, round(10 + 20 * max(scale, 0.5))), max(scale, 0.5))
    return np.hstack((before, after))
