"""Exposure and sharpness of one picture."""

from __future__ import annotations

import math

import cv2
import numpy as np

from automodel.doctor.findings import Finding, fail, okay, skip, warn
from automodel.types import Image

BLACK = 30  # grey level; a picture that is hardly anywhere above it shows nothing
DARK = 70  # markings on a lit floor are far above it
BURNT = 250
BURNT_WARN, BURNT_FAIL = 0.15, 0.5  # share of burnt pixels: a white wall, a lamp; the road itself
FLAT = 25  # grey levels between the darkest and the brightest hundredth: a cap, fog, a wall

REACH_PX = 12  # about an edge, within which its contrast is measured; caps the blur that can be told at some 4 px
CONTRAST = 30  # grey levels across an edge that is measured: noise alone does not reach it
EDGES = 50  # fewer tell nothing
SHARPEST = 20  # percent of the edges that tell of the lens; the others may lie out of its depth or be soft themselves
BLUR_WARN_PX, BLUR_FAIL_PX = 1.9, 3.2
_SMOOTHING_PX = 0.7


def grey_of(image: Image) -> Image:
    """The picture (h, w) of one (h, w) or (h, w, 3) BGR."""
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def judge_exposure(grey: Image) -> Finding:
    """Too dark, burnt out, without contrast, or right; `grey` is uint8 (h, w)."""
    name = "exposure"
    low, middle, bright, high = (float(v) for v in np.percentile(grey, (1, 50, 95, 99)))
    burnt = float((grey >= BURNT).mean())
    levels = f"grey levels {low:.0f} to {high:.0f}, median {middle:.0f}"
    if high < BLACK:
        return fail(name, f"the picture is black: {levels}", "take the cap off the lens, switch a light on")
    if burnt > BURNT_FAIL:
        return fail(name, f"burnt out: {burnt:.0%} of the picture is white", "shade the camera, lower its exposure")
    if high - low < FLAT:
        return fail(name, f"nothing is seen: {levels}", "uncover and clean the lens, point the camera at the road")
    if bright < DARK:
        return warn(name, f"too dark: {levels}", "more light, or a longer exposure (v4l2-ctl --list-ctrls)")
    if burnt > BURNT_WARN:
        return warn(name, f"{burnt:.0%} of the picture is burnt out", "turn lamps away, lower the camera's exposure")
    return okay(name, levels)


def blur_px(grey: Image) -> float | None:
    """How blurred the sharpest edges are: standard deviation [px] of the blur; None where there are too few edges.

    An edge of contrast c that a Gaussian of standard deviation s blurs has the slope c / (s sqrt(2 pi)) at its middle,
    so s comes from contrast and steepest slope, whatever the contrast is. Rows and columns are looked at alike. A
    picture that is sharp to the pixel has about 1, since the pixels themselves and the smoothing against noise blur.
    """
    smooth = cv2.GaussianBlur(grey, (0, 0), _SMOOTHING_PX).astype(np.float32)
    window = np.ones((1, 2 * REACH_PX + 1), np.uint8)
    found = []
    for rows in (smooth, np.ascontiguousarray(smooth.T)):
        if rows.shape[1] <= 2 * REACH_PX:
            continue
        slope = np.zeros_like(rows)
        slope[:, 1:-1] = 0.5 * np.abs(rows[:, 2:] - rows[:, :-2])
        contrast = np.asarray(cv2.dilate(rows, window)) - np.asarray(cv2.erode(rows, window))
        edge = (slope >= np.asarray(cv2.dilate(slope, window))) & (contrast >= CONTRAST)
        edge[:, :REACH_PX] = edge[:, -REACH_PX:] = False
        found.append(contrast[edge] / (slope[edge] * math.sqrt(2.0 * math.pi)))
    blurs = np.concatenate(found) if found else np.empty(0)
    return float(np.percentile(blurs, SHARPEST)) if len(blurs) >= EDGES else None


def judge_sharpness(grey: Image) -> Finding:
    """Whether the lens is in focus; `grey` is uint8 (h, w), taken while the car stands."""
    name = "sharpness"
    blur = blur_px(grey)
    if blur is None:
        return skip(name, "the picture has too few edges to tell", "point the camera at the track and run again")
    what = f"edges are blurred by {blur:.1f} px"
    if blur > BLUR_FAIL_PX:
        return fail(name, what, "focus the lens (turn it in its thread), clean it, take its foil off")
    if blur > BLUR_WARN_PX:
        return warn(name, what, "focus the lens at 1 m while looking at this figure; 1 is sharp")
    return okay(name, what)
