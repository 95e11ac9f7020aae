"""Sheets of paper at a measured place on the floor, boards and ArUco markers, as ground points."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from automodel.config import Extrinsics
from automodel.geometry import CameraModel
from automodel.geometry.se2 import SE2
from automodel.sources.images import with_channels
from automodel.types import FloatArray, Image
from calibration.boards import DICTIONARIES, Board, dictionary_of, find_board
from calibration.ground import GroundCalibration, GroundPoints, camera_from_points
from calibration.views import CalibrationError

_CORNER_PX = 0.5  # one sigma of a corner, including that of paper which is not quite flat
_MOST_TURNED_RAD = math.radians(40.0)  # yaw of the camera; beyond it the sheet's quarter turn is ambiguous


@dataclass(frozen=True, slots=True, kw_only=True)
class ArucoSheet:
    """`columns` x `rows` markers, `gap_m` apart, numbered from 0 row by row; a single one may have any number."""

    columns: int
    rows: int
    marker_m: float
    gap_m: float
    dictionary: str = "4x4_50"

    def __post_init__(self) -> None:
        if not (1 <= self.columns <= 30 and 1 <= self.rows <= 30):
            raise ValueError(f"expected an ArUco sheet of 1 .. 30 markers each way, got {self.columns}x{self.rows}")
        if not self.marker_m > 0.0 or not self.gap_m >= 0.0:
            raise ValueError(
                f"ArUco sheet: expected a marker > 0 and a gap >= 0, got {self.marker_m} m, {self.gap_m} m"
            )
        if self.dictionary not in DICTIONARIES:
            raise ValueError(f"expected a dictionary of {', '.join(DICTIONARIES)}, got {self.dictionary!r}")


@dataclass(frozen=True, slots=True, kw_only=True)
class SheetPlace:
    """The sheet's middle in the body frame, its rotation and their accuracy (one sigma).

    `turn_rad` is anticlockwise; quarter turns are resolved by `camera_from_sheet`.
    """

    x_m: float
    y_m: float = 0.0
    turn_rad: float = 0.0
    accuracy_m: float = 0.003
    accuracy_rad: float = 0.01


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenSheet:
    """Points (n, 2) [m] of a sheet about its middle (x right, y towards its lower edge) and their pixels (n, 2)."""

    points_m: FloatArray
    pixels: FloatArray


def find_sheet(image: Image, sheet: Board | ArucoSheet) -> SeenSheet | None:
    """The sheet in an image, None without it; a chessboard only as a whole, since a part has no known middle."""
    if isinstance(sheet, ArucoSheet):
        return _find_markers(image, sheet)
    found = find_board(image, sheet)
    if found is None or (sheet.marker_m is None and (found.columns, found.rows) != (sheet.columns, sheet.rows)):
        return None
    middle = 0.5 * np.array((sheet.columns - 1, sheet.rows - 1))
    return SeenSheet(points_m=(found.grid - middle) * sheet.square_m, pixels=found.corners_px)


def _find_markers(image: Image, sheet: ArucoSheet) -> SeenSheet | None:
    grey = with_channels(image, False)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_CONTOUR  # other methods may be wrong by 10 px
    detector = cv2.aruco.ArucoDetector(dictionary_of(sheet.dictionary), parameters)
    corners, ids, _ = detector.detectMarkers(grey)
    if ids is None:
        return None
    found = sorted(zip(np.ravel(ids).tolist(), corners, strict=True), key=lambda pair: pair[0])
    if sheet.columns * sheet.rows == 1:
        found = [(0, found[0][1])] if len(found) == 1 else []
    pitch, side = sheet.marker_m + sheet.gap_m, 0.5 * sheet.marker_m
    square = np.array([(-side, -side), (side, -side), (side, side), (-side, side)])  # in the order of the detector
    points, pixels = [], []
    for number, quad in found:
        row, column = divmod(number, sheet.columns)
        if row < sheet.rows:
            points.append(square + pitch * np.array((column - 0.5 * (sheet.columns - 1), row - 0.5 * (sheet.rows - 1))))
            pixels.append(_refined(grey, np.asarray(quad, np.float32).reshape(4, 2)))
    if not points:
        return None
    return SeenSheet(points_m=np.concatenate(points), pixels=np.concatenate(pixels))


def _refined(grey: Image, quad: NDArray[np.float32]) -> FloatArray:
    """A marker's corners to sub-pixel accuracy: the detector takes sides for straight that the lens bends."""
    side = float(np.linalg.norm(np.diff(quad, axis=0), axis=1).min())
    window = max(2, min(5, round(side / 8.0)))
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 0.001)
    return np.asarray(cv2.cornerSubPix(grey, quad.reshape(4, 1, 2), (window, window), (-1, -1), stop), np.float64)[:, 0]


def camera_from_sheet(
    seen: SeenSheet, place: SheetPlace, camera: CameraModel, mounting: Extrinsics, keep_position: bool = False
) -> tuple[GroundCalibration, GroundPoints]:
    """The camera that sees the sheet, and the sheet's points on the floor.

    Of the four quarter turns of the sheet the one with a camera that looks ahead is taken. Raises CalibrationError as
    `camera_from_points` does, and where no camera looks ahead.
    """
    found = []
    refusal = CalibrationError("no camera that looks ahead sees the sheet; are its place and rotation right?")
    for quarter in range(4):
        measured = GroundPoints(
            points_m=_on_floor(seen.points_m, place, quarter),
            pixels=seen.pixels,
            point_m=0.0,
            pixel_px=_CORNER_PX,
            shift_m=place.accuracy_m,
            turn_rad=place.accuracy_rad,
        )
        try:
            found.append((camera_from_points(measured, camera, mounting, keep_position), measured))
        except CalibrationError as error:
            refusal = error
    if not found:
        raise refusal
    ahead, measured = min(found, key=lambda pair: abs(pair[0].extrinsics.yaw_rad))
    if abs(ahead.extrinsics.yaw_rad) > _MOST_TURNED_RAD:
        raise CalibrationError(
            f"the camera would look {math.degrees(ahead.extrinsics.yaw_rad):.0f} deg left of straight ahead; lay "
            f"the sheet with its edges along and across the car, or give its rotation"
        )
    return ahead, measured


def _on_floor(points_m: FloatArray, place: SheetPlace, quarter: int) -> FloatArray:
    """Points of the sheet in the body frame: its right is the car's right, its lower edge nearest, then rotated."""
    lying = np.column_stack((-points_m[:, 1], -points_m[:, 0]))
    return SE2(place.x_m, place.y_m, place.turn_rad + quarter * 0.5 * math.pi).apply(lying)
