"""The car's motion from the images alone: where nothing else tells it, the ground's own texture does.

Corners on the ground are followed from one image to the next (Lucas and Kanade 1981, on a pyramid). A car on wheels
moves along an arc, so that one corner gives a motion (Scaramuzza 2011, "1-Point-RANSAC Structure from Motion for
Vehicle-Mounted Cameras"); the one that most corners agree on is refined by least squares in the image. What does not
move in the image though the rest does, such as a lamp's reflection, is left out. A Kalman filter on speed and yaw rate
joins the frames.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from automodel.estimation.road import LOST_PACE, LOST_TURN_RAD, MAX_GAP_S, MOST_SIGMAS
from automodel.geometry import GroundCamera
from automodel.signals import Frame, Motion, MotionSource
from automodel.types import Bools, Float32Array, FloatArray, Image


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageMotionConfig:
    """Scales of `ImageMotion`; lengths in lane widths, pixels of an image of at most `width_px`.

    `reach`: ground that is looked at, ahead and to each side. `corners`: at most so many. `least` of them must agree on
    a motion; fewer agree by chance. So many that move together, most of those that move at all, show that the car does:
    nothing moves while it stands. `sigma_px`: the error of following; a corner agrees up to twice that.
    `window_px`: of the following; `alike`: most that two windows may differ, relative to what is in them; noise
    that was followed differs by 1.4. `texture`: least mean square of a window's gradient along its weaker
    direction, in variances of the noise, that judges a given motion: noise alone has 0.5, and 0.7 to 1.5 where the
    strongest of it is chosen. `edge`: most that it may be along the stronger direction, in those along the weaker:
    how a line moves along itself is not seen, and by how it gets thinner ahead it stands. Of the corners of eight
    drives 73 to 92 % of those that judge agree with the true motion, of the others 8 to 63 %. `glare`: most grey of
    what is dark in a window that judges (its lower quartile), relative to the ground's median: what shines through a
    lamp's reflection, which stands still, seems to move by less than the ground. In fifteen drives in random light the
    right motion is contradicted in at most 2 % of the frames (without it 24 %), a standstill that is none borne out in
    at most 2 % (65 %), and one of twice the speed contradicted in 0 to 98 % (9 to 100 %). `agree`: of the corners that
    agree on the motion that most agree on, the share that must agree with a given one: in simulated drives with lamps
    they do in 90 to 100 % of frames, in heavy noise in 45 %; with a speed that is wrong by half in at most 1 %.
    `camera`: sigma of a motion, and of a corner's way along it and across, relative to them: a camera that is set wrong
    by 2 deg or 10 %, which is two sigmas, sees ways that are as wrong. `acceleration` [1/s^2, rad/s^2]: what a driver
    and a steering do to speed and yaw rate, sigma after a second. `told`: largest sigma of a motion that is told,
    relative to that of a car of which nothing is known.
    """

    width_px: int = 720
    reach: float = 3.0
    corners: int = 80
    least: int = 6
    sigma_px: float = 0.5
    window_px: int = 17
    alike: float = 0.9
    texture: float = 1.5
    edge: float = 16.0
    glare: float = 1.25
    agree: float = 0.8
    camera: float = 0.05
    acceleration: float = 1.0
    told: float = 0.2


class Seen(NamedTuple):
    """A motion between two images: distance [m] and turn [rad]; their covariance (2, 2)."""

    moved: FloatArray
    covariance: FloatArray


class ImageMotion:
    """Fills in the motion of frames that come without one."""

    QUALITY = 0.02  # of a corner, relative to the best one
    MARGIN_PX = 4  # above the ground: a corner depends on 3 x 3 gradients of 3 x 3 pixels, and on the corners beside it

    def __init__(self, camera: GroundCamera, lane_width_m: float, config: ImageMotionConfig | None = None) -> None:
        self.config, self._unit = config or ImageMotionConfig(), lane_width_m
        self._scale = 1
        while camera.camera.width_px / self._scale > self.config.width_px:
            self._scale *= 2
        self._middle = 0.5 * (self._scale - 1.0)
        height, width = camera.camera.height_px // self._scale, camera.camera.width_px // self._scale
        self._size = height, width
        self.see_with(camera)
        self._warm_up()
        self.reset()

    def _warm_up(self) -> None:
        """Load what a frame calls: the first one that contradicts the odometry, minutes later, would be late."""
        anything = np.random.default_rng(0).integers(0, 256, self._size, np.uint8)
        self._between(anything, anything, np.zeros(2))

    def see_with(self, camera: GroundCamera) -> None:
        """From now on the camera is set so."""
        self._camera = camera
        mask = self._ground_mask(*self._size)  # made now: a frame that asks for it first would be late
        self._top = max(int(mask.any(axis=1).argmax()) - self.MARGIN_PX, 0)
        self._mask = mask[self._top :]
        self._sparse = np.zeros(self._mask.shape, np.bool_)
        self._sparse[::4, ::4] = self._mask[::4, ::4] > 0

    def reset(self) -> None:
        """Forget the last image and motion."""
        self.most: FloatArray = np.zeros(2)  # speed [m/s], yaw rate [rad/s] by most corners, in the last `agrees`
        self._last: Frame | None = None
        self._mean: FloatArray = np.zeros(2)  # speed [m/s], yaw rate [rad/s]
        self._covariance = self._nothing()

    def step(self, frame: Frame, motion: Motion) -> Motion:
        """The motion up to a frame: as given where it is known, else as seen; unknown where too little was seen."""
        last, self._last = self._last, frame
        if motion.known and math.isfinite(motion.speed_mps + motion.yaw_rate_radps):
            self._mean, self._covariance = np.zeros(2), self._nothing()
            return motion
        dt_s = 0.0 if last is None else (frame.t_ns - last.t_ns) * 1e-9
        if last is None or not 0.0 < dt_s <= MAX_GAP_S or not self._fits(last) or not self._fits(frame):
            self._mean, self._covariance = np.zeros(2), self._nothing()
            return motion
        walk = np.square(self.config.acceleration * np.array((self._unit, 1.0))) * dt_s
        self._covariance = self._covariance + np.diag(walk)
        seen = self._between(self._small(last.image), self._small(frame.image), self._mean * dt_s)
        if seen is not None:
            self._correct(seen, dt_s)
        nothing = np.diag(self._nothing())
        if (np.diag(self._covariance) > nothing).any():
            self._mean, self._covariance = np.zeros(2), self._nothing()
        if (np.diag(self._covariance) > self.config.told**2 * nothing).any():
            return motion
        speed, yaw_rate = self._mean.tolist()
        return replace(motion, speed_mps=speed, yaw_rate_radps=yaw_rate, source=MotionSource.IMAGES)

    def agrees(self, frame: Frame, motion: Motion) -> bool | None:
        """Whether the ground between the last frame and this one, before its `step`, moved as given.

        None where there is no last frame, too little to see, or it moved about so: a camera that is set a little wrong,
        or nods, sees that of a right motion. `most` is then what most corners say.
        """
        last, config = self._last, self.config
        dt_s = 0.0 if last is None else (frame.t_ns - last.t_ns) * 1e-9
        told = np.array((motion.speed_mps, motion.yaw_rate_radps))
        if last is None or not 0.0 < dt_s <= MAX_GAP_S or not self._fits(last) or not self._fits(frame):
            return None
        if not (np.abs(told) <= MOST_SIGMAS * np.sqrt(np.diag(self._nothing()))).all():  # nor NaN
            return False
        expected = told * dt_s
        start, end, textured = self._follow(self._small(last.image), self._small(frame.image), expected)
        start, end = start[textured], end[textured]
        if not len(start):
            return None
        most = self._consensus(start, end)
        self.most = most / dt_s
        by_it, by_most = self._image_of(start, np.stack((expected, most)))
        near = [np.count_nonzero(self._near(by, end)) for by in (by_it, by_most)]
        if near[0] >= max(config.agree * near[1], config.least):
            return True
        if self._near(by_most, start).all():  # so does what is on the lens, or is drawn over the image
            return None
        with np.errstate(invalid="ignore"):
            differ = np.hypot(*(by_it - by_most).T) > 2.0 * config.sigma_px  # far ahead both are the same
        with_it, with_most = (differ & self._about(start, by, end) for by in (by_it, by_most))
        alone, count = np.count_nonzero(with_it & ~with_most), np.count_nonzero(with_most)
        if alone >= config.least or count < config.least:  # what moves otherwise may be lamps in a shiny floor
            return None
        return False if np.count_nonzero(with_it) < config.agree * count else None

    def _fits(self, frame: Frame) -> bool:
        """Whether the frame is one of this camera, which is the left one of a pair."""
        camera = self._camera.camera
        return frame.eye == 0 and frame.image.shape[:2] == (camera.height_px, camera.width_px)

    def _nothing(self) -> FloatArray:
        return np.diag(np.square((LOST_PACE * self._unit, LOST_TURN_RAD)))

    def _correct(self, seen: Seen, dt_s: float) -> None:
        """The Kalman filter's correction by a motion that was seen."""
        gain = np.linalg.solve(self._covariance + seen.covariance / dt_s**2, self._covariance).T
        self._mean = self._mean + gain @ (seen.moved / dt_s - self._mean)
        after = (np.eye(2) - gain) @ self._covariance
        self._covariance = 0.5 * (after + after.T)

    def _small(self, image: Image) -> Image:
        """The image in grey, halved until it is small enough, without the columns and rows that are left over."""
        height, width = (length // self._scale for length in image.shape[:2])
        whole = image[: height * self._scale, : width * self._scale]
        grey = whole if whole.ndim == 2 else np.asarray(cv2.cvtColor(whole, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        if self._scale == 1:
            return grey
        return np.asarray(cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA))  # by whole pixels, fast

    def _between(self, before: Image, after: Image, expected: FloatArray) -> Seen | None:
        """The motion from one small image to the next; None where too few corners agree on one."""
        start, end, _ = self._follow(before, after, expected)
        config = self.config
        still = np.hypot(*(end - start).T) < config.sigma_px
        moving = np.count_nonzero(~still)
        moved, least = np.zeros(2), config.least
        if moving >= config.least:
            moved = self._consensus(start[~still], end[~still])
            together = np.count_nonzero(self._near(self._image_of(start[~still], moved), end[~still]))
            if together < max(config.least, moving // 2):
                return None
            least = min(least, int(together))
        near = self._near(self._image_of(start, moved), end)
        if np.count_nonzero(near) < least:
            return None
        residual, jacobian = self._linearised(start[near], end[near], moved)
        moved = moved - np.linalg.solve(jacobian.T @ jacobian, jacobian.T @ residual)
        sigma_px = max(1.4826 * float(np.median(np.abs(residual))), config.sigma_px)
        covariance = np.linalg.solve(jacobian.T @ jacobian, np.eye(2)) * sigma_px**2
        return Seen(moved, covariance + np.diag(np.square(config.camera * moved)))

    def _follow(self, before: Image, after: Image, expected: FloatArray) -> tuple[FloatArray, FloatArray, Bools]:
        """Corners (n, 2) [px], where they went, and which (n,) have texture in both directions."""
        config = self.config
        apart = max(before.shape[1] / 80.0, 3.0)
        found = cv2.goodFeaturesToTrack(before[self._top :], config.corners, self.QUALITY, apart, mask=self._mask)
        if found is None:
            return np.empty((0, 2)), np.empty((0, 2)), np.empty(0, np.bool_)
        start: Float32Array = found.reshape(-1, 2).astype(np.float32)
        start[:, 1] += self._top
        guess = self._image_of(start.astype(np.float64), expected)
        on_ground = np.asarray(np.isfinite(guess).all(axis=1))
        guess = np.clip(np.where(np.isfinite(guess), guess, start), -1e4, 1e4).astype(np.float32)
        size, flags = (config.window_px, config.window_px), cv2.OPTFLOW_USE_INITIAL_FLOW
        end, status, differ = cv2.calcOpticalFlowPyrLK(
            before, after, start, guess, winSize=size, maxLevel=2, flags=flags
        )
        followed = status.reshape(-1) > 0
        if not followed.any():
            return np.empty((0, 2)), np.empty((0, 2)), np.empty(0, np.bool_)
        start, differ = start[followed], differ.reshape(-1)[followed]
        places, ends = start.astype(np.float64), end.reshape(-1, 2)[followed].astype(np.float64)
        good = on_ground[followed]
        contrast, dark, weak, strong = self._windows(before, start)
        good &= differ < config.alike * contrast
        noise = np.minimum(differ, np.median(differ)).astype(np.float64)  # what got nearer differs by more than it
        variance = 0.25 * math.pi * noise**2  # by the mean difference
        textured = (weak > config.texture * variance) & (strong < config.edge * weak)
        textured &= dark < config.glare * np.median(before[self._top :][self._sparse])
        return places[good], ends[good], textured[good]

    def _windows(self, image: Image, places: Float32Array) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Of windows about places (n, 2): mean deviation (n,) from the mean, grey of what is dark, and the gradient's.

        Its mean squares (n,) are those along the weaker and the stronger direction: the eigenvalues of the structure
        tensor (Shi, Tomasi 1994, "Good Features to Track").
        """
        size = (self.config.window_px, self.config.window_px)
        windows = np.stack([cv2.getRectSubPix(image, size, (u, v)) for u, v in places.tolist()]).astype(np.float32)
        contrast = np.abs(windows - windows.mean(axis=(1, 2), keepdims=True)).mean(axis=(1, 2))
        down, along = (gradient.reshape(len(places), -1) for gradient in np.gradient(windows, axis=(1, 2)))
        xx, xy, yy = ((one * other).mean(axis=1) for one, other in ((along, along), (along, down), (down, down)))
        middle, half = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
        quarter = windows[0].size // 4
        dark = np.partition(windows.reshape(len(places), -1), quarter, axis=1)[:, quarter].astype(np.float64)
        return contrast, dark, np.maximum(middle - half, 0.0), middle + half

    def _image_of(self, pixels: FloatArray, moved: FloatArray) -> FloatArray:
        """Where pixels (n, 2) of the ground go with motions (..., 2), arcs, in the small image: (..., n, 2)."""
        distance, turn = moved[..., :1], moved[..., 1:]  # as `SE2.arc`, inverted, of many at once
        chord = distance * np.sinc(0.5 * turn / math.pi)
        x, y = self._camera.px_to_ground(pixels * self._scale + self._middle).T
        x, y = x - chord * np.cos(0.5 * turn), y - chord * np.sin(0.5 * turn)
        cos, sin = np.cos(turn), np.sin(turn)
        after = np.stack((cos * x + sin * y, cos * y - sin * x), axis=-1)
        return np.asarray((self._camera.ground_to_px(after) - self._middle) / self._scale)

    def _near(self, expected: FloatArray, end: FloatArray) -> Bools:
        """Which corners (..., n) went where motions put them: `expected` (..., n, 2) [px]."""
        off = expected - end
        with np.errstate(invalid="ignore"):
            return np.asarray(np.hypot(off[..., 0], off[..., 1]) < 2.0 * self.config.sigma_px)

    def _about(self, start: FloatArray, expected: FloatArray, end: FloatArray) -> Bools:
        """Which corners (n,) went about where a motion puts them: a camera that is set a little wrong, and nods."""
        way, off = expected - start, end - expected
        length = np.maximum(np.hypot(*way.T), 1e-9)
        along = np.abs((off * way).sum(axis=1)) / length
        across = np.abs(off[:, 0] * way[:, 1] - off[:, 1] * way[:, 0]) / length
        near = 2.0 * (self.config.sigma_px + self.config.camera * length)
        with np.errstate(invalid="ignore"):
            return np.asarray(np.maximum(along, across) < near)

    def _linearised(self, start: FloatArray, end: FloatArray, moved: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals (2 n,) [px] and their Jacobian (2 n, 2) for distance and turn, by differences."""
        steps = np.array((1e-3 * self._unit, 1e-3))
        motions = moved + np.vstack((np.zeros(2), np.diag(steps)))
        off, *others = (self._image_of(start, motions) - end).reshape(3, -1)
        return off, (np.stack(others, axis=1) - off[:, None]) / steps

    def _consensus(self, start: FloatArray, end: FloatArray) -> FloatArray:
        """The motion by one corner that most corners agree with."""
        before, after = (self._camera.px_to_ground(self._scale * px + self._middle) for px in (start, end))
        turn = (before[:, 1] - after[:, 1]) / np.maximum(0.5 * (before[:, 0] + after[:, 0]), 1e-3)
        distance = before[:, 0] - after[:, 0] + 0.5 * turn * (before[:, 1] + after[:, 1])
        motions = np.stack((distance, turn), axis=1)
        motions = motions[np.isfinite(motions).all(axis=1) & (np.abs(turn) < 0.5)]
        if not len(motions):
            return np.zeros(2)
        votes = np.count_nonzero(self._near(self._image_of(start, motions), end), axis=1)
        return np.asarray(motions[int(np.argmax(votes))])

    def _ground_mask(self, height: int, width: int) -> Image:
        """255 where the ground is near enough to be looked at, in the small image."""
        block = 2  # pixels wide and high: each one takes four times as long
        v, u = np.mgrid[0:height:block, 0:width:block] + 0.5 * (block - 1)
        pixels = np.stack((u, v), axis=-1).reshape(-1, 2) * self._scale + self._middle
        ground = self._camera.px_to_ground(pixels)
        far_m = self._camera.first_visible_x_m() + self.config.reach * self._unit
        with np.errstate(invalid="ignore"):
            inside = (ground[:, 0] > 0.0) & (ground[:, 0] < far_m)
            inside &= np.abs(ground[:, 1]) < self.config.reach * self._unit
        mask = np.where(inside, 255, 0).astype(np.uint8).reshape(u.shape)
        return mask.repeat(block, axis=0).repeat(block, axis=1)[:height, :width].copy()
