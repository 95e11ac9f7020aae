"""The estimate of a pipeline drawn on its frame."""

from __future__ import annotations

import math

import cv2
import numpy as np

from automodel.curves import Curve
from automodel.geometry import GroundCamera
from automodel.signals import Command, Crossing, LaneEstimate, LaneLine, LaneStatus
from automodel.types import FloatArray, Image

Colour = tuple[int, int, int]  # BGR

GREEN: Colour = (60, 220, 60)
ORANGE: Colour = (0, 140, 255)
YELLOW: Colour = (0, 255, 255)
MAGENTA: Colour = (255, 60, 255)
GREY: Colour = (150, 150, 150)
WHITE: Colour = (240, 240, 240)
RED: Colour = (60, 60, 255)
STATUS_COLOURS = {
    LaneStatus.TRACKING: GREEN,
    LaneStatus.ONE_LINE: YELLOW,
    LaneStatus.COASTING: ORANGE,
    LaneStatus.LOST: RED,
}

_LEGIBLE_WIDTH_PX = 640  # smaller frames are enlarged by a whole factor to about this width
_SAMPLES = 80
_BAND_SHARE = 0.35  # of the band's colour in the picture below it
_SHIFT = 4  # bits below the pixel in drawing coordinates
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def draw(
    image: Image,
    estimate: LaneEstimate | None,
    camera: GroundCamera,
    command: Command | None = None,
    reference_x_m: float = 0.0,
    note: str = "",
) -> Image:
    """The frame in BGR with lines (green; dashed if not seen), centerline (orange), points and crossing.

    A translucent band about the centerline is as wide to each side as the offset may be wrong (`offset_bound_m`, drawn
    up to a lane's width); there is none where no bound is stated. Below the picture is a strip with status, pose and
    command. A frame narrower than 480 px is enlarged first; the result has an even size. `reference_x_m` is the
    vehicle's reference point, from which the distance of a crossing is measured; `note` is shown at the end of the
    strip.
    """
    scale = scale_of(image.shape[1])
    canvas = _canvas(image, scale)
    if estimate is not None:
        ground = _Ground(canvas, camera, scale)
        pose = estimate.pose
        if estimate.centerline is not None and pose is not None and math.isfinite(pose.offset_bound_m):
            ground.band(estimate.centerline, min(pose.offset_bound_m, pose.width_m))
        for line in (estimate.left, estimate.right):
            if line is not None:
                ground.line(line)
        if estimate.centerline is not None:
            ground.curve(estimate.centerline, ORANGE)
        if estimate.crossing is not None:
            width_m = estimate.pose.width_m if estimate.pose is not None else 0.4
            ground.crossing(crossing_ends(estimate.crossing, estimate.centerline, reference_x_m, width_m))
    colour = GREY if estimate is None else STATUS_COLOURS[estimate.status]
    strip = _strip(canvas.shape[1], status_lines(estimate, command, note), colour)
    return _even(np.vstack((canvas, strip)))


def scale_of(width_px: int) -> int:
    """The whole factor by which a frame is enlarged: 4 for 160 px, 2 for 320 px, 1 from 480 px on."""
    return max(1, math.floor(_LEGIBLE_WIDTH_PX / width_px + 0.5)) if width_px < 480 else 1


def status_lines(estimate: LaneEstimate | None, command: Command | None, note: str) -> tuple[str, str]:
    """The two lines of the strip; missing values are shown as a dash."""
    if estimate is None:
        first = "no estimate"
    elif estimate.pose is None:
        first = estimate.status.value
    else:
        pose = estimate.pose
        first = (
            f"{estimate.status.value:8s}  offset {100 * pose.offset_m:+6.1f}{_bound(100 * pose.offset_bound_m)} cm  "
            f"heading {math.degrees(pose.heading_rad):+5.1f}{_bound(math.degrees(pose.heading_bound_rad))} deg  "
            f"width {100 * pose.width_m:5.1f} cm  curv {pose.curvature_per_m:+5.2f} /m"
        )
    crossing = "-"
    if estimate is not None and estimate.crossing is not None:
        angle_deg = math.degrees(estimate.crossing.angle_rad)
        crossing = f"{estimate.crossing.distance_m:.2f} m at {angle_deg:.0f} deg"
    steer = "-"
    if command is not None:
        steer = f"{math.degrees(command.steering_rad):+5.1f} deg {command.speed_mps:.2f} m/s"
    return first, f"crossing {crossing}  steer {steer}  {note}".rstrip()


def _bound(value: float) -> str:
    return f" +-{value:.1f}" if math.isfinite(value) else ""


def crossing_ends(
    crossing: Crossing, centerline: Curve | None, reference_x_m: float, width_m: float
) -> tuple[FloatArray, FloatArray]:
    """The ends (2,), (2,) [m] of a line across the lane, in the body frame."""
    reference = np.array([reference_x_m, 0.0])
    if centerline is None:
        middle = np.array([reference_x_m + crossing.distance_m, 0.0])
    else:
        middle = centerline.position(centerline.project(reference)[0] + crossing.distance_m)
    half = 0.5 * width_m * np.array([math.cos(crossing.angle_rad), math.sin(crossing.angle_rad)])
    return middle - half, middle + half


class _Ground:
    """Draws lines and points of the ground."""

    def __init__(self, canvas: Image, camera: GroundCamera, scale: int) -> None:
        self._canvas, self._camera, self._scale = canvas, camera, scale
        self._thick = max(2, canvas.shape[1] // 320)

    def line(self, line: LaneLine) -> None:
        self.curve(line.curve, GREEN, dashed=not line.seen)
        radius = self._thick + 1
        for point in self._pixels(line.points_m):
            if np.isfinite(point).all():
                centre = (round(point[0] * 2**_SHIFT), round(point[1] * 2**_SHIFT))
                cv2.circle(self._canvas, centre, radius * 2**_SHIFT, YELLOW, -1, cv2.LINE_AA, _SHIFT)

    def curve(self, curve: Curve, colour: Colour, dashed: bool = False) -> None:
        self._polyline(curve.position(np.linspace(0.0, curve.length_m, _SAMPLES)), colour, dashed)

    def band(self, curve: Curve, half_m: float) -> None:
        """Tint the ground within `half_m` [m] of a curve."""
        s = np.linspace(0.0, curve.length_m, _SAMPLES)
        left, right = (self._pixels(curve.offset_position(s, side_m)) for side_m in (half_m, -half_m))
        there = np.asarray(np.isfinite(left).all(axis=1) & np.isfinite(right).all(axis=1))
        inside = np.zeros(self._canvas.shape[:2], np.uint8)
        for i in np.flatnonzero(there[:-1] & there[1:]):
            corners = np.stack((left[i], left[i + 1], right[i + 1], right[i]))
            cv2.fillConvexPoly(inside, np.round(corners * 2**_SHIFT).astype(np.int32), 1, cv2.LINE_8, _SHIFT)
        tinted = self._canvas[inside > 0]
        self._canvas[inside > 0] = np.round(tinted + _BAND_SHARE * (np.array(ORANGE) - tinted)).astype(np.uint8)

    def crossing(self, ends: tuple[FloatArray, FloatArray]) -> None:
        share = np.linspace(0.0, 1.0, _SAMPLES // 4)[:, None]
        self._polyline(ends[0] + share * (ends[1] - ends[0]), MAGENTA, False)

    def _polyline(self, points_m: FloatArray, colour: Colour, dashed: bool) -> None:
        pixels = self._pixels(points_m)
        there = np.asarray(np.isfinite(pixels).all(axis=1))
        for i in np.flatnonzero(there[:-1] & there[1:]):
            if not (dashed and i // 4 % 2):
                ends = np.round(pixels[i : i + 2] * 2**_SHIFT).astype(np.int32)
                cv2.polylines(self._canvas, [ends], False, colour, self._thick, cv2.LINE_AA, _SHIFT)

    def _pixels(self, points_m: FloatArray) -> FloatArray:
        """Pixels (n, 2) of the canvas; NaN where a point is not visible or far outside."""
        if not len(points_m):
            return np.empty((0, 2))
        pixels = (self._camera.ground_to_px(points_m) + 0.5) * self._scale - 0.5
        far = 2.0 * max(self._canvas.shape[:2])
        with np.errstate(invalid="ignore"):
            near = np.all(np.abs(pixels) <= far, axis=1)
        return np.where(near[:, None], pixels, np.nan)


def _canvas(image: Image, scale: int) -> Image:
    colour = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    if scale > 1:
        colour = cv2.resize(colour, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR)
    return np.array(colour, dtype=np.uint8)


def _strip(width_px: int, lines: tuple[str, str], colour: Colour) -> Image:
    """A dark strip with two lines of text, the first in the colour of the status; as large as the width allows."""
    size = 0.58 * width_px / _LEGIBLE_WIDTH_PX
    margin = max(4, width_px // 80)
    widest = max(cv2.getTextSize(text, _FONT, size, 1)[0][0] for text in lines)
    size *= min(1.0, (width_px - 2 * margin) / max(widest, 1))
    thick = 1 if width_px < 900 else 2
    row = round(25 * width_px / _LEGIBLE_WIDTH_PX) + 4
    strip = np.full((2 * row + margin, width_px, 3), 24, np.uint8)
    for number, (text, ink) in enumerate(zip(lines, (colour, WHITE), strict=True), 1):
        cv2.putText(strip, text, (margin, number * row - row // 5), _FONT, size, ink, thick, cv2.LINE_AA)
    return strip


def _even(image: Image) -> Image:
    """Padded to an even size: video encoders halve the resolution of the colour channels."""
    height, width = image.shape[:2]
    return np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
