"""What the stages of `stereo` found in a pair, as marks in both images: for people who want to see how they work."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from automodel.curves import Curve
from automodel.geometry import GroundCamera
from automodel.geometry.stereo_rig import Plane, StereoRig
from automodel.perception.stereo.matching import Matches
from automodel.perception.stereo.stripes import Stripes
from automodel.signals import Role, StageMark, StageView
from automodel.types import Bools, Complexes, FloatArray

_FAR_M = 1e4  # a point of the ground as far as the horizon: 1e-4 rad below it for a camera a metre up
_VIEW_RAD = 1.2  # to each side of a camera's axis, in which its horizon is drawn
_SAMPLES = 60  # of a horizon and of a curve


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairStages:
    """What the stages of one pair made, left before right.

    `seen`: whether there is an image of the eye; `predicted`: the ground, on which `place` (k,) is the predicted
    centerline x + i y [m]. `inliers` (m,): the matches on the plane; `odds` (s,) [nats] that a stripe is
    paint on the ground, those of the left image first; `lines`: those on the ground, each (k, 2) [m].
    """

    seen: tuple[bool, bool]
    stripes: tuple[Stripes, Stripes]
    predicted: Plane
    place: Complexes
    matches: Matches
    inliers: Bools
    odds: FloatArray
    lines: Sequence[FloatArray]


def stage_views(found: PairStages, rig: StereoRig, plane: Plane, lane: Sequence[Curve]) -> tuple[StageView, ...]:
    """The stages in the order in which they work, each in the eyes that there are.

    `plane` is the measured one, on which `lane` are the lane's lines and its middle.
    """
    predicted, measured = rig.over(found.predicted), rig.over(plane)
    views: list[StageView] = []
    for eye in (0, 1):
        if found.seen[eye]:
            stages = {
                "search region": _region(found, eye, predicted[eye]),
                "ridges": _ridges(found.stripes[eye]),
                "stripes": _stripes(found, eye),
                "matches": _matches(found, eye, predicted),
                "ground plane": _plane(found, predicted[eye], (rig.left, rig.right)[eye], measured[eye]),
                "lane": _lane(found.lines, lane, measured[eye]),
            }
            views += [StageView(stage=stage, eye=eye, marks=tuple(marks)) for stage, marks in stages.items()]
    return tuple(views)


def _region(found: PairStages, eye: int, camera: GroundCamera) -> Iterator[StageMark]:
    """Where a ridge would be found, and the predicted centerline."""
    field = found.stripes[eye].field
    there = np.isfinite(field.ends).all(axis=1) if len(field.rows) else np.zeros(0, dtype=np.bool_)
    if there.any():
        rows, ends = field.rows[there], field.ends[there]
        one, other = (np.column_stack((ends[:, side], rows)) for side in (0, 1))
        yield _polyline(Role.FOUND, np.concatenate((one, other[::-1], one[:1])))
    yield _polyline(Role.EXPECTED, camera.ground_to_px(np.column_stack((found.place.real, found.place.imag))))


def _ridges(stripes: Stripes) -> Iterator[StageMark]:
    """Ridges that another one continues, and those of stripes as wide as they are."""
    half = np.column_stack((0.5 * stripes.width_px, np.zeros(len(stripes.width_px))))
    yield StageMark(role=Role.FOUND, pixels=stripes.traces.pixels)
    yield _segments(Role.USED, stripes.pixels - half, stripes.pixels + half)


def _stripes(found: PairStages, eye: int) -> Iterator[StageMark]:
    """The mid-line of each stripe, and whether it counts as paint on the ground."""
    stripes, first = found.stripes[eye], found.stripes[0].count * eye
    for k in range(stripes.count):
        role = Role.LEFT_OUT if found.odds[first + k] < 0.0 else Role.USED
        yield _polyline(role, stripes.pixels[stripes.stripe == k])


def _matches(found: PairStages, eye: int, cameras: tuple[GroundCamera, GroundCamera]) -> Iterator[StageMark]:
    """In the left image the ridges that have a match; in the right one these from where the ground would put them."""
    left = found.stripes[0].pixels[found.matches.ridge]
    if eye == 0:
        yield StageMark(role=Role.FOUND, pixels=left)
        return
    matched = cameras[1].body_to_px(found.matches.points_m)
    yield _segments(Role.EXPECTED, cameras[1].ground_to_px(cameras[0].px_to_ground(left)), matched)
    yield StageMark(role=Role.FOUND, pixels=matched)


def _plane(
    found: PairStages, predicted: GroundCamera, calibrated: GroundCamera, measured: GroundCamera
) -> Iterator[StageMark]:
    """The matches on the plane and off it, and its horizon beside that of the calibration."""
    matched = predicted.body_to_px(found.matches.points_m)
    yield _polyline(Role.EXPECTED, _horizon(calibrated))
    yield _polyline(Role.USED, _horizon(measured))
    yield StageMark(role=Role.LEFT_OUT, pixels=matched[~found.inliers])
    yield StageMark(role=Role.USED, pixels=matched[found.inliers])


def _lane(lines: Sequence[FloatArray], lane: Sequence[Curve], measured: GroundCamera) -> Iterator[StageMark]:
    """The lines on the ground, and the lane that was fitted to those of them that are its own."""
    for line in lines:
        yield StageMark(role=Role.FOUND, pixels=measured.ground_to_px(line))
    for curve in lane:
        points_m = curve.position(np.linspace(0.0, curve.length_m, _SAMPLES))
        yield _polyline(Role.USED, measured.ground_to_px(points_m))


def _horizon(camera: GroundCamera) -> FloatArray:
    """Its pixels (n, 2), from right to left."""
    axis = camera.cam_from_body[2]
    azimuth = math.atan2(axis[1], axis[0]) + np.linspace(-_VIEW_RAD, _VIEW_RAD, _SAMPLES)
    return camera.ground_to_px(camera.centre_m[:2] + _FAR_M * np.column_stack((np.cos(azimuth), np.sin(azimuth))))


def _polyline(role: Role, pixels: FloatArray) -> StageMark:
    return StageMark(role=role, pixels=pixels, joined=True)


def _segments(role: Role, starts: FloatArray, ends: FloatArray) -> StageMark:
    """Lines from each start (n, 2) to its end (n, 2)."""
    return _polyline(role, np.stack((starts, ends, np.full_like(starts, np.nan)), axis=1).reshape(-1, 2))
