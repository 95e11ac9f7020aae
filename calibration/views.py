"""Which images of a board are good for calibration: sharp, not too slanted, each different from the others."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from automodel.sources.errors import SourceError
from automodel.sources.images import with_channels
from automodel.types import FloatArray, Image
from calibration.boards import Board, FoundBoard, find_board

CELLS = (5, 8)  # rows and columns of cells into which coverage divides the image
_BLURRED_PX = 5.0  # width of a square's edge; a sharp picture has 1 to 2
_SLANT_RAD = math.radians(65.0)
_NEAR_DUPLICATE = 0.015  # mean distance of the corners between two views, in image diagonals
_SMALLEST_PX = 6.0  # distance of neighbouring corners
_MAJORITY = 0.8  # share of the images that must have one size; less are a mixture of two cameras


class CalibrationError(ValueError):
    """The measurements do not give a calibration; the text is one line: what, where, what to do."""


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """One image with a board: its name and size, the corners, and the board's edge width [px] and slant [rad]."""

    name: str
    width_px: int
    height_px: int
    found: FoundBoard
    edge_px: float
    slant_rad: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Refused:
    """An image that is not used, and why."""

    name: str
    reason: str
    found: FoundBoard | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageFeed:
    """Images to calibrate with, by name; an unreadable one is its error. `total` is their number where it is known.

    `live`: they come from the camera of the car, without end.
    """

    images: Iterator[tuple[str, Image | SourceError]]
    live: bool
    total: int | None


class Views:
    """Takes images one after another, and keeps those that are useful."""

    def __init__(self, board: Board) -> None:
        self.board = board
        self.kept: list[View] = []
        self.refused: list[Refused] = []

    def consider(self, name: str, image: Image) -> View | Refused:
        """Look for the board in an image (h, w) or (h, w, 3); keep the view, or return why not."""
        seen = self._judged(name, image)
        if isinstance(seen, View):
            self.kept.append(seen)
        else:
            self.refused.append(seen)
        return seen

    def _judged(self, name: str, image: Image) -> View | Refused:
        found = find_board(image, self.board)
        if found is None:
            return Refused(name=name, reason="no board found")
        if found.columns > self.board.columns or found.rows > self.board.rows:
            reason = f"expected a board of {self.board.size} inner corners, got {found.size}"
            return Refused(name=name, reason=reason, found=found)
        step = _steps_px(found)
        if step.min() < _SMALLEST_PX:
            reason = f"too far away: squares of {step.min():.0f} px"
            return Refused(name=name, reason=reason, found=found)
        slant = slant_rad(found)
        if slant > _SLANT_RAD:
            return Refused(name=name, reason=f"tilted away by {math.degrees(slant):.0f} deg", found=found)
        edge = edge_width_px(image, found, self._margin())
        if edge > _BLURRED_PX:
            return Refused(name=name, reason=f"blurred: edges are {edge:.1f} px wide", found=found)
        height, width = image.shape[:2]
        view = View(name=name, width_px=width, height_px=height, found=found, edge_px=edge, slant_rad=slant)
        twin = next((other.name for other in self.kept if _alike(view, other)), None)
        return view if twin is None else Refused(name=name, reason=f"nearly the same view as {twin}", found=found)

    def _margin(self) -> float:
        """The width of the blank zone beside a square's edge, in squares."""
        marker = self.board.marker_m
        return 0.35 if marker is None else min(0.35, 0.5 * (1.0 - marker / self.board.square_m))


def _pairs(found: FoundBoard) -> tuple[tuple[FloatArray, FloatArray], ...]:
    """Neighbours along rows, and along columns: each a pair of corners (n, 2), (n, 2) [px]."""
    number = {(int(c), int(r)): i for i, (c, r) in enumerate(found.grid)}
    pairs = []
    for dc, dr in ((1, 0), (0, 1)):
        ends = [(i, number[c + dc, r + dr]) for (c, r), i in number.items() if (c + dc, r + dr) in number]
        index = np.array(ends, dtype=np.int64).reshape(-1, 2)
        pairs.append((found.corners_px[index[:, 0]], found.corners_px[index[:, 1]]))
    return tuple(pairs)


def _steps_px(found: FoundBoard) -> FloatArray:
    """The median distance (2,) of neighbouring corners along rows and along columns."""
    lengths = [np.linalg.norm(b - a, axis=1) for a, b in _pairs(found)]
    return np.array([np.median(length) if len(length) else 0.0 for length in lengths])


def edge_width_px(image: Image, found: FoundBoard, margin: float) -> float:
    """The width [px] of the blurred edges between the squares, in the direction in which they are blurred most.

    Rise over steepest slope of the grey level, on profiles across the edge between every two neighbouring corners,
    `margin` squares to both sides; a sharp camera gives 1 to 2.
    """
    grey = with_channels(image, False)
    widths = []
    for a, b in _pairs(found):
        if len(a) == 0:
            continue
        along = b - a
        length = np.linalg.norm(along, axis=1, keepdims=True)
        normal = np.column_stack((-along[:, 1], along[:, 0])) / length
        reach = np.maximum(margin * length, 2.5)
        offsets = np.linspace(-1.0, 1.0, 41)
        places = (0.5 * (a + b))[:, None, :] + (normal * reach)[:, None, :] * offsets[None, :, None]
        maps = places.astype(np.float32)
        profiles = np.asarray(
            cv2.remap(grey, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float64
        )
        rise = np.abs(profiles[:, -5:].mean(axis=1) - profiles[:, :5].mean(axis=1))
        slope = np.abs(np.diff(profiles, axis=1)).max(axis=1) / (reach[:, 0] * (offsets[1] - offsets[0]))
        widths.append(float(np.median(rise / np.maximum(slope, 1e-6))))
    return max(widths)


def slant_rad(found: FoundBoard) -> float:
    """The angle [rad] between the line of sight and the board's normal, from the foreshortening at its centre."""
    grid = found.grid.astype(np.float64)
    homography, _ = cv2.findHomography(grid, found.corners_px, 0)
    if homography is None:
        return 0.5 * math.pi
    x, y = grid.mean(axis=0)
    u, v, w = np.asarray(homography, np.float64) @ (x, y, 1.0)
    h = np.asarray(homography, np.float64)
    jacobian = (h[:2, :2] - np.outer((u / w, v / w), h[2, :2])) / w
    large, small = np.linalg.svd(jacobian, compute_uv=False)
    return float(math.acos(min(small / large, 1.0)))


def _alike(a: View, b: View) -> bool:
    """Whether two views show the same corners at nearly the same pixels."""
    if (a.width_px, a.height_px) != (b.width_px, b.height_px):
        return False
    if a.found.grid.shape != b.found.grid.shape or (a.found.columns, a.found.rows) != (b.found.columns, b.found.rows):
        return False
    limit = _NEAR_DUPLICATE * math.hypot(a.width_px, a.height_px)
    corners, others = a.found.corners_px, b.found.corners_px
    orders = (others, others[::-1])  # a chessboard's first corner may be either end
    return any(float(np.linalg.norm(corners - order, axis=1).mean()) < limit for order in orders)


def settle(views: Views) -> tuple[list[View], list[Refused]]:
    """The views of the most frequent size, and all images refused, with the reasons.

    Raises CalibrationError where the sizes are mixed, no board was found, or the images show another board.
    """
    kept, refused = list(views.kept), list(views.refused)
    _check_board(views)
    sizes = Counter((view.width_px, view.height_px) for view in kept)
    size, count = sizes.most_common(1)[0]
    if count < _MAJORITY * len(kept):
        listed = ", ".join(f"{n} of {w}x{h}" for (w, h), n in sizes.most_common())
        raise CalibrationError(f"the images have mixed sizes ({listed}); give those of one camera at one size")
    wanted = "{}x{}".format(*size)
    for view in [view for view in kept if (view.width_px, view.height_px) != size]:
        reason = f"expected {wanted} pixels, as most images have, got {view.width_px}x{view.height_px}"
        refused.append(Refused(name=view.name, reason=reason, found=view.found))
        kept.remove(view)
    return kept, refused


def _check_board(views: Views) -> None:
    board = views.board
    found = [view.found for view in views.kept] + [r.found for r in views.refused if r.found is not None]
    if not found:
        if not views.refused:
            raise CalibrationError("there are no images")
        what = f"a chessboard of {board.size} inner corners" if board.marker_m is None else "a ChArUco board"
        raise CalibrationError(f"{what} is in none of the {len(views.refused)} images; is the size right?")
    sizes = Counter(seen.size for seen in found)
    other, count = sizes.most_common(1)[0]
    whole = sizes[board.size] + sizes[f"{board.rows}x{board.columns}"]
    if board.marker_m is None and whole == 0 and count >= max(2, len(found) // 2):
        raise CalibrationError(
            f"no image shows a board of {board.size} inner corners, and {count} of {len(found)} show one of {other}; "
            f"give --board {other} if that is yours"
        )
    if not views.kept:
        reason, number = Counter(seen.reason for seen in views.refused).most_common(1)[0]
        raise CalibrationError(f"none of the {len(views.refused)} images can be used; {number} of them: {reason}")


def coverage(views: Iterable[View]) -> NDArray[np.int64]:
    """The number of corners in each of the `CELLS` of the image, (rows, columns)."""
    counts = np.zeros(CELLS, np.int64)
    for view in views:
        cell = view.found.corners_px / (view.width_px, view.height_px) * (CELLS[1], CELLS[0])
        columns, rows = np.clip(cell.astype(np.int64), 0, (CELLS[1] - 1, CELLS[0] - 1)).T
        np.add.at(counts, (rows, columns), 1)
    return counts


def missing_views(views: Sequence[View]) -> str:
    """The view that a person should show next, as text; empty where nothing is missing."""
    counts = coverage(views) > 0
    third_rows, third_columns = np.array_split(np.arange(CELLS[0]), 3), np.array_split(np.arange(CELLS[1]), 3)
    share = np.array([[counts[np.ix_(r, c)].mean() for c in third_columns] for r in third_rows])
    row, column = np.unravel_index(int(np.argmin(share)), share.shape)
    if share[row, column] < 0.5:
        place = " ".join(part for part in (("upper", "", "lower")[row], ("left", "", "right")[column]) if part)
        return f"missing: the board at the {place or 'middle'}"
    slants = np.array([view.slant_rad for view in views])
    if (slants > math.radians(20.0)).mean() < 0.4:
        return "missing: the board tilted"
    return ""
