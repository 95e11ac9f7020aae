"""What can go wrong: hooks that take a right frame, estimate, reading or lot of bytes and give a wrong one."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from random import Random
from typing import Any, TypeVar

import cv2
import numpy as np

from automodel.bench.faults.fault import CameraHook, LaneHook, PairHook, RigHook, SensorHook, WireHook
from automodel.config import CameraConfig
from automodel.curves import Curve, TabulatedCurve, line
from automodel.signals import BoardSensors, Frame, LaneEstimate, LaneStatus, StereoFrame
from automodel.sources.errors import SourceError
from automodel.sources.pairs import MISSING_PERIODS
from automodel.types import Image
from firmware_link import messages

Spoil = Callable[[Frame], Frame | None]
Arrivals = tuple[tuple[int, bytes], ...]  # when [ns] which bytes arrive
Value = TypeVar("Value")
Spoilt = TypeVar("Spoilt")


def at_once(spoil: Spoil) -> CameraHook:
    """Frames are spoilt, and delivered when they are due."""

    def hook(frame: Frame) -> tuple[int, Frame] | None:
        spoilt = spoil(frame)
        return None if spoilt is None else (0, spoilt)

    return hook


def for_first(count: int, spoil: Callable[[Value], Spoilt]) -> Callable[[Value], Spoilt | Value]:
    """Spoil the first `count` only."""
    seen = itertools.count()
    return lambda value: spoil(value) if next(seen) < count else value


def in_bursts(count: int, between: int, spoil: Spoil) -> Spoil:
    """Spoil `count` frames in a row, then leave `between`, and so on."""
    seen = itertools.count()
    return lambda frame: spoil(frame) if next(seen) % (count + between) < count else frame


def drop(frame: Frame) -> None:
    """No frame."""


def gone(frame: Frame) -> Frame | None:
    """The driver's error."""
    raise SourceError("camera: gone; is it plugged in?")


def frozen() -> Spoil:
    """The first image again and again, with new times."""
    first: list[Image] = []

    def spoil(frame: Frame) -> Frame:
        if not first:
            first.append(frame.image)
        return replace(frame, image=first[0])

    return spoil


def blank(level: float, noise: float, random: Random) -> Spoil:
    """An image of one grey level with sensor noise."""
    generator = np.random.default_rng(random.getrandbits(32))

    def spoil(frame: Frame) -> Frame:
        noisy = level + noise * generator.standard_normal(frame.image.shape)
        return replace(frame, image=np.clip(noisy, 0, 255).astype(np.uint8))

    return spoil


def resized(random: Random) -> Spoil:
    """Part of the image's rows and columns, as if the camera was set to another size."""
    rows, columns = random.choice(((1, 2), (2, 1), (2, 2), (3, 3)))
    return lambda frame: replace(frame, image=np.ascontiguousarray(frame.image[::rows, ::columns]))


def of_another_type(frame: Frame) -> Frame:
    """Sixteen bits a pixel, which `Frame` refuses."""
    return replace(frame, image=frame.image.astype(np.uint16))


def sliding(shift_px: Callable[[int], float]) -> Spoil:
    """What a pipeline takes for paint slides to the right by `shift_px` of the frame's time: all of the image does."""

    def spoil(frame: Frame) -> Frame:
        height, width = frame.image.shape[:2]
        moved = np.array(((1.0, 0.0, shift_px(frame.t_ns)), (0.0, 1.0, 0.0)))
        image = cv2.warpAffine(frame.image, moved, (width, height), borderMode=cv2.BORDER_REPLICATE)
        return replace(frame, image=np.asarray(image, dtype=np.uint8))

    return spoil


def with_lines(random: Random, count: int) -> Spoil:
    """Lines that are not there, each from the bottom of the image towards the horizon, as bright as paint."""
    ends = [(random.uniform(-0.2, 1.2), random.uniform(0.3, 0.7)) for _ in range(count)]

    def spoil(frame: Frame) -> Frame:
        image = frame.image.copy()
        height, width = image.shape[:2]
        bright = int(np.percentile(image, 99))
        for bottom, top in ends:
            start, end = (round(bottom * width), height - 1), (round(top * width), round(0.4 * height))
            cv2.line(image, start, end, (bright,) * 3, max(width // 60, 1), cv2.LINE_AA)
        return replace(frame, image=image)

    return spoil


def shifted_in_time(by_ns: int) -> Spoil:
    """The same image with another time."""
    return lambda frame: replace(frame, t_ns=frame.t_ns + by_ns)


def late(draw_ns: Callable[[], int]) -> CameraHook:
    """Every frame has the right time, but is delivered so much later."""
    return lambda frame: (frame.t_ns + draw_ns(), frame)


def of_eye(eye: int, spoil: Spoil) -> PairHook:
    """The images of one eye of a pair (0: left, 1: right) are spoilt."""

    def hook(pair: StereoFrame) -> tuple[int, StereoFrame] | None:
        spoilt = spoil(Frame(t_ns=pair.t_ns, index=pair.index, image=(pair.left, pair.right)[eye]))
        if spoilt is None:
            return None
        return 0, replace(pair, right=spoilt.image) if eye else replace(pair, left=spoilt.image)

    return hook


def alone(eye: int, period_ns: int, latency_ns: int) -> PairHook:
    """The other camera has died, and the frames of `eye` come alone, as from `LivePair`.

    That waits for the other camera's image for `MISSING_PERIODS` since its last one: of the frames meanwhile the newest
    comes late, and those before it are lost.
    """
    seen, late, after_ns = itertools.count(1), int(MISSING_PERIODS), round(MISSING_PERIODS % 1.0 * period_ns)

    def hook(pair: StereoFrame) -> tuple[int, Frame] | None:
        number = next(seen)
        if number < late:
            return None
        image = (pair.left, pair.right)[eye]
        frame = Frame(t_ns=pair.t_ns + eye * pair.right_late_ns, index=pair.index, image=image, eye=eye)
        return (pair.t_ns + latency_ns + after_ns if number == late else 0), frame

    return hook


def exchanged(pair: StereoFrame) -> tuple[int, StereoFrame]:
    """The left image is the right camera's, and the other way round."""
    return 0, replace(pair, left=pair.right, right=pair.left)


def turned(angle_rad: float) -> Spoil:
    """The camera is turned about its optical axis, counterclockwise as it looks."""

    def spoil(frame: Frame) -> Frame:
        height, width = frame.image.shape[:2]
        # what a camera that is turned one way sees is turned the other way
        turn = cv2.getRotationMatrix2D((0.5 * (width - 1), 0.5 * (height - 1)), -math.degrees(angle_rad), 1.0)
        image = cv2.warpAffine(frame.image, turn, (width, height), borderMode=cv2.BORDER_REPLICATE)
        return replace(frame, image=np.asarray(image, dtype=np.uint8))

    return spoil


def eye_turned(eye: int, angle: str, by_rad: float) -> RigHook:
    """One camera is turned against its calibration: this angle of its extrinsics is larger by so much."""

    def hook(eyes: tuple[CameraConfig, ...]) -> tuple[CameraConfig, ...]:
        at = eyes[eye].extrinsics
        there = replace(eyes[eye], extrinsics=replace(at, **{angle: getattr(at, angle) + by_rad}))
        return (*eyes[:eye], there, *eyes[eye + 1 :])

    return hook


def falling_apart(frames: int) -> PairHook:
    """The right image is an older and older one, at last of `frames` frames before; its time says so."""
    before: list[StereoFrame] = []

    def hook(pair: StereoFrame) -> tuple[int, StereoFrame]:
        before.append(pair)
        older = before[max(len(before) - 1 - frames, 0)]
        late_ns = older.t_ns + older.right_late_ns - pair.t_ns
        return 0, replace(pair, right=older.right, right_late_ns=late_ns)

    return hook


def raising(estimate: LaneEstimate) -> LaneEstimate:
    """An exception."""
    raise RuntimeError("the pipeline has failed")


def lost(estimate: LaneEstimate) -> LaneEstimate:
    """No lane."""
    return LaneEstimate(t_ns=estimate.t_ns, status=LaneStatus.LOST)


def coasting(estimate: LaneEstimate) -> LaneEstimate:
    """No line seen; the lane is predicted by the car's motion."""
    return replace(estimate, status=LaneStatus.COASTING) if estimate.valid else estimate


def one_line(estimate: LaneEstimate) -> LaneEstimate:
    """One of the lines is seen."""
    return replace(estimate, status=LaneStatus.ONE_LINE) if estimate.valid else estimate


def after(count: int, first: LaneHook, then: LaneHook) -> LaneHook:
    """`first` spoils the first `count` estimates, `then` the others."""
    seen = itertools.count()
    return lambda estimate: (first if next(seen) < count else then)(estimate)


def times_width(factor: float) -> LaneHook:
    """The lane is `factor` times as wide."""

    def hook(estimate: LaneEstimate) -> LaneEstimate:
        pose = estimate.pose
        return estimate if pose is None else replace(estimate, pose=replace(pose, width_m=factor * pose.width_m))

    return hook


def with_pose(**changes: Any) -> LaneHook:
    """Other values in fields of the pose."""

    def hook(estimate: LaneEstimate) -> LaneEstimate:
        if estimate.pose is None:
            return estimate
        return replace(estimate, pose=replace(estimate.pose, **changes))

    return hook


def uncertain(offset_bound_m: float) -> LaneHook:
    """The same lane, but its offset may be wrong by `offset_bound_m`."""
    return with_pose(offset_bound_m=offset_bound_m)


def without_pose(estimate: LaneEstimate) -> LaneEstimate:
    """A valid estimate without a pose."""
    return replace(estimate, pose=None)


def decoy(lateral_m: float) -> LaneHook:
    """Another line is taken for the lane's: all of the lane lies `lateral_m` to the left."""

    def hook(estimate: LaneEstimate) -> LaneEstimate:
        pose, centerline = estimate.pose, estimate.centerline
        if pose is None or centerline is None:
            return estimate
        wrong = replace(pose, offset_m=pose.offset_m - lateral_m)
        return replace(estimate, pose=wrong, centerline=_shifted(centerline, lateral_m))

    return hook


def crossing(turn_rad: float) -> LaneHook:
    """A line across the road is taken for the lane's: the lane turns by `turn_rad` to the left at the car."""

    def hook(estimate: LaneEstimate) -> LaneEstimate:
        if estimate.pose is None:
            return estimate
        pose = replace(estimate.pose, heading_rad=-turn_rad, curvature_per_m=0.0)
        return replace(estimate, pose=pose, centerline=line(0.0, 0.0, turn_rad, 1.4))

    return hook


def _shifted(curve: Curve, lateral_m: float) -> TabulatedCurve:
    s = np.linspace(0.0, curve.length_m, 31)
    return TabulatedCurve(s, curve.offset_position(s, lateral_m), curve.heading(s), curve.curvature(s))


def battery(voltage_v: float) -> SensorHook:
    """A battery of this voltage."""
    return lambda sensors: replace(sensors, battery_v=voltage_v)


def dropouts(random: Random, share: float) -> SensorHook:
    """Each range is missing in this share of the readings."""

    def hook(sensors: BoardSensors) -> BoardSensors:
        left, centre, right = (None if random.random() < share else range_m for range_m in sensors.ranges_m)
        return replace(sensors, ranges_m=(left, centre, right))

    return hook


def spikes(random: Random, every: int) -> SensorHook:
    """A false short echo, once in `every` readings."""
    seen = itertools.count(1 + random.randrange(every))

    def hook(sensors: BoardSensors) -> BoardSensors:
        if next(seen) % every:
            return sensors
        return replace(sensors, ranges_m=(0.1, random.uniform(0.02, 0.3), 0.1))

    return hook


def stuck_echo(range_m: float) -> SensorHook:
    """All three sensors read the same, whatever is ahead."""
    return lambda sensors: replace(sensors, ranges_m=(range_m, range_m, range_m))


def silent(data: bytes, t_ns: int) -> Arrivals:
    """Nothing arrives."""
    return ()


def held_back(until_ns: int) -> WireHook:
    """Nothing arrives before `until_ns`, then everything at once."""
    return lambda data, t_ns: ((until_ns, data),)


def delayed(by_ns: int) -> WireHook:
    """Everything arrives so much later."""
    return lambda data, t_ns: ((t_ns + by_ns, data),)


def falling_behind(from_ns: int, rate: float) -> WireHook:
    """Everything arrives later and later: by `rate` seconds for each second since `from_ns`."""
    return lambda data, t_ns: ((t_ns + round(rate * (t_ns - from_ns)), data),)


def noise_before(random: Random, at_most: int) -> WireHook:
    """Up to `at_most` random bytes before what was sent."""
    return lambda data, t_ns: ((t_ns, random.randbytes(random.randint(1, at_most)) + data),)


def random_bytes(random: Random) -> WireHook:
    """Random bytes, as many as were sent."""
    return lambda data, t_ns: ((t_ns, random.randbytes(len(data))),)


def cut(random: Random) -> WireHook:
    """Only the start of what was sent."""
    return lambda data, t_ns: ((t_ns, data[: random.randint(1, max(len(data) - 2, 1))]),)


def doubled(data: bytes, t_ns: int) -> Arrivals:
    """Everything arrives twice."""
    return ((t_ns, data + data),)


def swapped() -> WireHook:
    """Every other lot of bytes arrives after the one that was sent after it."""
    held: list[bytes] = []

    def hook(data: bytes, t_ns: int) -> Arrivals:
        if held:
            return ((t_ns, data + held.pop()),)
        held.append(data)
        return ()

    return hook


def corrupt(random: Random) -> WireHook:
    """One to five wrong bits in every lot of bytes."""

    def hook(data: bytes, t_ns: int) -> Arrivals:
        spoilt = bytearray(data)
        for bit in random.sample(range(8 * len(data)), min(random.randint(1, 5), 8 * len(data))):
            spoilt[bit // 8] ^= 1 << bit % 8
        return ((t_ns, bytes(spoilt)),)

    return hook


def time_stuck() -> WireHook:
    """The board's messages come, but its time stands still."""
    decoder, first_us = messages.decoder(on_board=False), []

    def hook(data: bytes, t_ns: int) -> Arrivals:
        out = b""
        for frame in decoder.feed(data):
            message = messages.decode(frame)
            if isinstance(message, messages.Status | messages.Odometry | messages.Ranges):
                first_us.append(message.time_us)
                message = replace(message, time_us=first_us[0])
            out += messages.encode(message, frame.counter)
        return ((t_ns, out),)

    return hook


def once(spoil: WireHook) -> WireHook:
    """Spoil the first lot of bytes only."""
    seen = itertools.count()
    return lambda data, t_ns: spoil(data, t_ns) if data and next(seen) == 0 else ((t_ns, data),)


def one_byte(random: Random) -> WireHook:
    """One wrong byte in the first lot."""

    def spoil(data: bytes, t_ns: int) -> Arrivals:
        place = random.randrange(len(data))
        other = (data[place] + random.randint(1, 255)) & 0xFF
        return ((t_ns, data[:place] + bytes((other,)) + data[place + 1 :]),)

    return once(spoil)
