"""Pictures of boards and sheets through any camera, by looking up where each pixel's ray meets the sheet."""

from __future__ import annotations

import functools
from typing import Any

import cv2
import numpy as np

from automodel.config import Extrinsics, Intrinsics
from automodel.geometry import CameraModel, GroundCamera

PAPER_PX = 48  # a square's side on the paper
FINE = 3  # a pixel is the mean of so many rays each way
LENS = Intrinsics(fx_px=430.0, fy_px=428.0, cx_px=326.0, cy_px=174.0, distortion=(-0.24, 0.06, 0.0008, -0.0006, 0.0))
SIZE = (640, 360)


def chessboard(columns: int, rows: int) -> np.ndarray:
    """The paper of a board with so many inner corners, a white rim of one square around it."""
    squares = np.indices((rows + 1, columns + 1)).sum(axis=0) % 2
    paper = np.kron(255 * (1 - squares), np.ones((PAPER_PX, PAPER_PX))).astype(np.uint8)
    return cv2.copyMakeBorder(paper, *4 * (PAPER_PX,), cv2.BORDER_CONSTANT, value=255)


def charuco(columns: int, rows: int, dictionary: int = cv2.aruco.DICT_4X4_50, legacy: bool = False) -> np.ndarray:
    """The paper of a ChArUco board, markers of three quarters of a square, a white rim of one square."""
    markers = cv2.aruco.getPredefinedDictionary(dictionary)
    board = cv2.aruco.CharucoBoard((columns + 1, rows + 1), 4.0, 3.0, markers)
    board.setLegacyPattern(legacy)
    paper = board.generateImage(((columns + 1) * PAPER_PX, (rows + 1) * PAPER_PX))
    return cv2.copyMakeBorder(paper, *4 * (PAPER_PX,), cv2.BORDER_CONSTANT, value=255)


def marker(number: int) -> np.ndarray:
    """The paper of one ArUco marker, a rim of a quarter of it."""
    paper = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), number, 192)
    return cv2.copyMakeBorder(paper, *4 * (48,), cv2.BORDER_CONSTANT, value=255)


@functools.lru_cache(maxsize=8)
def rays_of(lens: Intrinsics, width: int, height: int) -> np.ndarray:
    """Rays (FINE * h, FINE * w, 3) of the parts of every pixel; smooth, so that few need Newton's method."""
    from scipy.interpolate import RectBivariateSpline

    def parts(count: int) -> np.ndarray:
        return (np.arange(count * FINE) + 0.5) / FINE - 0.5

    u, v = np.linspace(-0.5, width - 0.5, 65), np.linspace(-0.5, height - 0.5, 65)
    nodes = CameraModel(lens, width, height).rays(np.stack(np.meshgrid(u, v), axis=-1))
    planes = [RectBivariateSpline(v, u, nodes[..., i])(parts(height), parts(width)) for i in (0, 1)]
    return np.stack((*planes, np.ones_like(planes[0])), axis=-1)


def seen(
    paper: np.ndarray,
    m_per_px: float,
    cam_from_sheet: np.ndarray,
    centre_cam: np.ndarray,
    lens: Intrinsics = LENS,
    size: tuple[int, int] = SIZE,
    around: int = 110,
) -> np.ndarray:
    """The picture (h, w) of a sheet (x right, y down, z away from its front).

    `cam_from_sheet` (3, 3) turns it; its middle lies at `centre_cam` [m] of the cam frame.
    """
    rays = rays_of(lens, *size)
    normal = cam_from_sheet[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (normal @ centre_cam) / (rays @ normal)
        on_sheet = (rays * depth[..., None] - centre_cam) @ cam_from_sheet
    place = on_sheet[..., :2] / m_per_px + 0.5 * np.array(paper.shape[::-1]) - 0.5
    place[~(depth > 0)] = -1e6
    fine = cv2.remap(
        paper,
        place[..., 0].astype(np.float32),
        place[..., 1].astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=around,
    )
    picture = cv2.resize(fine, size, interpolation=cv2.INTER_AREA).astype(np.float64)
    noise = np.random.default_rng(7).normal(0.0, 2.0, picture.shape)
    return np.clip(0.8 * picture + 20.0 + noise, 0, 255).astype(np.uint8)


def turned(right_rad: float, down_rad: float, roll_rad: float = 0.0) -> np.ndarray:
    """A sheet that faced the camera, its right side moved away, its lower side moved away, and turned in its plane."""
    vectors = ((0.0, -right_rad, 0.0), (down_rad, 0.0, 0.0), (0.0, 0.0, roll_rad))
    a, b, c = (cv2.Rodrigues(np.array(vector))[0] for vector in vectors)
    return a @ b @ c


def held(columns: int, rows: int, square_m: float, views: int, paper: np.ndarray | None = None, **more: Any):
    """Pictures of a board held before the camera: near and far, all over the picture, tilted to all sides."""
    paper = chessboard(columns, rows) if paper is None else paper
    rng = np.random.default_rng(5)
    lens = more.get("lens", LENS)
    size = more.get("size", SIZE)
    for number in range(views):
        distance = square_m * (columns + 1) * lens.fx_px / size[0] * rng.uniform(1.2, 2.3)
        tilt, direction = rng.uniform(0.1, 0.85), 2.4 * number
        sheet = turned(tilt * np.cos(direction), tilt * np.sin(direction), rng.uniform(-0.3, 0.3))
        reach = 0.22 * distance / lens.fx_px
        across, down = rng.uniform(-1, 1) * reach * size[0], rng.uniform(-1, 1) * reach * size[1]
        yield seen(paper, square_m / PAPER_PX, sheet, np.array([across, down, distance]), **more)


def on_floor(
    paper: np.ndarray,
    m_per_px: float,
    place_m: tuple[float, float],
    turn_rad: float,
    mount: Extrinsics,
    lens: Intrinsics = LENS,
    size: tuple[int, int] = SIZE,
) -> np.ndarray:
    """A sheet flat on the ground: its middle at `place_m` of the body frame, upper edge ahead, turned to the left."""
    camera = GroundCamera(CameraModel(lens, *size), mount)
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    body_from_sheet = np.array(
        [[s, -c, 0.0], [-c, -s, 0.0], [0.0, 0.0, -1.0]]
    )  # right is y negative, down is x negative
    middle = camera.cam_from_body @ (np.array([*place_m, 0.0]) - camera.centre_m)
    return seen(paper, m_per_px, camera.cam_from_body @ body_from_sheet, middle, lens, size)
