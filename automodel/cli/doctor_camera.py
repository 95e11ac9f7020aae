"""Looks through the car's camera for a second or two, and for a lane in its pictures."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from automodel.cli.doctor_bounds import bounded
from automodel.config import CarConfig
from automodel.doctor.capture import Capture, judge_rate, judge_resolution, judge_stamps
from automodel.doctor.findings import Finding, okay, skip
from automodel.doctor.lane import judge_width, seen_width_m
from automodel.doctor.pictures import grey_of, judge_exposure, judge_sharpness
from automodel.interfaces import Source
from automodel.pipelines import make_pipeline
from automodel.signals import Frame, Motion, MotionSource
from automodel.sources.errors import EndOfSource, SourceError

FIRST_S = 6.0  # until the first picture; a Jetson's camera takes two or three
SETTLING_S = 0.5  # of stamps that are not counted: exposure and rate settle
LOOKING_S = 1.0
KEPT = 20  # pictures for the lane
_PATIENCE_S = 12.0
_MOST = 1000  # pictures, where stamps do not rise
_LANE_S = 60.0


def camera_findings(car: CarConfig, open_camera: Callable[[], Source], frames: list[Frame]) -> Iterator[Finding]:
    """What the camera gives; its newest pictures are put into `frames`."""
    looked = bounded("camera", lambda: _look(open_camera), _PATIENCE_S, _what_to_do(car))
    if isinstance(looked, Finding):
        yield looked
        yield skip("pictures", "not looked at: there are none")
        return
    capture, first_s = looked
    frames += capture.frames
    yield okay("camera", f"{_name(car)} opens, first picture after {first_s:.1f} s")
    yield judge_resolution(capture, car)
    yield judge_stamps(capture)
    yield judge_rate(capture, car)
    grey = grey_of(capture.frames[-1].image)
    yield judge_exposure(grey)
    yield judge_sharpness(grey)


def lane_finding(car: CarConfig, frames: list[Frame]) -> Finding:
    """The lane's width in the pictures of a car that stands."""

    def look() -> Finding:
        # The processor finds the same lines as what drives, and is ready at once.
        options = dataclasses.replace(car.pipeline.centerline, providers=("cpu",))
        pipeline = make_pipeline(
            car.pipeline.name,
            dataclasses.replace(car, pipeline=dataclasses.replace(car.pipeline, centerline=options)),
        )
        widths = []
        for frame in frames:
            still = Motion(t_ns=frame.t_ns, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)
            width = seen_width_m(pipeline.step(frame, still))
            if width is not None:
                widths.append(width)
        return judge_width(widths, car)

    return bounded("lane width", look, _LANE_S, "see [pipeline], [lane] and [camera.extrinsics] in car.toml")


def _look(open_camera: Callable[[], Source]) -> tuple[Capture, float]:
    """What the camera gave once it had settled, and the time to its first picture [s]; raises SourceError."""
    begin = time.perf_counter()
    source = open_camera()
    try:
        first = _first(source, begin)
        first_s = time.perf_counter() - begin
        capture = Capture()
        while time.perf_counter() - begin < FIRST_S + SETTLING_S + 2.0 * LOOKING_S:
            frame = _next(source)
            if frame is None:
                break
            if (frame.t_ns - first.t_ns) * 1e-9 >= SETTLING_S or frame.t_ns <= first.t_ns:
                capture.add(frame, KEPT)
            if (frame.t_ns - first.t_ns) * 1e-9 >= SETTLING_S + LOOKING_S or len(capture.stamps_ns) >= _MOST:
                break
        if not capture.frames:
            capture.add(first, KEPT)
        return capture, first_s
    finally:
        source.close()


def _first(source: Source, begin: float) -> Frame:
    while time.perf_counter() - begin < FIRST_S:
        frame = _next(source)
        if frame is None:
            break
        return frame
    raise SourceError(f"no picture within {FIRST_S:g} s")


def _next(source: Source) -> Frame | None:
    """The next picture, None at the end and when none comes; the left one of a pair."""
    try:
        frame = source.read(FIRST_S)
    except EndOfSource:
        return None
    if frame is None or isinstance(frame, Frame):
        return frame
    return Frame(t_ns=frame.t_ns, index=frame.index, image=frame.left)


def _name(car: CarConfig) -> str:
    source, device = car.camera.source, car.camera.device
    known = {"sim": "the simulated camera", "csi": f"CSI camera {device}", "usb": f"/dev/video{device}"}
    return known.get(source, source)


def _what_to_do(car: CarConfig) -> str:
    if car.camera.source == "usb":
        there = ", ".join(sorted(str(path) for path in Path("/dev").glob("video*"))) or "none"
        return f"here are: {there}; plug the camera in, set [camera] device, add the user to the group video"
    if car.camera.source == "csi":
        return "look at the ribbon cable (off, pins towards the board), then: sudo systemctl restart nvargus-daemon"
    return 'set [camera] source to "csi" or "usb"'
