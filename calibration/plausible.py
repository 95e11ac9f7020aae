"""Whether a camera that was found can be true: what lenses and sensors are like, and how much was seen."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from automodel.geometry import CameraModel
from automodel.types import FloatArray
from calibration.camera import CameraCalibration
from calibration.views import coverage

__all__ = ["Check", "check_camera", "field_of_view_deg"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """One thing that was looked at; `status` is "OK", "WARN" or "FAIL" (do not use it), `text` what and what to do."""

    name: str
    status: str
    text: str


def check_camera(found: CameraCalibration) -> tuple[Check, ...]:
    """Every check of a calibration, in the order in which a person would ask."""
    return (
        _residual(found),
        _left_out(found),
        _focal_error(found),
        _square_pixels(found),
        _centre(found),
        _lens(found),
        _view_angle(found),
        _coverage(found),
    )


def _graded(name: str, value: float, limits: tuple[float, float], text: str, advice: str) -> Check:
    """OK up to the first limit, FAIL beyond the second; the advice follows where it is not OK."""
    status = "OK" if value <= limits[0] else "WARN" if value <= limits[1] else "FAIL"
    return Check(name=name, status=status, text=text if status == "OK" else f"{text}; {advice}")


def _residual(found: CameraCalibration) -> Check:
    thousandths = 1e3 * found.rms_px / found.width_px
    text = f"{found.rms_px:.2f} px over {len(found.views)} views"
    return _graded("residual", thousandths, (1.0, 4.0), text, "glue the board on something flat, hold both still")


def _left_out(found: CameraCalibration) -> Check:
    ratio = found.cross_validated_px / max(found.rms_px, 1e-9)
    text = f"{found.cross_validated_px:.2f} px in views that had no part in the fit"
    return _graded("views left out", ratio, (1.3, 3.0), text, "too few or too similar views: take more, of all sides")


def _focal_error(found: CameraCalibration) -> Check:
    share = found.focal_std_px / found.intrinsics.fx_px
    text = f"f = {found.intrinsics.fx_px:.1f} +- {found.focal_std_px:.1f} px"
    return _graded("focal length", share, (0.01, 0.05), text, "tilt the board by 20 to 50 deg to all sides")


def _square_pixels(found: CameraCalibration) -> Check:
    share = abs(found.intrinsics.fx_px / found.intrinsics.fy_px - 1.0)
    text = f"fx / fy = {found.intrinsics.fx_px / found.intrinsics.fy_px:.4f}"
    return _graded("square pixels", share, (0.02, 0.2), text, "are the pictures stretched, or too few views tilted?")


def _centre(found: CameraCalibration) -> Check:
    off_u = found.intrinsics.cx_px - 0.5 * (found.width_px - 1)
    off_v = found.intrinsics.cy_px - 0.5 * (found.height_px - 1)
    share = math.hypot(off_u, off_v) / found.width_px
    text = f"({off_u:+.0f}, {off_v:+.0f}) px from the picture's middle"
    return _graded("principal point", share, (0.08, 0.25), text, "are the pictures cropped, or too few views tilted?")


def _lens(found: CameraCalibration) -> Check:
    """The lens must image more of the world further from its middle, out to the picture's corners."""
    rays = CameraModel(found.intrinsics, found.width_px, found.height_px).rays(_border(found))
    if np.isnan(rays).any():
        text = "the lens model folds back inside the picture; show the board in the picture's corners, too"
        return Check(name="distortion", status="FAIL", text=text)
    i = found.intrinsics
    straight = np.stack((rays[:, 0] * i.fx_px + i.cx_px, rays[:, 1] * i.fy_px + i.cy_px), axis=-1)
    shift = float(np.linalg.norm(straight - _border(found), axis=1).max())
    return Check(name="distortion", status="OK", text=f"grows to {shift:.0f} px at the picture's border, monotone")


def _border(found: CameraCalibration) -> FloatArray:
    u, v = np.linspace(0.0, found.width_px - 1.0, 33), np.linspace(0.0, found.height_px - 1.0, 33)
    left, top = np.zeros(33), np.zeros(33)
    edges = ((u, top), (u, top + v[-1]), (left, v), (left + u[-1], v))
    return np.concatenate([np.column_stack(edge) for edge in edges])


def field_of_view_deg(found: CameraCalibration) -> float:
    """The horizontal angle of view, through the picture's middle row; NaN where the lens model folds back."""
    ends = ((0.0, found.intrinsics.cy_px), (found.width_px - 1.0, found.intrinsics.cy_px))
    rays = CameraModel(found.intrinsics, found.width_px, found.height_px).rays(ends)
    return float(np.degrees(np.arctan(rays[1, 0]) - np.arctan(rays[0, 0])))


def _view_angle(found: CameraCalibration) -> Check:
    angle = field_of_view_deg(found)
    text = f"{angle:.0f} deg across"
    if 25.0 <= angle <= 130.0:
        return Check(name="angle of view", status="OK", text=text)
    return Check(name="angle of view", status="WARN", text=f"{text}; lenses of cars have 40 to 120")


def _coverage(found: CameraCalibration) -> Check:
    share = float((coverage(error.view for error in found.views) > 0).mean())
    text = f"{100.0 * share:.0f} % of the picture"
    return _graded("coverage", 1.0 - share, (0.35, 1.0), text, "show the board where there were no corners")
