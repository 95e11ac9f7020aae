"""Checks the car's camera: size, rate, exposure and sharpness of about a second of frames, and the lane in them."""

from __future__ import annotations

import dataclasses
import itertools
import math
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from automodel.assembly.parts import make_pipeline
from automodel.config import CarConfig
from automodel.doctor.camera_pair import judge_times, rig_findings
from automodel.doctor.findings import Finding, bounded, fail, okay, skip, warn
from automodel.interfaces import Source, cameras_of
from automodel.signals import Frame, LaneEstimate, Motion, MotionSource, StereoFrame
from automodel.sources.errors import EndOfSource, SourceError
from automodel.sources.images import with_channels
from automodel.sources.pairs import PairStatus
from automodel.types import Image

AnyFrame = Frame | StereoFrame

RATE_OK = 0.1  # largest relative error of the rate
RATE_FAIL = 0.5  # largest share of the rate that may be missing

LEAST_POINTS = 3  # of each line
LEAST_FRAMES = 5
WIDTH_OK, WIDTH_FAIL = 0.08, 0.25  # relative error of the width; rendered lanes are measured within 0.02
_ROUNDS = 5

BLACK = 30  # grey level; an image that is nearly all below it shows nothing
DARK = 70  # markings on a lit floor are far above it
BURNT = 250
BURNT_WARN, BURNT_FAIL = 0.15, 0.5  # share of saturated pixels: a white wall, a lamp; the road itself
FLAT = 25  # grey levels between the darkest and the brightest hundredth: a cap, fog, a wall

REACH_PX = 12  # distance from an edge within which its contrast is measured; blur beyond some 4 px is underestimated
CONTRAST = 30  # grey levels; noise alone does not reach it
EDGES = 50  # least number
SHARPEST = 20  # percentile of the edges' blur that counts; the others may be out of focus or soft themselves
BLUR_WARN_PX, BLUR_FAIL_PX = 1.9, 3.2
_SMOOTHING_PX = 0.7

FIRST_S = 6.0  # until the first frame; the camera of a Jetson takes two or three
SETTLING_S = 0.5  # until exposure and rate are steady
LOOKING_S = 1.0
KEPT = 20  # frames for the lane
_PATIENCE_S = 12.0
_MOST = 1000  # frames, in case the stamps do not rise
_LANE_S = 60.0


@dataclass(slots=True, kw_only=True)
class Capture:
    """Time stamps of all frames after the first ones, and the newest frames; `repeated` counts identical ones.

    `own_time` says whether the stamps are the camera's own, None where the source does not tell. Of a pair the frames
    are the left ones; `pairs` are the newest ones. `begun` and `status` say of two live cameras what they had done at
    the first frame and at the end.
    """

    stamps_ns: list[int] = field(default_factory=list)
    frames: list[Frame] = field(default_factory=list)
    repeated: int = 0
    own_time: bool | None = None
    pairs: list[StereoFrame] = field(default_factory=list)
    begun: PairStatus | None = None
    status: PairStatus | None = None

    def add(self, got: AnyFrame, keep: int) -> None:
        """One more frame; the newest `keep` are kept."""
        frame = left_frame(got)
        if isinstance(got, StereoFrame):
            self.pairs = [*self.pairs, got][-keep:]
        if self.frames and (self.frames[-1].image.shape == frame.image.shape):
            self.repeated += int((self.frames[-1].image == frame.image).all())
        self.stamps_ns.append(frame.t_ns)
        self.frames = [*self.frames, frame][-keep:]


def judge_resolution(capture: Capture, car: CarConfig) -> Finding:
    """The image size against car.toml."""
    name = "resolution"
    height, width = capture.frames[-1].image.shape[:2]
    wanted = car.camera.width_px, car.camera.height_px
    if (width, height) != wanted:
        do = "set [camera] width_px and height_px to the camera's size, and calibrate for it"
        return fail(name, f"expected {wanted[0]}x{wanted[1]} pixels as in car.toml, got {width}x{height}", do)
    return okay(name, f"{width}x{height} pixels")


def judge_stamps(capture: Capture, latency_s: float = 0.0) -> Finding:
    """Whether time stamps rise and images change, and whose times they are."""
    name = "time stamps"
    count = len(capture.stamps_ns)
    if count < 2:
        return fail(name, f"got {count} frame", "check the cable; try another program with this camera")
    back = sum(b <= a for a, b in itertools.pairwise(capture.stamps_ns))
    if back:
        do = "use another driver or kernel for this camera: the car holds on such frames"
        return fail(name, f"{back} of {count} are not later than the one before", do)
    if capture.repeated == count - 1:
        do = "plug the camera in again: two live images are never identical (rendered ones are)"
        return warn(name, f"rise, but all {count} images are identical", do)
    what = f"{count} rise, and the images change"
    if capture.own_time is None:
        return okay(name, what)
    if capture.own_time:
        return okay(name, f"{what}; they are the camera's own")
    what += f"; they are times of arrival, less {1e3 * latency_s:g} ms"
    if latency_s == 0.0:
        do = (
            "measure [camera] latency_s: automodel doctor --latency; the car takes its pictures for newer than they are"
        )
        return warn(name, what, do)
    return okay(name, what)


def judge_rate(capture: Capture, car: CarConfig) -> Finding:
    """The rate [Hz] from the stamps, and the longest gap against [safety] frame_timeout_s."""
    name = "frame rate"
    steps = [(b - a) * 1e-9 for a, b in itertools.pairwise(capture.stamps_ns)]
    span_s = (capture.stamps_ns[-1] - capture.stamps_ns[0]) * 1e-9 if steps else 0.0
    if span_s <= 0.0:
        return fail(name, "no rate: the time stamps do not rise", "see the check of time stamps")
    rate, wanted = len(steps) / span_s, car.camera.rate_hz
    longest, timeout_s = max(steps), car.safety.frame_timeout_s
    what = f"{rate:.1f} Hz (car.toml: {wanted:g}), {statistics.median(steps) * 1e3:.1f} ms apart, {longest * 1e3:.0f} "
    what += "at most"
    if rate < (1.0 - RATE_FAIL) * wanted or statistics.median(steps) > timeout_s:
        do = "more light, a smaller image, another USB port; such a slow camera needs a smaller [camera] "
        do += f"rate_hz, and a [safety] frame_timeout_s above {1.5 / rate:.3f}"
        return fail(name, what, do)
    if abs(rate - wanted) > RATE_OK * wanted:
        do = f"more light, or [camera] rate_hz = {rate:.0f} (v4l2-ctl --list-formats-ext lists the camera's rates)"
        return warn(name, what, do)
    if longest > timeout_s:
        do = f"close other programs; the car holds after {timeout_s * 1e3:.0f} ms without a frame"
        return warn(name, what, do)
    return okay(name, what)


def line_distance_m(left_m: NDArray[np.float64], right_m: NDArray[np.float64]) -> float | None:
    """The distance [m] of two parallel lines from their points (n, 2), (m, 2) in the body frame, left first.

    Both lines are y = a + b x + c x^2 with common b and c; the difference of a, perpendicular to the lines. Weights
    reduce the influence of outliers. None for too few points, or points all at one place.
    """
    if min(len(left_m), len(right_m)) < LEAST_POINTS:
        return None
    x, y = np.vstack((left_m, right_m)).T
    middle = float(np.median(x))
    x = x - middle
    is_left = np.arange(len(x)) < len(left_m)
    terms = np.stack((is_left, ~is_left, x, x * x), axis=1).astype(np.float64)
    if np.linalg.matrix_rank(terms) < terms.shape[1]:
        return None
    weight = np.ones(len(x))
    for _ in range(_ROUNDS):
        found = np.linalg.lstsq(terms * weight[:, None], y * weight, rcond=None)[0]
        off = np.abs(terms @ found - y)
        weight = 1.0 / np.sqrt(1.0 + (off / max(2.0 * float(np.median(off)), 1e-4)) ** 2)
    return float((found[0] - found[1]) / np.hypot(1.0, found[2]))


def seen_width_m(estimate: LaneEstimate) -> float | None:
    """The lane's width [m] from the points of this frame; None unless both lines are seen.

    `estimate.pose.width_m` is filtered: it starts at the width of car.toml and changes slowly.
    """
    left, right = estimate.left, estimate.right
    if left is None or right is None or not (left.seen and right.seen):
        return None
    return line_distance_m(left.points_m, right.points_m)


def judge_width(widths_m: Sequence[float], car: CarConfig) -> Finding:
    """The widths [m] of the frames in which both lines were seen."""
    name, wanted = "lane width", car.lane.width_m
    if len(widths_m) < LEAST_FRAMES:
        return skip(name, "no lane is seen", "put the car in the middle of a straight part of the lane and run again")
    width = statistics.median(widths_m)
    off = width / wanted - 1.0
    what = f"{width:.3f} m seen, {wanted:.3f} m in car.toml ({off:+.0%})"
    if abs(off) <= WIDTH_OK:
        return okay(name, what)
    do = "measure the lane and set [lane] width_m; if it is right: automodel calibrate ground"
    return (fail if abs(off) > WIDTH_FAIL else warn)(name, what, do)


def judge_exposure(grey: Image) -> Finding:
    """Too dark, overexposed, without contrast, or right; `grey` is uint8 (h, w)."""
    name = "exposure"
    low, middle, bright, high = (float(v) for v in np.percentile(grey, (1, 50, 95, 99)))
    burnt = float((grey >= BURNT).mean())
    levels = f"grey levels {low:.0f} to {high:.0f}, median {middle:.0f}"
    if high < BLACK:
        return fail(name, f"the image is black: {levels}", "take the cap off the lens, switch a light on")
    if burnt > BURNT_FAIL:
        return fail(name, f"overexposed: {burnt:.0%} of the image is white", "shade the camera, lower its exposure")
    if high - low < FLAT:
        return fail(name, f"nothing is visible: {levels}", "uncover and clean the lens, point the camera at the road")
    if bright < DARK:
        return warn(name, f"too dark: {levels}", "more light, or a longer exposure (v4l2-ctl --list-ctrls)")
    if burnt > BURNT_WARN:
        return warn(name, f"{burnt:.0%} of the image is overexposed", "turn lamps away, lower the camera's exposure")
    return okay(name, levels)


def blur_px(grey: Image) -> float | None:
    """The blur of the sharpest edges, as a standard deviation [px]; None for too few edges.

    An edge of contrast c, blurred by a Gaussian of standard deviation s, has the slope c / (s sqrt(2 pi)) at its
    middle, so contrast and steepest slope give s, on rows and on columns. A sharp image has about 1, from the pixels
    themselves and the smoothing against noise.
    """
    smooth = cv2.GaussianBlur(grey, (0, 0), _SMOOTHING_PX).astype(np.float32)
    window = np.ones((1, 2 * REACH_PX + 1), np.uint8)
    found = []
    for rows in (smooth, np.ascontiguousarray(smooth.T)):
        if rows.shape[1] <= 2 * REACH_PX:
            continue
        slope = np.zeros_like(rows)
        slope[:, 1:-1] = 0.5 * np.abs(rows[:, 2:] - rows[:, :-2])
        contrast = np.asarray(cv2.dilate(rows, window)) - np.asarray(cv2.erode(rows, window))
        edge = (slope >= np.asarray(cv2.dilate(slope, window))) & (contrast >= CONTRAST)
        edge[:, :REACH_PX] = edge[:, -REACH_PX:] = False
        found.append(contrast[edge] / (slope[edge] * math.sqrt(2.0 * math.pi)))
    blurs = np.concatenate(found) if found else np.empty(0)
    return float(np.percentile(blurs, SHARPEST)) if len(blurs) >= EDGES else None


def judge_sharpness(grey: Image) -> Finding:
    """Whether the lens is in focus; `grey` is uint8 (h, w), taken while the car stands."""
    name = "sharpness"
    blur = blur_px(grey)
    if blur is None:
        return skip(name, "the image has too few edges", "point the camera at the track and run again")
    what = f"edges are blurred by {blur:.1f} px"
    if blur > BLUR_FAIL_PX:
        return fail(name, what, "focus the lens (turn it in its thread), clean it, remove its foil")
    if blur > BLUR_WARN_PX:
        return warn(name, what, "focus the lens at 1 m until this number is smallest; 1 is sharp")
    return okay(name, what)


def camera_findings(car: CarConfig, open_camera: Callable[[], Source], frames: list[AnyFrame]) -> Iterator[Finding]:
    """Everything about the camera; its newest frames are put into `frames`."""
    capture = Capture()
    looked = bounded("camera", lambda: _look(open_camera, capture), _PATIENCE_S, _what_to_do(car))
    failed = isinstance(looked, Finding)
    yield looked if isinstance(looked, Finding) else okay("camera", f"{_name(car)}, first frame after {looked:.1f} s")
    if capture.status is not None and car.camera.right is not None:
        yield judge_times(capture.begun, capture.status, car.camera.right.tolerance_s(car.camera.rate_hz))
    if failed:
        yield skip("images", "not checked: there are none")
        return
    frames += capture.pairs or capture.frames
    yield judge_resolution(capture, car)
    yield judge_stamps(capture, min(eye.latency_s for eye in car.camera.eyes))
    yield judge_rate(capture, car)
    grey = with_channels(capture.frames[-1].image, False)
    yield judge_exposure(grey)
    yield judge_sharpness(grey)
    if capture.pairs:
        grey = with_channels(capture.pairs[-1].right, False)
        for finding in (judge_exposure(grey), judge_sharpness(grey)):
            yield dataclasses.replace(finding, name=f"right {finding.name}")
        yield from rig_findings(car, capture.pairs)


def lane_finding(car: CarConfig, frames: list[AnyFrame]) -> Finding:
    """The lane's width in the frames of a car at standstill."""

    def look() -> Finding:
        # the processor finds the same lines as an accelerator, without its start-up time
        options = dataclasses.replace(car.pipeline.centerline, providers=("cpu",))
        pipeline = make_pipeline(
            car.pipeline.name, dataclasses.replace(car, pipeline=dataclasses.replace(car.pipeline, centerline=options))
        )
        widths, step = [], cast(Callable[[AnyFrame, Motion], LaneEstimate], pipeline.step)
        for frame in frames if cameras_of(pipeline) > 1 else map(left_frame, frames):
            still = Motion(t_ns=frame.t_ns, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)
            width = seen_width_m(step(frame, still))
            if width is not None:
                widths.append(width)
        return judge_width(widths, car)

    return bounded("lane width", look, _LANE_S, "see [pipeline], [lane] and [camera.extrinsics] in car.toml")


def _look(open_camera: Callable[[], Source], capture: Capture) -> float:
    """Put the frames after settling into `capture`; the time to the first frame [s]. Raises SourceError."""
    start = time.perf_counter()
    source = open_camera()
    try:
        first = _first(source, start)
        first_s = time.perf_counter() - start
        capture.begun = getattr(source, "pair_status", None)
        while time.perf_counter() - start < FIRST_S + SETTLING_S + 2.0 * LOOKING_S:
            frame = _next(source)
            if frame is None:
                break
            if (frame.t_ns - first.t_ns) * 1e-9 >= SETTLING_S or frame.t_ns <= first.t_ns:
                capture.add(frame, KEPT)
            if (frame.t_ns - first.t_ns) * 1e-9 >= SETTLING_S + LOOKING_S or len(capture.stamps_ns) >= _MOST:
                break
        if not capture.frames:
            capture.add(first, KEPT)
        capture.own_time = getattr(source, "own_time", None)
        return first_s
    finally:
        capture.status = getattr(source, "pair_status", None)
        source.close()


def _first(source: Source, start: float) -> AnyFrame:
    while time.perf_counter() - start < FIRST_S:
        frame = _next(source)
        if frame is None:
            break
        return frame
    raise SourceError(f"no frame within {FIRST_S:g} s")


def _next(source: Source) -> AnyFrame | None:
    """The next frame; None at the end and on a timeout."""
    try:
        return source.read(FIRST_S)
    except EndOfSource:
        return None


def left_frame(frame: AnyFrame) -> Frame:
    """The frame itself, or the left one of a pair."""
    if isinstance(frame, Frame):
        return frame
    return Frame(t_ns=frame.t_ns, index=frame.index, image=frame.left)


def _name(car: CarConfig) -> str:
    source, devices = car.camera.source, [car.camera.device]
    if car.camera.right is not None and car.camera.right.device is not None:
        devices.append(car.camera.right.device)
    names = {
        "sim": "the simulated camera",
        "csi": " and ".join(f"CSI camera {device}" for device in devices),
        "usb": " and ".join(f"/dev/video{device}" for device in devices),
    }
    return f"{names.get(source, source)} open{'s' if source == 'sim' or len(devices) == 1 else ''}"


def _what_to_do(car: CarConfig) -> str:
    if car.camera.source == "usb":
        there = ", ".join(sorted(str(path) for path in Path("/dev").glob("video*"))) or "none"
        return f"here are: {there}; plug the camera in, set [camera] device, add the user to the group video"
    if car.camera.source == "csi":
        return "check the ribbon cable (off, contacts towards the board), then: sudo systemctl restart nvargus-daemon"
    return 'set [camera] source to "csi" or "usb"'
