"""Roll and height of a camera from lines seen in a plane of view each: all lanes are of one width."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from automodel.config import Extrinsics
from automodel.geometry import cam_from_body_rotation
from automodel.types import FloatArray
from calibration.pencils import Pencil

WIDTHS = np.geomspace(0.9, 9.0, 231)  # of a lane, in heights of the camera: 1 % apart
AGREED = 0.04  # of a lane's width: how much lanes differ, one sigma
ONE_LANE = 0.4  # and by how much the distance of two lines may, to count as a lane at all
SUPPORT = 0.12  # share of rows on which a line is seen that needs no more
SMALLER = 0.6  # of the votes of the best width that a smaller one needs: two lanes are no lane
ROLLS_RAD = np.radians(np.arange(-8.0, 8.01, 0.25))
NO_LANE = "pictures: none shows two lines of a lane with the camera between them"
ROLL_PRIOR_RAD, ROLL_KNOWN_RAD = math.radians(3.0), math.radians(0.5)


@dataclass(frozen=True, slots=True, kw_only=True)
class Attitude:
    """A camera's `pitch_rad`, `yaw_rad` and `roll_rad`, and a lane's width in its heights, `width_heights`."""

    pitch_rad: float
    yaw_rad: float
    roll_rad: float
    width_heights: float
    roll_known: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Pairs:
    """Two lines of one picture each: steepness (n, 2) [rad], the left one's last, weight (n,) and the picture (n,)."""

    steepness_rad: FloatArray
    weight: FloatArray
    picture: NDArray[np.intp]

    def widths(self, turn_rad: float) -> FloatArray:
        """Distances (n,) in heights of the camera, of a camera turned by `turn_rad` about the line of travel."""
        right, left = np.tan(np.clip(self.steepness_rad + turn_rad, -1.5, 1.5)).T
        return left - right


def level(direction_cam: FloatArray, roll_rad: float) -> tuple[float, float]:
    """Pitch and yaw [rad] of a camera with that roll that sees body x in `direction_cam` (3,)."""
    right, down, ahead = direction_cam / np.linalg.norm(direction_cam)
    cos, sin = math.cos(roll_rad), math.sin(roll_rad)
    left, up = sin * down - cos * right, -sin * right - cos * down
    return math.atan2(up, ahead), -math.asin(left)


def _rotation(direction_cam: FloatArray, roll_rad: float) -> FloatArray:
    pitch, yaw = level(direction_cam, roll_rad)
    return cam_from_body_rotation(Extrinsics(pitch_rad=pitch, yaw_rad=yaw, roll_rad=roll_rad))


def steepness(pencil: Pencil, focal_px: float) -> FloatArray:
    """The angle (k,) [rad] of the plane through the camera and each line, for a camera without roll.

    0 straight below the camera, positive to the left: the line is tan(angle) heights of the camera to the left.
    """
    ahead = np.array((*pencil.vanishing_px, focal_px))
    along = np.column_stack((pencil.slopes, np.ones(len(pencil.slopes)), np.zeros(len(pencil.slopes))))
    normal = np.cross(ahead, along) @ _rotation(ahead, 0.0)
    return np.arctan(normal[:, 2] / normal[:, 1])


def solve_attitude(
    pencils: Sequence[Pencil], focal_px: float, roll_rad: float, near_heights: float | None = None
) -> Attitude:
    """What the lines of several pictures say; `roll_rad` stands where they do not tell the roll.

    `near_heights` is about a lane's width in heights of the camera, where it is known already. Raises ValueError where
    no two lines lie on both sides of the camera, a lane's width apart.
    """
    middle = np.median([pencil.vanishing_px for pencil in pencils], axis=0)
    ahead = np.array((*middle, focal_px))
    around = _pairs(pencils, focal_px, True)
    turn_given = float(np.interp(roll_rad, ROLLS_RAD, _turns(ahead)))
    width = near_heights or _usual_width(around, turn_given)
    turn, sigma = _level_turn(_within(_pairs(pencils, focal_px, False), width, turn_given))
    known = sigma < ROLL_KNOWN_RAD
    roll = float(np.interp(turn, _turns(ahead), ROLLS_RAD)) if known else roll_rad
    turn = turn if known else turn_given
    own = _within(around, width, turn)
    pitch, yaw = level(ahead, roll)
    widths = _median(own.widths(turn), own.weight)
    return Attitude(pitch_rad=pitch, yaw_rad=yaw, roll_rad=roll, width_heights=widths, roll_known=known)


def _turns(ahead: FloatArray) -> FloatArray:
    """By how much (n,) [rad] each of `ROLLS_RAD` turns the ground about the line of travel."""
    upright = _rotation(ahead, 0.0)
    turned = [_rotation(ahead, float(roll)).T @ upright for roll in ROLLS_RAD]
    return np.array([math.atan2(r[2, 1], r[1, 1]) for r in turned])


def _pairs(pencils: Sequence[Pencil], focal_px: float, around: bool) -> _Pairs:
    """All pairs of lines of each picture; those with the camera between them if `around`."""
    found, weights, pictures = [], [], []
    for number, pencil in enumerate(pencils):
        angle, weight = steepness(pencil, focal_px), np.minimum(pencil.support / SUPPORT, 1.0)
        for i, j in itertools.combinations(np.argsort(angle), 2):
            if not around or angle[i] < 0.0 < angle[j]:
                found.append((angle[i], angle[j]))
                weights.append(min(weight[i], weight[j]))
                pictures.append(number)
    return _Pairs(
        steepness_rad=np.array(found).reshape(-1, 2), weight=np.array(weights), picture=np.array(pictures, np.intp)
    )


def _usual_width(pairs: _Pairs, turn_rad: float) -> float:
    """The smallest width on which the pictures agree about as well as on any."""
    widths = pairs.widths(turn_rad)
    near = np.exp(-0.5 * (np.log(WIDTHS[:, None] / np.maximum(widths, 1e-3)) / AGREED) ** 2)
    each = np.zeros((int(pairs.picture.max(initial=0)) + 1, len(WIDTHS)))
    np.maximum.at(each, pairs.picture, (near * pairs.weight).T)  # a picture has one vote, however many lines it shows
    votes = each.sum(axis=0)
    if not votes.max(initial=0.0) > 0.5:
        raise ValueError(NO_LANE)
    summit = (votes >= np.roll(votes, 1)) & (votes >= np.roll(votes, -1)) & (votes >= SMALLER * votes.max())
    return float(WIDTHS[int(np.argmax(summit))])


def _within(pairs: _Pairs, width: float, turn_rad: float) -> _Pairs:
    """Those pairs that may be one lane; raises ValueError where there are none."""
    lane = np.abs(pairs.widths(turn_rad) / width - 1.0) < ONE_LANE
    if not lane.any():
        raise ValueError(NO_LANE)
    return _Pairs(steepness_rad=pairs.steepness_rad[lane], weight=pairs.weight[lane], picture=pairs.picture[lane])


def _median(values: FloatArray, weight: FloatArray) -> float:
    order = np.argsort(values)
    sums = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(sums, 0.5 * sums[-1])])


def _level_turn(pairs: _Pairs) -> tuple[float, float]:
    """The turn [rad] that makes all lanes one width, and its sigma."""
    turns = ROLLS_RAD
    costs, spreads = [], []
    for turn in turns:
        widths = pairs.widths(float(turn))
        ratio = widths / _median(widths, pairs.weight) - 1.0
        cost = float((pairs.weight * np.minimum((ratio / AGREED) ** 2, 9.0)).sum())
        costs.append(cost + (float(turn) / ROLL_PRIOR_RAD) ** 2)
        spreads.append(ratio)
    at = int(np.argmin(costs))
    best = float(turns[at])
    if 0 < at < len(turns) - 1:
        before, here, after = costs[at - 1 : at + 2]
        curve = before - 2.0 * here + after
        best += 0.5 * (before - after) / max(curve, 1e-9) * float(turns[1] - turns[0])
    near = np.abs(spreads[at]) < 3.0 * AGREED
    step = 1e-3
    slope = (np.log(pairs.widths(best + step)) - np.log(pairs.widths(best - step))) / (2.0 * step)
    weight = pairs.weight * near
    slope = slope - float(weight @ slope) / max(float(weight.sum()), 1e-9)
    information = float(weight @ slope**2) / AGREED**2
    return best, 1.0 / math.sqrt(max(information, 1e-9))
