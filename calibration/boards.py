"""Chessboards and ChArUco boards, and their inner corners in an image."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from automodel.sources.images import with_channels
from automodel.types import FloatArray, Image, IntArray

DICTIONARIES = (
    *(f"{bits}_{count}" for bits in ("4x4", "5x5", "6x6", "7x7") for count in (50, 100, 250, 1000)),
    "original",
    "apriltag_36h11",
)
_BEND = 0.4  # second difference of a lattice, in steps: perspective and lens give less, a missing corner 0.67
_CONTRAST = 0.2  # of the median contrast between neighbouring squares: glare leaves more
_FEWEST = 12  # corners of a chessboard that is cut off by the image border
_FEWEST_CHARUCO = 8
_SMALL = 500_000  # pixels; corners in a smaller image are refined


@dataclass(frozen=True, slots=True, kw_only=True)
class Board:
    """A board with `columns` x `rows` inner corners, one more square each way; raises ValueError.

    With `marker_m` (the side of a marker) it is a ChArUco board with markers of `dictionary`, else a chessboard.
    """

    columns: int
    rows: int
    square_m: float
    marker_m: float | None = None
    dictionary: str = "4x4_50"

    def __post_init__(self) -> None:
        if not (3 <= self.columns <= 50 and 3 <= self.rows <= 50):
            raise ValueError(f"expected a board of 3 .. 50 inner corners each way, got {self.size}")
        if not 0.0 < self.square_m < 10.0:
            raise ValueError(f"expected squares of 0 .. 10 m, got {self.square_m} m")
        if self.marker_m is not None and not 0.0 < self.marker_m < self.square_m:
            raise ValueError(f"expected markers smaller than squares of {self.square_m} m, got {self.marker_m} m")
        if self.dictionary not in DICTIONARIES:
            raise ValueError(f"expected a dictionary of {', '.join(DICTIONARIES)}, got {self.dictionary!r}")

    @classmethod
    def of_mm(
        cls, size: tuple[int, int], square_mm: float, charuco: bool, marker_mm: float | None, dictionary: str
    ) -> Board:
        """The board in millimetres; a marker of a ChArUco board has 3/4 of a square by default."""
        marker_m = 1e-3 * (marker_mm or 0.75 * square_mm) if charuco else None
        return cls(columns=size[0], rows=size[1], square_m=1e-3 * square_mm, marker_m=marker_m, dictionary=dictionary)

    @property
    def size(self) -> str:
        """Columns x rows of inner corners, as text."""
        return f"{self.columns}x{self.rows}"

    def points_m(self, grid: IntArray) -> FloatArray:
        """Columns and rows (n, 2) -> points (n, 3) [m]: x along a row, y down a column, z into the board."""
        return np.column_stack((grid * self.square_m, np.zeros(len(grid))))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FoundBoard:
    """The inner corners of a board in an image: `corners_px` (n, 2), and column and row of each, `grid` (n, 2).

    `columns` x `rows` is the size of the visible part. Where the rest of a chessboard lies outside the image, its
    columns and rows count from the first visible ones; those of a ChArUco board are always the board's own.
    """

    corners_px: FloatArray
    grid: IntArray
    columns: int
    rows: int

    def __post_init__(self) -> None:
        for name in ("corners_px", "grid"):
            array = np.array(getattr(self, name))
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @property
    def size(self) -> str:
        """Columns x rows of inner corners, as text."""
        return f"{self.columns}x{self.rows}"


def find_board(image: Image, board: Board) -> FoundBoard | None:
    """The board in an image (h, w) grey or (h, w, 3) BGR, or its visible part; None where there is none.

    A chessboard larger than `board` is found, too, with its own size: the caller must compare.
    """
    grey = with_channels(image, False)
    return _find_chessboard(grey, board) if board.marker_m is None else _find_charuco(grey, board)


def _find_chessboard(grey: Image, board: Board) -> FoundBoard | None:
    """The whole board, or the largest part of it that is recognised with certainty."""
    size = (board.columns, board.rows)
    largest = _lattice(grey, (3, 3), cv2.CALIB_CB_LARGER)
    count = 0 if largest is None else largest.shape[0] * largest.shape[1]
    if count <= board.columns * board.rows:
        whole = _lattice(grey, size, 0)
        if whole is None and cv2.checkChessboard(grey, size):
            whole = _lattice(grey, size, cv2.CALIB_CB_EXHAUSTIVE)
        if whole is not None:
            return _in_order(_refined(grey, whole), board)
    if not cv2.checkChessboard(grey, (3, 3)):
        return None
    best = largest if count >= _FEWEST else None
    for smaller in _smaller_sizes(board, _FEWEST if best is None else count + 1):
        found = _lattice(grey, smaller, cv2.CALIB_CB_LARGER)
        if found is not None:
            best = found
            break
    return None if best is None else _in_order(_refined(grey, best), board)


def _smaller_sizes(board: Board, fewest: int) -> list[tuple[int, int]]:
    """Sizes from the largest down to half the board; a smaller lattice may be something else."""
    fewest = max(fewest, board.columns * board.rows // 2)
    sizes = [(c, r) for c in range(3, board.columns + 1) for r in range(3, board.rows + 1) if c * r >= fewest]
    return sorted((size for size in sizes if size != (board.columns, board.rows)), key=lambda s: -s[0] * s[1])


def _lattice(grey: Image, size: tuple[int, int], flags: int) -> FloatArray | None:
    """Corners (rows, columns, 2) in the detector's order; None where they are not those of a chessboard.

    On a part of a board the detector may skip whole columns, or run diagonally over the squares.
    """
    found, corners, meta = cv2.findChessboardCornersSBWithMeta(grey, size, flags)
    if not found:
        return None
    lattice = np.asarray(corners, np.float64).reshape(*np.asarray(meta).shape[:2], 2)
    return lattice if _even(lattice) and _chequered(grey, lattice) else None


def _refined(grey: Image, lattice: FloatArray) -> FloatArray:
    """The same lattice from an enlarged image if that is small, since aliasing shifts its corners."""
    if grey.size >= _SMALL:
        return lattice
    again = _lattice(grey, (lattice.shape[1], lattice.shape[0]), cv2.CALIB_CB_ACCURACY)
    return lattice if again is None else again


def _even(lattice: FloatArray) -> bool:
    """Whether neighbouring steps are similar along every row and column."""
    for columns in (lattice, lattice.transpose(1, 0, 2)):
        steps = np.diff(columns, axis=0)
        lengths = np.linalg.norm(steps, axis=-1)
        bends = np.linalg.norm(np.diff(steps, axis=0), axis=-1)
        if (bends > _BEND * 0.5 * (lengths[1:] + lengths[:-1])).any():
            return False
    return True


def _chequered(grey: Image, lattice: FloatArray) -> bool:
    """Whether the squares between the corners alternate between dark and bright."""
    middles = (0.25 * (lattice[1:, 1:] + lattice[1:, :-1] + lattice[:-1, 1:] + lattice[:-1, :-1])).astype(np.float32)
    seen = np.asarray(cv2.remap(grey, middles[..., 0], middles[..., 1], cv2.INTER_LINEAR), np.float64)
    sign = 1.0 - 2.0 * (np.indices(seen.shape).sum(axis=0) % 2)
    rises = np.concatenate([(sign[1:] * np.diff(seen, axis=0)).ravel(), (sign[:, 1:] * np.diff(seen, axis=1)).ravel()])
    usual = float(np.median(rises))
    return bool((rises * np.sign(usual) > _CONTRAST * abs(usual)).all())


def _in_order(lattice: FloatArray, board: Board) -> FoundBoard:
    """The lattice in the board's order, seen from its front; of the possible first corners the upper one."""
    along, down = lattice[0, -1] - lattice[0, 0], lattice[-1, 0] - lattice[0, 0]
    if along[0] * down[1] - along[1] * down[0] < 0:
        lattice = lattice.transpose(1, 0, 2)
    rows, columns = lattice.shape[:2]
    fits = columns <= board.columns and rows <= board.rows
    if not fits and (columns < rows) != (board.columns < board.rows):
        lattice = np.rot90(lattice, axes=(0, 1))
    if lattice[0, 0, 1] > lattice[-1, -1, 1]:
        lattice = lattice[::-1, ::-1]
    rows, columns = lattice.shape[:2]
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
    return FoundBoard(corners_px=lattice.reshape(-1, 2), grid=grid, columns=columns, rows=rows)


def _find_charuco(grey: Image, board: Board) -> FoundBoard | None:
    best: tuple[FloatArray, IntArray] | None = None
    for legacy in (False, True):  # boards of OpenCV before 4.6 start with the other colour
        pattern = _charuco(board)
        pattern.setLegacyPattern(legacy)
        corners, ids, _, _ = cv2.aruco.CharucoDetector(pattern).detectBoard(grey)
        if ids is None or len(ids) < _FEWEST_CHARUCO:
            continue
        numbers = np.asarray(ids, np.int64).ravel()
        if best is None or len(numbers) > len(best[0]):
            best = np.asarray(corners, np.float64).reshape(-1, 2), numbers
    if best is None:
        return None
    grid = np.column_stack((best[1] % board.columns, best[1] // board.columns))
    columns, rows = (int(n) for n in np.ptp(grid, axis=0) + 1)
    if min(columns, rows) < 2:
        return None
    return FoundBoard(corners_px=best[0], grid=grid, columns=columns, rows=rows)


def _charuco(board: Board) -> cv2.aruco.CharucoBoard:
    assert board.marker_m is not None
    squares = (board.columns + 1, board.rows + 1)
    return cv2.aruco.CharucoBoard(squares, board.square_m, board.marker_m, dictionary_of(board.dictionary))


def dictionary_of(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of markers."""
    constant = {"original": "DICT_ARUCO_ORIGINAL", "apriltag_36h11": "DICT_APRILTAG_36h11"}.get(name, f"DICT_{name}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, constant.replace("x", "X")))


def other_dictionary(image: Image, board: Board) -> str | None:
    """The dictionary other than the board's of which the image shows at least 4 markers; None without one."""
    grey = with_channels(image, False)
    numbers = {}
    for name in (name for name in DICTIONARIES if "_" not in name or name.endswith(("_1000", "_36h11"))):
        _, ids, _ = cv2.aruco.ArucoDetector(dictionary_of(name)).detectMarkers(grey)
        numbers[name] = [] if ids is None else np.ravel(ids).tolist()
    best = max(numbers, key=lambda name: len(numbers[name]))
    if len(numbers[best]) < 4:
        return None
    family, _, _ = best.partition("_1000")  # the smaller dictionaries of a family are its first markers
    fitting = [name for name in DICTIONARIES if name.startswith(family) and _count(name) > max(numbers[best])]
    return None if board.dictionary in fitting else fitting[0]


def _count(dictionary: str) -> int:
    return len(dictionary_of(dictionary).bytesList)
