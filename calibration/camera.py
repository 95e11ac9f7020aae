"""The camera's lens from views of a board, with its error in views left out of the fit, and checks of plausibility."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from automodel.config import Intrinsics
from automodel.geometry import CameraModel
from automodel.types import FloatArray
from calibration.boards import Board
from calibration.views import CalibrationError, Refused, View, coverage

FEWEST_VIEWS = 4
_FOLDS = 5
OUTLIER = 3.0  # times the median view's error
OUTLIER_PX = 0.5  # and at least this
_WORTH = 0.995  # k3 is used where it reduces the error of views left out below this share
_SIMPLE, _WITH_K3 = cv2.CALIB_FIX_K3, 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewError:
    """The error of one view: `rms_px` in the fit, `held_out_px` in a fit without it, in which only its pose is fitted.

    `residuals_px` (n, 2): seen corner minus projected one, in the fit.
    """

    view: View
    rms_px: float
    held_out_px: float
    residuals_px: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraCalibration:
    """The camera found, and its accuracy.

    `rms_px`: over all corners of the views used; `cross_validated_px`: the same, each view in a fit without it;
    `focal_std_px`: of fx, by the jackknife over the views left out.
    """

    intrinsics: Intrinsics
    width_px: int
    height_px: int
    rms_px: float
    cross_validated_px: float
    focal_std_px: float
    views: tuple[ViewError, ...]
    dropped: tuple[Refused, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Fit:
    matrix: FloatArray
    distortion: FloatArray  # k1 k2 p1 p2 k3
    residuals_px: tuple[FloatArray, ...]


def calibrate_camera(views: Sequence[View], board: Board) -> CameraCalibration:
    """Focal lengths, centre and distortion (Zhang 2000; Brown's model, k3 only where views left out fit better).

    Views that fit far worse than the others are dropped. Raises CalibrationError for too few views.
    """
    used, dropped = _consistent(list(views), board)
    if len(used) < FEWEST_VIEWS:
        raise CalibrationError(
            f"expected at least {FEWEST_VIEWS} usable views of the board, better 15, got {len(used)}: near and far, "
            "in the corners of the image too, tilted to all sides"
        )
    simple = _cross_validated(used, board, _SIMPLE)
    full = _cross_validated(used, board, _WITH_K3)
    chosen, flags = (full, _WITH_K3) if rms_of(full[0]) < _WORTH * rms_of(simple[0]) else (simple, _SIMPLE)
    fit = _fit(used, board, flags)
    held_out, focal_std_px = chosen
    errors = tuple(
        ViewError(view=view, rms_px=rms_of([inside]), held_out_px=rms_of([outside]), residuals_px=inside)
        for view, inside, outside in zip(used, fit.residuals_px, held_out, strict=True)
    )
    return CameraCalibration(
        intrinsics=intrinsics_of(fit.matrix, fit.distortion),
        width_px=used[0].width_px,
        height_px=used[0].height_px,
        rms_px=rms_of(fit.residuals_px),
        cross_validated_px=rms_of(held_out),
        focal_std_px=focal_std_px,
        views=errors,
        dropped=tuple(dropped),
    )


def intrinsics_of(matrix: FloatArray, distortion: FloatArray) -> Intrinsics:
    """Rounded to what a text file needs: a thousandth of a pixel."""
    (fx, _, cx), (_, fy, cy), _ = matrix
    return Intrinsics(
        fx_px=round(float(fx), 3),
        fy_px=round(float(fy), 3),
        cx_px=round(float(cx), 3),
        cy_px=round(float(cy), 3),
        distortion=tuple(round(float(k), 6) for k in distortion),
    )


def _consistent(views: list[View], board: Board) -> tuple[list[View], list[Refused]]:
    """Drops the views that fit badly, the worst first: their corners are wrong, or the board was bent."""
    dropped: list[Refused] = []
    while len(views) >= max(FEWEST_VIEWS, 4 * len(dropped)):
        errors = np.array([rms_of([residuals]) for residuals in _fit(views, board, _SIMPLE).residuals_px])
        worst = int(np.argmax(errors))
        usual = float(np.median(errors))
        if errors[worst] < max(OUTLIER * usual, OUTLIER_PX):
            break
        reason = f"does not fit the others: error {errors[worst]:.1f} px, median {usual:.1f} px"
        dropped.append(Refused(name=views[worst].name, reason=reason, found=views[worst].found))
        del views[worst]
    return views, dropped


def _cross_validated(views: Sequence[View], board: Board, flags: int) -> tuple[list[FloatArray], float]:
    """Misses (n, 2) of every view in a fit without it, and the standard deviation of fx [px] by the jackknife."""
    folds = min(_FOLDS, len(views))
    residuals: list[FloatArray] = [np.empty((0, 2))] * len(views)
    focals = []
    for fold in range(folds):
        fit = _fit([view for i, view in enumerate(views) if i % folds != fold], board, flags)
        focals.append(fit.matrix[0, 0])
        for i in range(fold, len(views), folds):
            residuals[i] = _left_out(views[i], board, fit)
    return residuals, float(np.sqrt((folds - 1) * np.var(focals)))


def _fit(views: Sequence[View], board: Board, flags: int) -> _Fit:
    points = [board.points_m(view.found.grid).astype(np.float32) for view in views]
    corners = [view.found.corners_px.astype(np.float32) for view in views]
    size = (views[0].width_px, views[0].height_px)
    try:
        _, matrix, distortion, rotations, shifts = cv2.calibrateCamera(points, corners, size, None, None, flags=flags)
    except cv2.error as error:
        raise CalibrationError(f"the views do not determine a camera: {error.err}") from None
    lens = np.asarray(distortion, np.float64).ravel()[:5]
    residuals = tuple(
        view.found.corners_px - _projected(board.points_m(view.found.grid), r, t, matrix, lens)
        for view, r, t in zip(views, rotations, shifts, strict=True)
    )
    if not all(np.isfinite(residual).all() for residual in residuals):
        raise CalibrationError("the views do not determine a camera: tilt the board to all sides, near and far")
    return _Fit(matrix=np.asarray(matrix, np.float64), distortion=lens, residuals_px=residuals)


def _left_out(view: View, board: Board, fit: _Fit) -> FloatArray:
    """The residuals of a view left out of the fit, in which only the board's pose is fitted."""
    points, corners = board.points_m(view.found.grid), view.found.corners_px
    _, rotation, shift = cv2.solvePnP(points, corners, fit.matrix, fit.distortion)
    return corners - _projected(points, rotation, shift, fit.matrix, fit.distortion)


def _projected(
    points: FloatArray, rotation: object, shift: object, matrix: object, distortion: FloatArray
) -> FloatArray:
    pixels, _ = cv2.projectPoints(points, rotation, shift, matrix, distortion)  # type: ignore[call-overload]
    return np.asarray(pixels, np.float64).reshape(-1, 2)


def rms_of(residuals: Sequence[FloatArray]) -> float:
    """Root mean square over corners, as in OpenCV, not over coordinates."""
    return float(np.sqrt(np.mean(np.sum(np.concatenate(residuals) ** 2, axis=1))))


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """One check: `status` is "OK", "WARN" or "FAIL" (do not use the camera), `text` the result and what to do."""

    name: str
    status: str
    text: str


def check_camera(found: CameraCalibration) -> tuple[Check, ...]:
    """All checks of a calibration, the most important first."""
    return (
        _residual(found),
        _left_out_check(found),
        _focal_error(found),
        _square_pixels(found),
        _centre(found),
        _lens(found),
        _view_angle(found),
        _coverage(found),
    )


def graded(name: str, value: float, limits: tuple[float, float], text: str, advice: str) -> Check:
    """OK up to the first limit, FAIL beyond the second; with the advice unless it is OK."""
    status = "OK" if value <= limits[0] else "WARN" if value <= limits[1] else "FAIL"
    return Check(name=name, status=status, text=text if status == "OK" else f"{text}; {advice}")


def _residual(found: CameraCalibration) -> Check:
    thousandths = 1e3 * found.rms_px / found.width_px
    text = f"{found.rms_px:.2f} px over {len(found.views)} views"
    return graded("residual", thousandths, (1.0, 4.0), text, "glue the board on something flat, hold both still")


def _left_out_check(found: CameraCalibration) -> Check:
    ratio = found.cross_validated_px / max(found.rms_px, 1e-9)
    text = f"{found.cross_validated_px:.2f} px in views left out of the fit"
    return graded("views left out", ratio, (1.3, 3.0), text, "too few or too similar views: take more, of all sides")


def _focal_error(found: CameraCalibration) -> Check:
    share = found.focal_std_px / found.intrinsics.fx_px
    text = f"f = {found.intrinsics.fx_px:.1f} +- {found.focal_std_px:.1f} px"
    return graded("focal length", share, (0.01, 0.05), text, "tilt the board by 20 to 50 deg to all sides")


def _square_pixels(found: CameraCalibration) -> Check:
    """Some cameras squeeze their images: 16:9 stored as 4:3 has fx / fy = 0.75, as 720x576 it has 0.70."""
    ratio = found.intrinsics.fx_px / found.intrinsics.fy_px
    advice = "right only where the camera squeezes its images; else tilt more views to all sides"
    return graded("square pixels", max(ratio, 1.0 / ratio) - 1.0, (0.02, 0.5), f"fx / fy = {ratio:.4f}", advice)


def _centre(found: CameraCalibration) -> Check:
    off_u = found.intrinsics.cx_px - 0.5 * (found.width_px - 1)
    off_v = found.intrinsics.cy_px - 0.5 * (found.height_px - 1)
    share = math.hypot(off_u, off_v) / found.width_px
    text = f"({off_u:+.0f}, {off_v:+.0f}) px from the middle of the image"
    return graded("principal point", share, (0.08, 0.25), text, "are the images cropped, or too few views tilted?")


def _lens(found: CameraCalibration) -> Check:
    """The distance from the centre must grow with the angle of view, out to the corners of the image."""
    rays = CameraModel(found.intrinsics, found.width_px, found.height_px).rays(_border(found))
    if np.isnan(rays).any():
        text = "the lens model folds back inside the image; show the board in the corners of the image, too"
        return Check(name="distortion", status="FAIL", text=text)
    i = found.intrinsics
    straight = np.stack((rays[:, 0] * i.fx_px + i.cx_px, rays[:, 1] * i.fy_px + i.cy_px), axis=-1)
    shift = float(np.linalg.norm(straight - _border(found), axis=1).max())
    return Check(name="distortion", status="OK", text=f"grows to {shift:.0f} px at the border of the image, monotone")


def _border(found: CameraCalibration) -> FloatArray:
    u, v = np.linspace(0.0, found.width_px - 1.0, 33), np.linspace(0.0, found.height_px - 1.0, 33)
    left, top = np.zeros(33), np.zeros(33)
    edges = ((u, top), (u, top + v[-1]), (left, v), (left + u[-1], v))
    return np.concatenate([np.column_stack(edge) for edge in edges])


def field_of_view_deg(found: CameraCalibration) -> float:
    """The horizontal field of view [deg] through the principal point; NaN where the lens model folds back."""
    ends = ((0.0, found.intrinsics.cy_px), (found.width_px - 1.0, found.intrinsics.cy_px))
    rays = CameraModel(found.intrinsics, found.width_px, found.height_px).rays(ends)
    return float(np.degrees(np.arctan(rays[1, 0]) - np.arctan(rays[0, 0])))


def _view_angle(found: CameraCalibration) -> Check:
    angle = field_of_view_deg(found)
    text = f"{angle:.0f} deg across"
    if 25.0 <= angle <= 130.0:
        return Check(name="angle of view", status="OK", text=text)
    return Check(name="angle of view", status="WARN", text=f"{text}; usual lenses have 40 to 120")


def _coverage(found: CameraCalibration) -> Check:
    share = float((coverage(error.view for error in found.views) > 0).mean())
    text = f"{100.0 * share:.0f} % of the image"
    return graded("coverage", 1.0 - share, (0.35, 1.0), text, "show the board where there were no corners")
