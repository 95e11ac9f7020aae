"""What all live cameras share: capture times, a watch for those that fail, and a thread that has the newest frame."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np

from automodel.interfaces import Source
from automodel.signals import Frame, StereoFrame, same_image
from automodel.sources.errors import EndOfSource, SourceError, SourceStalled
from automodel.types import Image

_NS = 1_000_000_000
_OLDEST_NS = _NS  # a driver's capture time older than this is on another clock
_POLL_S = 0.1  # timeout of a read in the capture thread, after which it checks whether to stop
_JOIN_S = 2.0
_NOTICE_S = 0.08  # a camera that fails is noticed within 0.1 s, as the loop looks every 0.02 s
_LASTING_S = 1.0
_SLOW_PERIODS = 2.25  # between two frames; a frame that was lost makes it 2
_PERIODS = 2.5  # without a new frame, where that is longer: one lost frame is no failure
_START_S = 5.0  # until the first frame: sensor and exposure take 1 to 3 s
_RATE_FRAMES = 120  # of which the rate is the mean
_FLIP_CODES = {"rotate-180": -1, "horizontal": 1, "vertical": 0}  # OpenCV's


def captured_ns(own_ns: float | None, now_ns: int, latency_s: float) -> int:
    """When a frame was captured [ns]: `own_ns`, what the camera says, or `latency_s` before it arrived at `now_ns`.

    A time of the camera's that lies ahead, or more than a second back, is on another clock and not used.
    """
    if own_ns is not None and np.isfinite(own_ns) and 0 <= now_ns - round(own_ns) <= _OLDEST_NS:
        return round(own_ns)
    return now_ns - round(latency_s * _NS)


def flipped(image: Image, flip: str) -> Image:
    """The image turned as `[camera] flip` says, where the camera does not do it itself."""
    if flip == "none":
        return image
    return np.asarray(cv2.flip(image, _FLIP_CODES[flip]), dtype=np.uint8)


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraStatus:
    """What a camera has done so far.

    `rate_hz` is the measured rate, None before the second frame. `dropped` frames arrived and were replaced by newer
    ones before anybody took them, `lost` frames are missing in the capture times and never arrived.
    """

    rate_hz: float | None
    frames: int
    dropped: int
    lost: int
    restarts: int

    def __str__(self) -> str:
        rate = "no rate" if self.rate_hz is None else f"{self.rate_hz:.1f} frames/s"
        again = f", opened again {self.restarts} times" if self.restarts else ""
        return f"{rate}, {self.frames} frames, {self.dropped} dropped, {self.lost} lost{again}"


class CameraWatch:
    """Finds out within 100 ms that a camera of `rate_hz` is dead, frozen or slow; all times are passed in.

    - dead: no frame arrives (for longer than 2.5 of its periods and than `timeout_s`, after which the car holds);
    - frozen: frames arrive, and all are the same to the last bit, which a sensor's noise never allows. An image of one
      single value says nothing: that is a covered lens.
    - slow: less than half the rate, and frames come later than half of `timeout_s`. It is told once, and again only
      after the camera was at its rate: its frames are right, and opening it anew may not help (in the dark, cameras
      expose for longer).

    A stall is lasting after a second: opening a camera anew takes longer than most stalls. The watch outlives a camera
    that is opened again, and counts over all of them.
    """

    def __init__(self, rate_hz: float, timeout_s: float = 0.0) -> None:
        self._period_ns = _NS / rate_hz
        self._patience_ns = max(_NOTICE_S * _NS, _PERIODS * self._period_ns, timeout_s * _NS)
        self._long_ns = max(_SLOW_PERIODS * self._period_ns, 0.5 * timeout_s * _NS)
        self._steps = max(2, int(0.5 * _NOTICE_S * rate_hz))  # so many long waits for a frame make a slow camera
        self._times_ns: deque[int] = deque(maxlen=_RATE_FRAMES)  # of capture
        self._opened_ns = 0
        self._arrived_ns: int | None = None
        self._new_ns = 0  # when the newest image arrived that was not the one before
        self._images: tuple[Image, ...] = ()  # the newest frame's
        self._long_waits = 0  # in a row
        self._slow_reported = False
        self._frames = self._dropped = self._lost = self._opened = 0

    @property
    def status(self) -> CameraStatus:
        """What the camera has done so far."""
        times, rate_hz = self._times_ns, None
        if len(times) > 1 and times[-1] > times[0]:
            rate_hz = (len(times) - 1) * _NS / (times[-1] - times[0])
        return CameraStatus(
            rate_hz=rate_hz,
            frames=self._frames,
            dropped=self._dropped,
            lost=self._lost,
            restarts=max(self._opened - 1, 0),
        )

    @property
    def arrived_ns(self) -> int | None:
        """When the newest frame arrived; None before the first since the camera was opened."""
        return self._arrived_ns

    @property
    def new_ns(self) -> int | None:
        """When the newest image arrived that was not the one before, or None."""
        return None if self._arrived_ns is None else self._new_ns

    def opened(self, now_ns: int) -> None:
        """The camera was opened, or opened again."""
        self._opened += 1
        self._opened_ns, self._arrived_ns, self._images = now_ns, None, ()
        self._times_ns.clear()
        self._long_waits = 0

    def dropped(self) -> None:
        """A frame was replaced before it was taken."""
        self._dropped += 1

    def arrived(self, frame: Frame | StereoFrame, now_ns: int) -> None:
        """A frame arrived; a pair is new where one of its images is: which eye is stuck, the loop finds out."""
        images = (frame.left, frame.right) if isinstance(frame, StereoFrame) else (frame.image,)
        again = len(images) == len(self._images) and all(map(_repeats, self._images, images))
        if not again:
            self._new_ns = now_ns
        self._images, self._arrived_ns = images, now_ns
        self._frames += 1
        if self._times_ns:
            waited_ns = frame.t_ns - self._times_ns[-1]
            self._lost += max(round(waited_ns / self._period_ns) - 1, 0)
            self._long_waits = self._long_waits + 1 if waited_ns > self._long_ns else 0
            self._slow_reported = self._slow_reported and waited_ns > self._long_ns
        self._times_ns.append(frame.t_ns)

    def fault(self, now_ns: int) -> SourceStalled | None:
        """What is wrong with the camera, None where nothing is."""
        if self._arrived_ns is None:
            waited_ns = now_ns - self._opened_ns
            return SourceStalled(f"no first frame within {_START_S:g} s", True) if waited_ns >= _START_S * _NS else None
        for what, since_ns in (("no frame", self._arrived_ns), ("the same frame again and again", self._new_ns)):
            if now_ns - since_ns >= self._patience_ns:
                age_s = (now_ns - since_ns) / _NS
                return SourceStalled(f"{what} for {age_s:.2f} s", age_s >= _LASTING_S)
        if self._long_waits >= self._steps and not self._slow_reported:
            self._slow_reported = True
            rate_hz = _NS / self._period_ns
            return SourceStalled(f"less than half of its {rate_hz:g} frames/s; more light, or another USB port?", True)
        return None


def _repeats(before: Image, image: Image) -> bool:
    return same_image(before, image) and image.min() != image.max()


class CaptureThread:
    """Reads a source in a daemon thread and delivers only the newest frame.

    `drops` counts the frames that were replaced before they were read. `read` passes on an error or the end of the
    wrapped source after its last frame, and raises SourceStalled for what the `watch` finds; frames that come later are
    delivered again. The thread itself closes the wrapped source, so that a driver is never closed during a read.
    """

    def __init__(self, source: Source, watch: CameraWatch | None = None) -> None:
        self.drops = 0
        self._source, self._watch = source, watch
        self._changed = threading.Condition()
        self._newest: Frame | StereoFrame | None = None
        self._end: OSError | EndOfSource | None = None
        self._stopping = False
        if watch is not None:
            watch.opened(time.monotonic_ns())
        self._thread = threading.Thread(target=self._run, name="capture", daemon=True)
        self._thread.start()

    @property
    def trouble(self) -> str:
        """What is wrong with one camera of a pair while the other one goes on (`LivePair.trouble`)."""
        return str(getattr(self._source, "trouble", ""))

    @property
    def pair(self) -> object | None:
        """What the cameras of a pair have done since they were opened (`LivePair.status`); None for a single one."""
        return getattr(self._source, "pair_status", None)

    @property
    def unpaired(self) -> int | None:
        """Frames of a pair's cameras so far without a partner (`LivePair.unpaired`); None of a single one."""
        return getattr(self._source, "unpaired", None)

    def read(self, timeout_s: float) -> Frame | StereoFrame | None:
        """The newest frame that was not delivered yet, or None if none came within `timeout_s`."""
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not None or self._end is not None, timeout_s)
            if self._newest is None and self._end is not None:
                raise self._end
            fault = None if self._watch is None else self._watch.fault(time.monotonic_ns())
            if fault is not None:  # a frame that waits is delivered next
                raise SourceStalled(f"{fault}; {self.trouble}", fault.lasting) if self.trouble else fault
            frame, self._newest = self._newest, None
            return frame

    def close(self) -> None:
        """Stop the thread and release the device; may be called twice."""
        with self._changed:
            self._stopping = True
        self._thread.join(_JOIN_S)

    def _run(self) -> None:
        end: OSError | EndOfSource = SourceError("the capture thread died")
        try:
            while not self._stopping:
                frame = self._source.read(_POLL_S)
                if frame is not None:
                    self._put(frame)
            end = EndOfSource("closed")
        except (OSError, EndOfSource) as error:
            end = error
        finally:
            with self._changed:
                self._end = end
                self._changed.notify_all()
            self._source.close()

    def _put(self, frame: Frame | StereoFrame) -> None:
        with self._changed:
            if self._watch is not None and not self._stopping:
                self._watch.arrived(frame, time.monotonic_ns())
            if self._newest is not None:
                self.drops += 1
                if self._watch is not None:
                    self._watch.dropped()
            self._newest = frame
            self._changed.notify_all()
