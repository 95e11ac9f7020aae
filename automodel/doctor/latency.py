"""Measures the time from light to a frame's time stamp: a light blinks at random, and the camera looks at it.

Where a camera says when it captured, this tells how right it is; elsewhere the result is `[camera] latency_s`.
"""

from __future__ import annotations

import contextlib
import random
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from automodel.config import CarConfig
from automodel.doctor.findings import Finding, bounded, okay, skip, warn
from automodel.interfaces import Source
from automodel.signals import StereoFrame
from automodel.sources.errors import EndOfSource, SourceError
from automodel.types import FloatArray, Image

Light = Callable[[bool], None]
Lamp = Callable[[], AbstractContextManager[Light]]

SCREEN = "screen"
BLOCKS = (16, 9)  # parts of the image: one of them sees the light
SWITCHES = 48
DARK_S, BRIGHT_S = 0.15, 0.40  # shortest and longest time between two switches: random, so that only one delay fits
EARLIEST_S, LATEST_S = -0.1, 0.5  # of the stamps against the light
SEEN = 0.7  # least correlation of a block with the light
GOOD_S = 0.005  # a car at 1 m/s drives half a centimetre in it
_GRID_S = 0.0005
_PARTS = 4  # of the time, each evaluated by itself: how far they are apart is the error
_NEAR = 0.985  # of the best correlation: such delays fit as well
_LED_FOLDER = Path("/sys/class/leds")
_STARTING_S = 6.0
_PATIENCE_S = 60.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Blinking:
    """What was seen of a blinking light.

    `switched_ns` (m,) are the times at which the light was switched, in turn on and off, on first; before it was off.
    `stamps_ns` (n,) are the frames' times, `levels` (n, k) the mean grey levels of the k parts of each frame.
    `own_time` says whether the stamps are the camera's own.
    """

    switched_ns: Sequence[int]
    stamps_ns: Sequence[int]
    levels: FloatArray
    own_time: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Delay:
    """By how much the stamps are late [s], its standard deviation [s], and the correlation of the best part."""

    late_s: float
    sigma_s: float
    correlation: float


def stamp_delay(seen: Blinking) -> Delay | None:
    """How late the frames' stamps are against the light that they show; None where no part of the image blinks.

    The levels of each part are compared with the light's state at the frames' stamps less a delay, for all delays: the
    middle of those that fit as well as the best one is the result. Frames that were exposed during a switch have levels
    in between, and only lower the correlation.
    """
    delays_s = np.arange(EARLIEST_S, LATEST_S, _GRID_S)
    if len(seen.stamps_ns) < 4 * _PARTS or len(seen.switched_ns) < 2 * _PARTS:
        return None
    origin_ns = seen.switched_ns[0]
    stamps_s = (np.asarray(seen.stamps_ns, dtype=np.int64) - origin_ns) * 1e-9
    switched_s = (np.asarray(seen.switched_ns, dtype=np.int64) - origin_ns) * 1e-9
    # The number of switches before a time is odd while the light is on.
    light = np.searchsorted(switched_s, stamps_s[None, :] - delays_s[:, None]) % 2
    fits = _correlations(light.astype(np.float64), np.asarray(seen.levels, dtype=np.float64))
    delay, part = np.unravel_index(int(np.argmax(fits)), fits.shape)
    best = float(fits[delay, part])
    if not best >= SEEN:
        return None
    levels = seen.levels[:, part : part + 1]
    pieces = [
        _middle(delays_s, _correlations(light[:, rows].astype(np.float64), levels[rows])[:, 0])
        for rows in np.array_split(np.arange(len(stamps_s)), _PARTS)
    ]
    sigma_s = float(np.std(pieces, ddof=1)) / np.sqrt(_PARTS)
    return Delay(late_s=_middle(delays_s, fits[:, part]), sigma_s=float(sigma_s), correlation=best)


def _correlations(light: FloatArray, levels: FloatArray) -> FloatArray:
    """Of the light's states (d, n) with the levels (n, k): (d, k), 0 where either does not change."""
    light = light - light.mean(axis=1, keepdims=True)
    levels = levels - levels.mean(axis=0)
    sizes = np.sqrt((light**2).sum(axis=1))[:, None] * np.sqrt((levels**2).sum(axis=0))[None, :]
    return np.divide(light @ levels, sizes, out=np.zeros_like(sizes), where=sizes > 1e-9)


def _middle(delays_s: FloatArray, fit: FloatArray) -> float:
    """The middle of the delays around the best one that fit nearly as well."""
    good = fit >= _NEAR * fit.max()
    best = int(np.argmax(fit))
    before = best - int(np.argmin(good[best::-1])) + 1 if not good[: best + 1].all() else 0
    after = best + int(np.argmin(good[best:])) - 1 if not good[best:].all() else len(good) - 1
    return float(0.5 * (delays_s[before] + delays_s[after]))


def judge_latency(seen: Blinking, car: CarConfig, where: str) -> Finding:
    """The result for car.toml, or how right the camera's own times are."""
    name, delay = "camera latency", stamp_delay(seen)
    if delay is None:
        do = "point the camera at the light, so that it fills a tenth of the picture, and darken the room; run again"
        return warn(name, f"no part of the picture blinks with {where}", do)
    late_ms, sigma_ms = 1e3 * delay.late_s, 1e3 * delay.sigma_s
    what = f"frames are stamped {late_ms:.1f} ms (+- {sigma_ms:.1f}) after their light"
    what += "; a screen's own delay of 10 to 30 ms is in it, an LED has none" if where == SCREEN else ""
    if abs(delay.late_s) <= max(GOOD_S, 2.0 * delay.sigma_s):
        return okay(name, what)
    if seen.own_time:
        do = "the camera's own times are off, and [camera] latency_s is not for them: try another driver"
        return warn(name, what, do)
    latency_s = max(car.camera.latency_s + delay.late_s, 0.0)
    return warn(name, what, f"set [camera] latency_s = {latency_s:.3f} (it is {car.camera.latency_s:g})")


def latency_finding(car: CarConfig, open_camera: Callable[[], Source], where: str) -> Finding:
    """Blink the light `where` ("screen", or an LED) before the car's camera, and judge what it sees of it."""
    if car.camera.source == "sim":
        return skip("camera latency", "a simulated camera's times are right")
    lamp: Lamp = screen if where == SCREEN else lambda: led(Path(where))

    def look() -> Finding:
        with lamp() as light:
            return judge_latency(watch_blinking(open_camera, light), car, where)

    do = "an LED is a folder below /sys/class/leds, and sudo may be needed; else --latency screen"
    return bounded("camera latency", look, _PATIENCE_S, do)


def watch_blinking(open_camera: Callable[[], Source], light: Light) -> Blinking:
    """Switch the light at random for about 13 s, and keep what the camera sees of it; raises SourceError."""
    source = open_camera()
    stamps: list[int] = []
    levels: list[FloatArray] = []
    switched: list[int] = []
    light(False)
    try:
        if source.read(_STARTING_S) is None:
            raise SourceError(f"no frame within {_STARTING_S:g} s")
        hand = threading.Thread(target=_blink, args=(light, switched), daemon=True)
        hand.start()
        while hand.is_alive() or (time.monotonic_ns() - switched[-1]) * 1e-9 < LATEST_S:
            frame = source.read(_STARTING_S)
            if frame is None:
                raise SourceError(f"no frame within {_STARTING_S:g} s")
            stamps.append(frame.t_ns)
            levels.append(_levels(frame.left if isinstance(frame, StereoFrame) else frame.image))
        own_time = bool(getattr(source, "own_time", False))
    except EndOfSource:
        raise SourceError("the camera has ended") from None
    finally:
        source.close()
    return Blinking(switched_ns=switched, stamps_ns=stamps, levels=np.array(levels), own_time=own_time)


def _blink(light: Light, switched: list[int]) -> None:
    """Switch it `SWITCHES` times, on first; a thread of its own, so that the frames do not set the pace."""
    draw = random.Random(0)
    for number in range(SWITCHES):
        time.sleep(draw.uniform(DARK_S, BRIGHT_S))
        before_ns = time.monotonic_ns()
        light(number % 2 == 0)
        switched.append((before_ns + time.monotonic_ns()) // 2)


def _levels(image: Image) -> FloatArray:
    """The mean levels (k,) of the image's parts."""
    return cv2.resize(image, BLOCKS, interpolation=cv2.INTER_AREA).reshape(BLOCKS[0] * BLOCKS[1], -1).mean(axis=1)


@contextlib.contextmanager
def screen() -> Iterator[Light]:
    """This terminal, which turns dark and bright as a whole (DECSCNM); raises OSError where there is none."""
    if not sys.stdout.isatty():
        raise OSError("this is no terminal; name an LED instead")

    def light(on: bool) -> None:
        sys.stdout.write("\x1b[?5h" if on else "\x1b[?5l")
        sys.stdout.flush()

    try:
        yield light
    finally:
        light(False)


@contextlib.contextmanager
def led(folder: Path) -> Iterator[Light]:
    """An LED of the kernel's by its folder or its name; what it showed before, it shows again afterwards."""
    folder = folder if folder.is_absolute() else _LED_FOLDER / folder
    trigger, brightness = folder / "trigger", folder / "brightness"
    before = trigger.read_text(encoding="ascii")
    was_bright = brightness.read_text(encoding="ascii")
    most = (folder / "max_brightness").read_text(encoding="ascii").strip()
    trigger.write_text("none", encoding="ascii")

    def light(on: bool) -> None:
        brightness.write_text(most if on else "0", encoding="ascii")

    try:
        yield light
    finally:
        brightness.write_text(was_bright, encoding="ascii")
        chosen = before.partition("[")[2].partition("]")[0]
        if chosen:
            trigger.write_text(chosen, encoding="ascii")
