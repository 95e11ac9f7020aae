"""Corners that both cameras see, matched without regard to the calibration: whether that explains them.

Stripes cannot tell: a line on the ground that another pair of cameras would see elsewhere looks like the next line.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from automodel.geometry import GroundCamera
from automodel.geometry.stereo_rig import Eye, StereoRig, bearings
from automodel.types import Bools, FloatArray, Image

CONTRAST = 7  # grey levels of a corner: floors are plain
NEAR_PX = 2.0  # of an epipolar line lies what may be the same point: corners are found within a pixel or two
GATE = 3.0  # sigmas that an error has at most: 1 in 370 is larger, 1 in 700 to one side
ORDER_SIGMAS = GATE  # of the sign test, which wrong matches alone exceed as rarely


@dataclass(frozen=True, slots=True, kw_only=True)
class RigCheck:
    """How well a calibrated rig explains what both cameras see.

    Of `matched` corners, `rigid` agree with one epipolar geometry, whichever that is; `error_px` is the median of their
    distances from the epipolar lines of the calibration, NaN without any. `as_given` matches can be points that both
    cameras see, and could be none if the images were exchanged; `exchanged` the other way round.
    """

    matched: int
    rigid: int
    error_px: float
    as_given: int
    exchanged: int

    @property
    def order_sigmas(self) -> float:
        """Sign test (McNemar's): below zero the images are exchanged; wrong matches fit as often here as there."""
        return (self.as_given - self.exchanged) / math.sqrt(max(self.as_given + self.exchanged, 1))


def check_rig(pairs: Iterable[tuple[Image, Image]], rig: StereoRig) -> RigCheck:
    """Check the rig with some pairs of grey images (h, w), left first."""
    matched = as_given = exchanged = 0
    errors = [np.empty(0)]
    for left, right in pairs:
        left_px, right_px = matched_corners(left, right)
        error, parallax = epipolar(rig.left, rig.right, left_px, right_px)
        fits, fits_exchanged = _possible(error, parallax), _possible(*epipolar(rig.right, rig.left, left_px, right_px))
        matched += len(error)
        as_given += int((fits & ~fits_exchanged).sum())
        exchanged += int((fits_exchanged & ~fits).sum())
        errors.append(np.abs(error)[_rigid(left_px, right_px)])
    found = np.concatenate(errors)
    error_px = float(np.median(found)) if len(found) else math.nan
    return RigCheck(matched=matched, rigid=len(found), error_px=error_px, as_given=as_given, exchanged=exchanged)


def _possible(error_px: FloatArray, parallax_px: FloatArray) -> Bools:
    """Whether matches (n,) can be points that both cameras see: on epipolar lines, and not behind the cameras."""
    return np.asarray((np.abs(error_px) < NEAR_PX) & (parallax_px > -NEAR_PX))


def matched_corners(left: Image, right: Image) -> tuple[FloatArray, FloatArray]:
    """Pixels (n, 2) of corners in the left and in the right image that are each other's most similar one."""
    finder = cv2.ORB_create(fastThreshold=CONTRAST)  # type: ignore[attr-defined]
    (left_corners, left_looks), (right_corners, right_looks) = (
        finder.detectAndCompute(image, None) for image in (left, right)
    )
    if left_looks is None or right_looks is None:
        return np.empty((0, 2)), np.empty((0, 2))
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(left_looks, right_looks)
    left_px = np.array([left_corners[pair.queryIdx].pt for pair in pairs], dtype=np.float64).reshape(-1, 2)
    right_px = np.array([right_corners[pair.trainIdx].pt for pair in pairs], dtype=np.float64).reshape(-1, 2)
    return left_px, right_px


def epipolar(
    one: GroundCamera, other: GroundCamera, one_px: FloatArray, other_px: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """How far matched pixels (n, 2) of the other image lie off the epipolar lines, and their parallax (n,) [px].

    Both are angles of the rays times the other camera's focal length. The parallax is positive where the rays converge
    ahead of the cameras, and 0 infinitely far. NaN for a pixel beyond the lens model.
    """
    ray, other_ray = (_unit(bearings(Eye.of(eye), px)) for eye, px in ((one, one_px), (other, other_px)))
    normal = _unit(np.cross(other.centre_m - one.centre_m, ray))  # of the epipolar plane
    focal_px = float(other.camera.matrix[0, 0])
    off = np.einsum("ni,ni->n", normal, other_ray)
    return focal_px * off, focal_px * np.einsum("ni,ni->n", normal, np.cross(ray, other_ray))


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _rigid(left_px: FloatArray, right_px: FloatArray) -> Bools:
    """Which matches (n,) the epipolar geometry explains that explains most of them."""
    try:
        _, mask = cv2.findFundamentalMat(left_px, right_px, cv2.USAC_MAGSAC)
    except cv2.error:  # too few matches, or such as make a geometry that OpenCV itself refuses
        mask = None
    return np.zeros(len(left_px), np.bool_) if mask is None else mask.ravel().astype(np.bool_)
