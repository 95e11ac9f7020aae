"""What can go wrong with a camera: hooks that take a frame and give what comes out of the faulty one."""

from __future__ import annotations

from collections.abc import Callable
from random import Random

import numpy as np

from automodel.bench.faults.hooks import CameraHook
from automodel.signals import Frame
from automodel.sources.errors import SourceError
from automodel.types import Image

Spoil = Callable[[Frame], Frame | None]


def at_once(spoil: Spoil) -> CameraHook:
    """Frames that are spoilt, and come when they would have come."""

    def hook(frame: Frame) -> tuple[int, Frame] | None:
        spoilt = spoil(frame)
        return None if spoilt is None else (0, spoilt)

    return hook


def for_first(count: int, spoil: Spoil) -> CameraHook:
    """The first `count` frames only."""
    seen = 0

    def hook(frame: Frame) -> tuple[int, Frame] | None:
        nonlocal seen
        seen += 1
        spoilt = spoil(frame) if seen <= count else frame
        return None if spoilt is None else (0, spoilt)

    return hook


def in_bursts(count: int, between: int, spoil: Spoil) -> CameraHook:
    """`count` frames in a row, then `between` good ones, and so on."""
    seen = 0

    def hook(frame: Frame) -> tuple[int, Frame] | None:
        nonlocal seen
        seen += 1
        spoilt = spoil(frame) if (seen - 1) % (count + between) < count else frame
        return None if spoilt is None else (0, spoilt)

    return hook


def drop(frame: Frame) -> None:
    """No frame at all."""


def gone(frame: Frame) -> Frame | None:
    """The driver's error."""
    raise SourceError("camera: gone; is it plugged in?")


class Frozen:
    """The first picture again and again, with new times."""

    def __init__(self) -> None:
        self._image: Image | None = None

    def __call__(self, frame: Frame) -> Frame:
        """The frame with the first one's picture."""
        if self._image is None:
            self._image = frame.image
        return Frame(t_ns=frame.t_ns, index=frame.index, image=self._image)


def blank(level: float, noise: float, random: Random) -> Spoil:
    """A picture of one grey level, with a sensor's noise on it."""
    generator = np.random.default_rng(random.getrandbits(32))

    def spoil(frame: Frame) -> Frame:
        noisy = level + noise * generator.standard_normal(frame.image.shape)
        return _with(frame, np.clip(noisy, 0, 255).astype(np.uint8))

    return spoil


def resized(random: Random) -> Spoil:
    """A part of the picture, as after the camera was set to another size."""
    rows, columns = random.choice(((1, 2), (2, 1), (2, 2), (3, 3)))
    return lambda frame: _with(frame, np.ascontiguousarray(frame.image[::rows, ::columns]))


def of_another_type(frame: Frame) -> Frame:
    """Sixteen bits a pixel, which no `Frame` takes."""
    return Frame(t_ns=frame.t_ns, index=frame.index, image=frame.image.astype(np.uint16))


def shifted_in_time(by_ns: int) -> Spoil:
    """The same picture, said to be taken at another time."""
    return lambda frame: Frame(t_ns=frame.t_ns + by_ns, index=frame.index, image=frame.image)


def late(draw_ns: Callable[[], int]) -> CameraHook:
    """The right time on every frame, but each delivered only so long after it."""
    return lambda frame: (frame.t_ns + draw_ns(), frame)


def _with(frame: Frame, image: Image) -> Frame:
    return Frame(t_ns=frame.t_ns, index=frame.index, image=image)
