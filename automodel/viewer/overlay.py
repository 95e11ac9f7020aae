"""The estimate of a pipeline drawn on its frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import cv2
import numpy as np

from automodel.curves import Curve
from automodel.geometry import GroundCamera
from automodel.signals import Command, Crossing, LaneEstimate, LaneLine, LaneStatus
from automodel.types import FloatArray, Image

Colour = tuple[int, int, int]  # BGR

# Okabe and Ito 2008: colours that colour-blind people tell apart, lightened where they lie on dark floors
BLUE: Colour = (233, 180, 86)
ORANGE: Colour = (0, 159, 230)
YELLOW: Colour = (66, 228, 240)
PURPLE: Colour = (190, 140, 225)
VERMILION: Colour = (40, 110, 235)
GREY: Colour = (150, 150, 150)
WHITE: Colour = (240, 240, 240)
STATUS_COLOURS = {
    LaneStatus.TRACKING: BLUE,
    LaneStatus.ONE_LINE: YELLOW,
    LaneStatus.COASTING: ORANGE,
    LaneStatus.LOST: VERMILION,
}
LEGEND = (
    ("lines", BLUE), ("points", YELLOW), ("middle, with its bound", ORANGE), ("crossing", PURPLE), ("steering", WHITE)
)  # fmt: skip

_LEGIBLE_WIDTH_PX = 640  # smaller frames are enlarged by a whole factor to about this width
_SAMPLES = 80
_BAND_SHARE = 0.35  # of the band's colour in the picture below it
_LANE_SHARE = 0.15  # the same of the lane between its lines
_STEERED_LANES = 2.0  # length of the steered path
_INSET_HEIGHT, _INSET_LANES = 0.34, (3.0, 1.5)  # of the picture's height; the inset shows so far ahead and to each side
_SHIFT = 4  # bits below the pixel in drawing coordinates
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def draw(
    image: Image,
    estimate: LaneEstimate | None,
    camera: GroundCamera,
    command: Command | None = None,
    reference_x_m: float = 0.0,
    note: str = "",
    wheelbase_m: float | None = None,
) -> Image:
    """The frame in BGR with lines (blue; dashed if not seen), centerline (orange), points and crossing.

    The lane between two lines that are followed is tinted. With `wheelbase_m` the steered path is drawn in white.
    The inset shows the same from above, `_INSET_LANES` lane widths ahead and to each side.

    A translucent band about the centerline is as wide to each side as the offset may be wrong (`offset_bound_m`, drawn
    up to a lane's width); there is none where no bound is stated. Below the picture is a strip with status, pose and
    command. A frame narrower than 480 px is enlarged first; the result has an even size. `reference_x_m` is the
    vehicle's reference point, from which the distance of a crossing is measured; `note` is shown at the end of the
    strip.
    """
    scale = scale_of(image.shape[1])
    canvas = in_colour(image, scale)
    if estimate is not None:
        camera = camera.pitched(estimate.camera_pitch_rad)
        steered = _steered(estimate, command, wheelbase_m)
        _draw_estimate(_Ground(canvas, partial(_seen_from, camera, scale)), estimate, steered, reference_x_m)
        if estimate.pose is not None:
            inset = _inset(canvas, estimate.pose.width_m)
            _draw_estimate(inset, estimate, steered, reference_x_m)
    colour = GREY if estimate is None else STATUS_COLOURS[estimate.status]
    strip = status_strip(canvas.shape[1], status_lines(estimate, command, note), colour, LEGEND)
    return even(np.vstack((canvas, strip)))


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


def _draw_estimate(ground: _Ground, estimate: LaneEstimate, steered: FloatArray | None, reference_x_m: float) -> None:
    pose, left, right = estimate.pose, estimate.left, estimate.right
    if left is not None and right is not None and left.seen and right.seen:
        ground.between(left.curve, right.curve)
    if estimate.centerline is not None and pose is not None and math.isfinite(pose.offset_bound_m):
        ground.band(estimate.centerline, min(pose.offset_bound_m, pose.width_m))
    for line in (left, right):
        if line is not None:
            ground.line(line)
    if estimate.centerline is not None:
        ground.curve(estimate.centerline, ORANGE)
    if steered is not None:
        ground.polyline(steered, WHITE, False)
    if estimate.crossing is not None:
        width_m = pose.width_m if pose is not None else 0.4
        ground.crossing(crossing_ends(estimate.crossing, estimate.centerline, reference_x_m, width_m))


def _steered(estimate: LaneEstimate, command: Command | None, wheelbase_m: float | None) -> FloatArray | None:
    """The path (n, 2) [m] of the rear axle that the command steers; None where nothing is steered or seen."""
    if command is None or wheelbase_m is None or estimate.pose is None:
        return None
    s = np.linspace(0.0, wheelbase_m + _STEERED_LANES * estimate.pose.width_m, _SAMPLES)
    turn = s * math.tan(command.steering_rad) / wheelbase_m
    # the chord of an arc: sinc(turn / 2) long, in half its turn's direction
    return np.column_stack((np.cos(0.5 * turn), np.sin(0.5 * turn))) * (s * np.sinc(turn / math.tau))[:, None]


def _seen_from(camera: GroundCamera, scale: int, points_m: FloatArray) -> FloatArray:
    """Ground points (n, 2) [m] -> pixels (n, 2) of the enlarged frame."""
    return (camera.ground_to_px(points_m) + 0.5) * scale - 0.5


def _inset(canvas: Image, width_m: float) -> _Ground:
    """The dark inset in the upper right corner: the ground from above, the car's rear axle at its lower border."""
    height = round(_INSET_HEIGHT * canvas.shape[0])
    ahead, aside = _INSET_LANES
    width = round(height * 2.0 * aside / ahead)
    margin = max(4, canvas.shape[1] // 80)
    view = canvas[margin : margin + height, canvas.shape[1] - margin - width : canvas.shape[1] - margin]
    view[:] = (0.35 * view).astype(np.uint8)
    px_per_m = height / (ahead * width_m)

    def from_above(points_m: FloatArray) -> FloatArray:
        return np.column_stack((0.5 * width - px_per_m * points_m[:, 1], height - 1.0 - px_per_m * points_m[:, 0]))

    return _Ground(view, from_above)


class _Ground:
    """Draws lines and points of the ground; `project` gives their pixels (n, 2) on the canvas."""

    def __init__(self, canvas: Image, project: Callable[[FloatArray], FloatArray]) -> None:
        self._canvas, self._project = canvas, project
        self._thick = max(2, canvas.shape[1] // 320)

    def line(self, line: LaneLine) -> None:
        self.curve(line.curve, BLUE, dashed=not line.seen)
        radius = self._thick + 1
        for point in self._pixels(line.points_m):
            if np.isfinite(point).all():
                centre = (round(point[0] * 2**_SHIFT), round(point[1] * 2**_SHIFT))
                cv2.circle(self._canvas, centre, radius * 2**_SHIFT, YELLOW, -1, cv2.LINE_AA, _SHIFT)

    def curve(self, curve: Curve, colour: Colour, dashed: bool = False) -> None:
        self.polyline(curve.position(np.linspace(0.0, curve.length_m, _SAMPLES)), colour, dashed)

    def band(self, curve: Curve, half_m: float) -> None:
        """Tint the ground within `half_m` [m] of a curve."""
        s = np.linspace(0.0, curve.length_m, _SAMPLES)
        self._tint(curve.offset_position(s, half_m), curve.offset_position(s, -half_m), ORANGE, _BAND_SHARE)

    def between(self, left: Curve, right: Curve) -> None:
        """Tint the ground between two lines, as far as both are known."""
        length_m = min(left.length_m, right.length_m)
        s = np.linspace(0.0, length_m, _SAMPLES)
        self._tint(left.position(s), right.position(s), BLUE, _LANE_SHARE)

    def _tint(self, left_m: FloatArray, right_m: FloatArray, colour: Colour, share: float) -> None:
        left, right = self._pixels(left_m), self._pixels(right_m)
        there = np.asarray(np.isfinite(left).all(axis=1) & np.isfinite(right).all(axis=1))
        inside = np.zeros(self._canvas.shape[:2], np.uint8)
        for i in np.flatnonzero(there[:-1] & there[1:]):
            corners = np.stack((left[i], left[i + 1], right[i + 1], right[i]))
            cv2.fillConvexPoly(inside, np.round(corners * 2**_SHIFT).astype(np.int32), 1, cv2.LINE_8, _SHIFT)
        tint = np.full_like(self._canvas, colour)
        cv2.copyTo(cv2.addWeighted(self._canvas, 1.0 - share, tint, share, 0.0), inside, self._canvas)

    def crossing(self, ends: tuple[FloatArray, FloatArray]) -> None:
        share = np.linspace(0.0, 1.0, _SAMPLES // 4)[:, None]
        self.polyline(ends[0] + share * (ends[1] - ends[0]), PURPLE, False)

    def polyline(self, points_m: FloatArray, colour: Colour, dashed: bool) -> None:
        """A line through points (n, 2) [m]."""
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
        pixels = self._project(points_m)
        far = 2.0 * max(self._canvas.shape[:2])
        with np.errstate(invalid="ignore"):
            near = np.all(np.abs(pixels) <= far, axis=1)
        return np.where(near[:, None], pixels, np.nan)


def in_colour(image: Image, scale: int) -> Image:
    """A copy in BGR, enlarged by a whole factor."""
    colour = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    if scale > 1:
        colour = cv2.resize(colour, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR)
    return np.array(colour, dtype=np.uint8)


def status_strip(width_px: int, lines: tuple[str, str], colour: Colour, legend: Sequence[tuple[str, Colour]]) -> Image:
    """A dark strip: two lines of text, the first in the colour of the status, as large as fits, and the legend."""
    size = 0.58 * width_px / _LEGIBLE_WIDTH_PX
    margin = max(4, width_px // 80)
    thick = 1 if width_px < 900 else 2
    widest = max(cv2.getTextSize(text, _FONT, size, thick)[0][0] for text in lines)
    size *= min(1.0, (width_px - 2 * margin) / max(widest, 1))
    row = round(25 * width_px / _LEGIBLE_WIDTH_PX) + 4
    strip = np.full((3 * row + margin, width_px, 3), 24, np.uint8)
    for number, (text, ink) in enumerate(zip(lines, (colour, WHITE), strict=True), 1):
        cv2.putText(strip, text, (margin, number * row - row // 5), _FONT, size, ink, thick, cv2.LINE_AA)
    _write_legend(strip, (margin, 3 * row - row // 5), row // 2, legend)
    return strip


def _write_legend(strip: Image, place: tuple[int, int], swatch_px: int, legend: Sequence[tuple[str, Colour]]) -> None:
    """What the colours stand for, from `place` (u, v) on."""
    size, (u, v) = 0.45 * strip.shape[1] / _LEGIBLE_WIDTH_PX, place
    for text, colour in legend:
        strip[v - swatch_px : v, u : u + swatch_px] = colour
        u += swatch_px + swatch_px // 2
        cv2.putText(strip, text, (u, v), _FONT, size, WHITE, 1, cv2.LINE_AA)
        u += cv2.getTextSize(text, _FONT, size, 1)[0][0] + swatch_px


def even(image: Image) -> Image:
    """Padded to an even size: video encoders halve the resolution of the colour channels."""
    height, width = image.shape[:2]
    return np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
