"""The bundle adjustment of a right camera over the road's lines and dash ends, which both cameras see in windows.

Unknown are the right camera's place, and in each window the road (a spine, the lines' distances from it, the ends of
dashes along it) and how the body stands in each pair of images: odometry and the calibrated ground are its prior. The
left camera is exact. All residuals are normalised pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from automodel.config import Extrinsics
from automodel.geometry import CameraModel, GroundCamera, cam_from_body_rotation
from automodel.types import Bools, FloatArray, Ints

COMMON, BODY, SPINE = 12, 6, 3  # numbers that all windows share, of a body, of a spine
ODOMETRY, BLOOM, DRIFT, FOCAL, CENTRE = 6, 7, 8, 9, slice(10, 12)  # of the common ones, after the right camera's place
_FOOT = 2  # Newton steps to the foot on the spine; its bends are wide
_STEPS, _SMALL = 25, 0.01  # of Gauss-Newton; the step [sigmas of the result] that ends it
_TAIL = 2.5  # scales from which on a residual counts less (Cauchy)
_FLAT_M = 1e-9  # on the ground to a pixel, at least
_DELTA = 1e-6  # of the derivatives by differences [m], [rad]

Ground = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rows:
    """All that was measured: one row each, sorted by window.

    `ray` (n, 3) in the cam frame of `eye` (n,) 0 left or 1 right, `shifted` (n, 3) the ray one pixel on, in the
    direction in which the row's error is measured. `pair`, `window`, `line` (n,) count through all windows; `end` (n,)
    does too, and is -1 for the ridges of a line.
    """

    ray: FloatArray
    shifted: FloatArray
    eye: Ints
    pair: Ints
    window: Ints
    line: Ints
    end: Ints

    def part(self, these: Bools | Ints) -> Rows:
        """Those rows."""
        return Rows(**{name: getattr(self, name)[these] for name in self.__slots__})

    @classmethod
    def joined(cls, parts: Sequence[Rows]) -> Rows:
        """The rows of all parts."""
        return cls(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in cls.__slots__})


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Unknowns:
    """`common` (12,): x, y, z [m], pitch, yaw, roll [rad] of the right camera; the true length of a metre of odometry;
    by how much longer at each end the right camera sees a dash than the left one [px], and how much farther ahead [px];
    errors of the right lens: share of its focal lengths, and of its centre [px].

    `body` (p, 6) of each pair: ahead, left, up [m], yaw, pitch, roll [rad] of the middle between both cameras, beyond
    odometry and calibration. `spine`
    (w, 3): y = b x + c x^2 + d x^3; `line` (l,) [m] to the left of it, `end` (e,) the x of the end's foot on it.
    """

    common: FloatArray
    body: FloatArray
    spine: FloatArray
    line: FloatArray
    end: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prior:
    """One sigma of the common numbers (12,), and of each pair's body (p, 6); `start` (12,) is the former's mean."""

    start: FloatArray
    common: FloatArray
    body: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BundleFit:
    """`covariance` (12, 12) of the common numbers; `residuals` (n,) [px]; `sigma_px`: of ridges, and of ends."""

    unknowns: Unknowns
    covariance: FloatArray
    residuals: FloatArray
    sigma_px: tuple[float, float]


class Bundle:
    """The equations of a left camera, a right lens, and what was measured with both.

    `place` (p, 3): of each pair in its window's frame by odometry, x, y [m] and yaw [rad].
    """

    def __init__(self, cameras: tuple[GroundCamera, CameraModel], rows: Rows, place: FloatArray, prior: Prior) -> None:
        self.cameras, self.rows, self.place, self.prior = cameras, rows, place, prior

    def residuals(self, at: Unknowns, ground: tuple[Ground, Ground] | None = None) -> FloatArray:
        """The errors (n,) [px]; `ground` as `grounds` gives it, where it is known.

        Metres to a pixel are those of the same unknowns: with any other the smaller world would fit better.
        """
        here, shifted = (self._metres(at, *points) for points in ground or self.grounds(at))
        pixel = shifted - here
        pixel = np.where(np.abs(pixel) > _FLAT_M, pixel, _FLAT_M)  # in the sky, where a wrong camera may see a line
        seen_px = at.common[BLOOM] + at.common[DRIFT] * np.sign(pixel)  # out of the dash
        return np.asarray(here / pixel - np.where(self.rows.end >= 0, (self.rows.eye - 0.5) * seen_px, 0.0))

    def grounds(self, at: Unknowns) -> tuple[Ground, Ground]:
        """Where the rays meet the ground, and those that are shifted."""
        rays = (self.rows.ray, self.rows.shifted)
        one, other = (ground_points(self.cameras, at, self.rows, ray, self.place) for ray in rays)
        return one, other

    def _metres(self, at: Unknowns, x: FloatArray, y: FloatArray) -> FloatArray:
        """The error of each row on the ground (n,) [m]."""
        rows = self.rows
        foot, aside, stretch = spine_coordinates(at.spine[rows.window], x, y)
        along = (foot - at.end[np.maximum(rows.end, 0)]) * stretch if len(at.end) else foot
        return np.asarray(np.where(rows.end >= 0, along, aside - at.line[rows.line]))

    def fit(self, start: Unknowns) -> BundleFit:
        """Gauss-Newton with Cauchy's weights; the windows' own numbers are eliminated."""
        at, sigma = start, (1.0, 1.0)
        windows = self._windows()
        for _ in range(_STEPS):
            residuals = self.residuals(at)
            sigma = self._sigmas(residuals)
            system = self._linearised(at, residuals, sigma, windows)
            step, covariance, at = self._stepped(at, system, windows)
            if np.abs(step / np.sqrt(np.diag(covariance))).max() < _SMALL:
                break
        return BundleFit(unknowns=at, covariance=covariance, residuals=self.residuals(at), sigma_px=sigma)

    def _sigmas(self, residuals: FloatArray) -> tuple[float, float]:
        """The noise of ridges and of ends [px], by their median errors."""
        ends = self.rows.end >= 0
        usual = [1.4826 * float(np.median(np.abs(residuals[which]))) if which.any() else 1.0 for which in (~ends, ends)]
        return max(usual[0], 0.05), max(usual[1], 0.05)

    def _windows(self) -> list[_Window]:
        rows = self.rows
        found = []
        for window in np.unique(rows.window).tolist():
            its = np.flatnonzero(rows.window == window)
            found.append(
                _Window(
                    number=window,
                    rows=its,
                    pairs=np.unique(rows.pair[its]),
                    lines=np.unique(rows.line[its]),
                    ends=np.unique(rows.end[its][rows.end[its] >= 0]),
                )
            )
        return found

    def _linearised(
        self,
        at: Unknowns,
        residuals: FloatArray,
        sigma: tuple[float, float],
        windows: list[_Window],
    ) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
        """Of each window: weighted residuals (m,), derivatives by the common numbers (m, 12) and by its own (m, k).

        The priors of its pairs' bodies are among the rows.
        """
        noise = np.where(self.rows.end >= 0, sigma[1], sigma[0])
        weight = 1.0 / (noise * np.sqrt(1.0 + (residuals / (_TAIL * noise)) ** 2))

        ground = self.grounds(at)

        def slope(known: tuple[Ground, Ground] | None = None, **moved: FloatArray) -> FloatArray:
            return np.asarray(weight * (self.residuals(replace(at, **moved), known) - residuals) / _DELTA)

        by_common = np.stack([slope(common=at.common + step) for step in _DELTA * np.eye(COMMON)], axis=1)
        by_body = np.stack([slope(body=at.body + step) for step in _DELTA * np.eye(BODY)], axis=1)
        by_spine = np.stack([slope(ground, spine=at.spine + step) for step in _DELTA * np.eye(SPINE)], axis=1)
        by_line, by_end = slope(ground, line=at.line + _DELTA), slope(ground, end=at.end + _DELTA)
        systems = []
        for window in windows:
            own = window.own(self.rows, by_body, by_spine, by_line, by_end)
            prior = self.prior.body[window.pairs]
            bodies = np.zeros((prior.size, own.shape[1]))
            bodies[:, : prior.size] = np.diag(1.0 / prior.ravel())
            systems.append(
                (
                    np.concatenate(((weight * residuals)[window.rows], (at.body[window.pairs] / prior).ravel())),
                    np.concatenate((by_common[window.rows], np.zeros((prior.size, COMMON)))),
                    np.concatenate((own, bodies)),
                )
            )
        return systems

    def _stepped(
        self, at: Unknowns, systems: list[tuple[FloatArray, FloatArray, FloatArray]], windows: list[_Window]
    ) -> tuple[FloatArray, FloatArray, Unknowns]:
        """The step of the common numbers (12,), its covariance, and the unknowns after it.

        The covariance is that of clustered data (White's sandwich): the rows of a window err together. Windows that are
        not many more than the numbers show too little of it; there the rows' own noise is added.
        """
        sure = np.diag(1.0 / self.prior.common**2)
        normal, gradient = sure.copy(), sure @ (at.common - self.prior.start)
        scores, eliminated = [], []
        for error, by_common, own in systems:
            scale = 1.0 / np.maximum(np.linalg.norm(own, axis=0), 1e-9)
            own = own * scale
            basis = np.linalg.solve(own.T @ own + 1e-10 * np.eye(own.shape[1]), own.T)
            clean = by_common - own @ (basis @ by_common)
            normal += clean.T @ clean
            scores.append(clean.T @ error)
            eliminated.append((scale, basis))
        gradient = gradient + np.sum(scores, axis=0)
        step = -np.linalg.solve(normal, gradient)
        step *= min(1.0, 1.0 / max(float(np.abs(step / self.prior.common).max()), 1e-12))
        body, spine, line, end = (values.copy() for values in (at.body, at.spine, at.line, at.end))
        for window, (error, by_common, _), (scale, basis) in zip(windows, systems, eliminated, strict=True):
            moved = -scale * (basis @ (error + by_common @ step))
            window.move(moved, body, spine, line, end)
        count = len(systems)
        spread = np.array(scores) - np.mean(scores, axis=0)
        noise = min(COMMON / count, 1.0) * (normal - sure)
        scatter = sure + noise + count / max(count - 1, 1) * spread.T @ spread
        covariance = np.linalg.solve(normal, np.linalg.solve(normal, scatter).T)
        return step, covariance, Unknowns(common=at.common + step, body=body, spine=spine, line=line, end=end)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Window:
    """The rows of a window, and the numbers of its pairs, lines and ends: its own columns, in this order."""

    number: int
    rows: Ints
    pairs: Ints
    lines: Ints
    ends: Ints

    def own(
        self, rows: Rows, by_body: FloatArray, by_spine: FloatArray, by_line: FloatArray, by_end: FloatArray
    ) -> FloatArray:
        """The derivatives (m, k) of its rows by its own numbers."""
        its, n = self.rows, len(self.rows)
        bodies, lines = len(self.pairs) * BODY, len(self.lines)
        found = np.zeros((n, bodies + SPINE + lines + len(self.ends)))
        at = np.arange(n)
        first = BODY * np.searchsorted(self.pairs, rows.pair[its])
        for k in range(BODY):
            found[at, first + k] = by_body[its, k]
        found[:, bodies : bodies + SPINE] = by_spine[its]
        end = rows.end[its]
        ridge = end < 0
        found[at[ridge], bodies + SPINE + np.searchsorted(self.lines, rows.line[its][ridge])] = by_line[its][ridge]
        column = bodies + SPINE + lines + np.searchsorted(self.ends, end[~ridge])
        found[at[~ridge], column] = by_end[its][~ridge]
        return found

    def move(self, step: FloatArray, body: FloatArray, spine: FloatArray, line: FloatArray, end: FloatArray) -> None:
        """Add a step (k,) of its own numbers to those of all windows."""
        bodies = len(self.pairs) * BODY
        body[self.pairs] += step[:bodies].reshape(-1, BODY)
        spine[self.number] += step[bodies : bodies + SPINE]
        line[self.lines] += step[bodies + SPINE : bodies + SPINE + len(self.lines)]
        end[self.ends] += step[bodies + SPINE + len(self.lines) :]


def spine_coordinates(spine: FloatArray, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of points (n,) beside spines (n, 3): the x of the foot, the distance to the left [m], and metres of arc per x."""
    b, c, d = spine.T
    foot = x
    for _ in range(_FOOT):
        slope = b + foot * (2.0 * c + 3.0 * d * foot)
        off = y - foot * (b + foot * (c + d * foot))
        foot = foot + (x - foot + slope * off) / (1.0 + slope * slope)
    slope = b + foot * (2.0 * c + 3.0 * d * foot)
    stretch = np.sqrt(1.0 + slope * slope)
    off = y - foot * (b + foot * (c + d * foot))
    return foot, (off - slope * (x - foot)) / stretch, stretch


def ground_points(
    cameras: tuple[GroundCamera, CameraModel], at: Unknowns, rows: Rows, rays: FloatArray, place: FloatArray
) -> Ground:
    """Where rays (n, 3) in the cam frames meet the ground: x, y (n,) [m] in the window's frame; far for the sky."""
    left, right = cameras
    seen = rows.eye == 1
    off = np.where(seen[:, None], at.common[CENTRE] / right.matrix[0, 0], 0.0)
    plane = (rays[:, :2] - off) / np.where(seen, 1.0 + at.common[FOCAL], 1.0)[:, None]
    level = _level_from_body(at.body[:, 4], at.body[:, 5])
    eyes = ((left.cam_from_body, left.centre_m), (rotation_of(at.common), at.common[:3]))
    turns = np.stack([level @ cam_from_body.T for cam_from_body, _ in eyes], axis=1)
    middle = 0.5 * (left.centre_m + at.common[:3])  # about which the body tilts
    centres = np.stack([level @ (centre_m - middle) + middle for _, centre_m in eyes], axis=1)
    body = np.einsum("nij,nj->ni", turns[rows.pair, rows.eye], np.column_stack((plane, rays[:, 2])))
    centre = centres[rows.pair, rows.eye]
    ahead, aside, up, yaw = at.body[rows.pair, :4].T
    height = centre[:, 2] + up
    away = height / np.maximum(-body[:, 2], 1e-4)
    x, y = centre[:, 0] + away * body[:, 0] + ahead, centre[:, 1] + away * body[:, 1] + aside
    at_x, at_y, at_yaw = place[rows.pair].T
    at_x, at_y = at.common[ODOMETRY] * at_x, at.common[ODOMETRY] * at_y
    cos, sin = np.cos(at_yaw + yaw), np.sin(at_yaw + yaw)
    return at_x + cos * x - sin * y, at_y + sin * x + cos * y


def rotation_of(pose: FloatArray) -> FloatArray:
    """cam_from_body (3, 3) of x, y, z, pitch, yaw, roll."""
    return cam_from_body_rotation(
        Extrinsics(pitch_rad=float(pose[3]), yaw_rad=float(pose[4]), roll_rad=float(pose[5]), z_m=1.0)
    )


def _level_from_body(pitch: FloatArray, roll: FloatArray) -> FloatArray:
    """Rotations (p, 3, 3) to a level frame from bodies that are pitched (down positive) and rolled (right down)."""
    cp, sp, cr, sr, zero = np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll), np.zeros(len(pitch))
    rows = ((cp, sp * sr, sp * cr), (zero, cr, -sr), (-sp, cp * sr, cp * cr))
    return np.moveaxis(np.array(rows), 2, 0)


def lens_rays(camera: CameraModel, pixels: FloatArray, along: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The rays (n, 3) of pixels (n, 2), and of those one pixel on in the directions `along` (n, 2)."""
    rays = camera.rays(pixels)
    half = 0.5 * (camera.rays(pixels + along) - camera.rays(pixels - along))
    return rays, rays + half
