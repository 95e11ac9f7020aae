"""Two sources as one pair of cameras, by the times of their frames: recorded ones, and live ones."""

from __future__ import annotations

import statistics
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace

from automodel.interfaces import Source
from automodel.signals import SIDES, Frame, StereoFrame
from automodel.sources.cameras import CameraStatus, CameraWatch
from automodel.sources.errors import EndOfSource, SourceError

_NS = 1_000_000_000
MISSING_PERIODS = 2.5  # without a new image a camera is missing: one lost frame is no failure, and at 60 Hz the other
# camera's image comes before the car is held ([safety] frame_timeout_s)
_AHEAD = 2  # frames of the other camera meanwhile: else it is the machine that stood still
_APART = 4  # frames in a row, of both cameras, without a partner: more than a lost one of each explains
_START_S = 3.0  # until a camera's first frame: sensor and exposure take 1 to 3 s
_LASTING_S = 1.0  # a camera that is missing for so long is opened again, as `CameraWatch` has it for a single one
_AGAIN_S = 1.0  # between two tries to open it
_OLDEST_S = 0.5  # frames that wait for a partner: none is driven on that is older ([camera] latency_s is at most that)
_POLL_S = 0.1  # timeout of a read in a camera's thread, after which it looks whether to stop
_JOIN_S = 2.0
_REMEMBERED = 3600  # pairs of which the times between their images are kept: a minute's


class Pairing:
    """Finds the frames of two cameras that belong together: those taken within `tolerance_s` of each other.

    Frames of one side come in order. `unpaired` counts those without a partner, `missed` those of them since the last
    pair; `missed_ns` are the times between the newest of them and a frame of the other side. Raises ValueError for a
    tolerance below zero.
    """

    def __init__(self, tolerance_s: float) -> None:
        if not tolerance_s >= 0.0:
            raise ValueError(f"tolerance_s: expected 0 or more, got {tolerance_s}")
        self.tolerance_s, self.unpaired, self.missed = tolerance_s, 0, 0
        self.missed_ns: deque[int] = deque(maxlen=_REMEMBERED)
        self.waiting: tuple[deque[Frame], deque[Frame]] = (deque(), deque())

    def step(self) -> StereoFrame | None:
        """The next pair of those that wait; None where a frame is still to come. Its time is its left frame's."""
        left, right = self.waiting
        while left and right:
            late_ns = right[0].t_ns - left[0].t_ns
            if abs(late_ns) * 1e-9 <= self.tolerance_s:
                one, other, self.missed = left.popleft(), right.popleft(), 0
                return StereoFrame(
                    t_ns=one.t_ns, index=one.index, left=one.image, right=other.image, right_late_ns=late_ns
                )
            (left if late_ns > 0 else right).popleft()
            self.missed_ns.append(abs(late_ns))
            self.unpaired, self.missed = self.unpaired + 1, self.missed + 1
        return None


class PairSource:
    """Implements `Source`: two recorded sources as pairs, by `Pairing`.

    A pair has time and index of its left frame. `unpaired` counts the frames of either side without a partner, at the
    end of `read`'s pairs also those that one side has beyond the other's end. Raises ValueError for a tolerance below
    zero.
    """

    def __init__(self, left: Source, right: Source, tolerance_s: float) -> None:
        self._pairing = Pairing(tolerance_s)
        self._sides, self.tolerance_s = (left, right), tolerance_s
        self.rate_hz = getattr(left, "rate_hz", 0.0)
        self.frame_count = getattr(left, "frame_count", None)

    @property
    def unpaired(self) -> int:
        """Frames so far without a partner."""
        return self._pairing.unpaired

    def read(self, timeout_s: float) -> StereoFrame | None:
        """The next pair, None if a frame did not come in time; raises EndOfSource where either side ends."""
        until = time.monotonic() + timeout_s
        while (pair := self._pairing.step()) is None:
            side = 1 if self._pairing.waiting[0] else 0
            frame = self._next(side, max(until - time.monotonic(), 0.0))
            if frame is None:
                return None
            self._pairing.waiting[side].append(frame)
        return pair

    def close(self) -> None:
        """Close both."""
        self.frame_count = None
        for side in self._sides:
            side.close()

    def _next(self, side: int, timeout_s: float) -> Frame | None:
        """The next frame of a side; at its end the rest of the other one has no partner."""
        try:
            frame = self._sides[side].read(timeout_s)
        except EndOfSource:
            other = self._sides[1 - side]
            self._pairing.unpaired += sum(map(len, self._pairing.waiting)) + _rest(lambda: other.read(timeout_s))
            for waiting in self._pairing.waiting:
                waiting.clear()
            raise
        return None if frame is None else _single(frame)


def _single(frame: Frame | StereoFrame) -> Frame:
    if isinstance(frame, StereoFrame):
        raise TypeError("a pair of pairs: each side must be a single camera")
    return frame


def _rest(read: Callable[[], object]) -> int:
    """How many frames are left."""
    count = 0
    try:
        while read() is not None:
            count += 1
    except EndOfSource:
        pass
    return count


@dataclass(frozen=True, slots=True, kw_only=True)
class PairStatus:
    """What a pair of live cameras has done so far.

    `pairs` were made, `alone` frames were delivered of one camera while the other one was missing, `unpaired` frames
    had no partner and `repeated` images, of the left camera and of the right one, were those before them: both were
    dropped. `apart_s` and `apart_max_s` are the median and the longest time between the images of a pair, None without;
    `missed_s` is the median between a frame without a partner and the next one of the other camera.
    """

    eyes: tuple[CameraStatus, CameraStatus]
    pairs: int
    alone: int
    unpaired: int
    repeated: tuple[int, int]
    apart_s: float | None
    apart_max_s: float | None
    missed_s: float | None

    def __str__(self) -> str:
        eyes = "; ".join(f"{side} {status}" for side, status in zip(SIDES, self.eyes, strict=True))
        text = f"{eyes}; {self.pairs} pairs, {self.unpaired} frames without a partner"
        if self.alone:
            text += f", {self.alone} frames of one camera alone"
        if self.apart_s is not None and self.apart_max_s is not None:
            text += f"; images of a pair {1e3 * self.apart_s:.1f} ms apart, {1e3 * self.apart_max_s:.1f} at most"
        return text


@dataclass(slots=True, eq=False)
class _Eye:
    """One camera of a live pair.

    `error` is why it gives no frames, None while it works; `ahead` counts its new images since the other one's last.
    """

    open: Callable[[], Source]
    source: Source
    watch: CameraWatch
    opened_ns: int
    error: OSError | EndOfSource | None = None
    repeated: int = 0
    ahead: int = 0
    thread: threading.Thread = field(init=False)


class LivePair:
    """Implements `Source`: two live cameras of `rate_hz`, each read in a thread of its own, as pairs, by `Pairing`.

    `read` gives the newest pair that was not delivered yet; older ones are dropped. A camera is missing where its
    driver reports an error, or no image comes, or the same one again and again, for 2.5 periods. It does not hold up
    the other one, whose frames then come alone (`Frame.eye`) until pairs come again. It is opened again by its thread
    until it works. `trouble` says which camera is missing and why, "" where none is.

    Raises SourceError where a camera cannot be opened in the first place (nothing stays open then), and from `read`
    where both have failed.
    """

    def __init__(self, cameras: Sequence[Callable[[], Source]], tolerance_s: float, rate_hz: float) -> None:
        self.rate_hz, self.tolerance_s = rate_hz, tolerance_s
        self._patience_ns, self._half_ns = round(MISSING_PERIODS * _NS / rate_hz), round(0.5 * _NS / rate_hz)
        self._pairing = Pairing(tolerance_s)
        self._most = max(2, round(_OLDEST_S * rate_hz))
        self._changed, self._stop = threading.Condition(), threading.Event()
        self._newest: StereoFrame | None = None
        self._delivered_ns: int | None = None  # the capture time of what was delivered last
        self._index = self._pairs = self._alone = 0
        self._late_ns: deque[int] = deque(maxlen=_REMEMBERED)
        with ExitStack() as opened:
            eyes = []
            for side, camera in zip(SIDES, cameras, strict=True):
                source = _opened(side, camera)
                opened.callback(source.close)
                eyes.append(_Eye(camera, source, CameraWatch(rate_hz), time.monotonic_ns()))
            opened.pop_all()
        self._eyes = eyes[0], eyes[1]
        for number, eye in enumerate(self._eyes):
            eye.watch.opened(eye.opened_ns)
            eye.thread = threading.Thread(target=self._run, args=(number,), name=f"camera {SIDES[number]}", daemon=True)
            eye.thread.start()

    @property
    def own_time(self) -> bool | None:
        """Whether the frames' times are the cameras' own, both of them; None where one does not tell."""
        said = [getattr(eye.source, "own_time", None) for eye in self._eyes]
        return None if None in said else all(said)

    @property
    def trouble(self) -> str:
        """Why there are no pairs, in one line that stays the same while that lasts; "" where nothing is wrong."""
        with self._changed:
            return self._trouble(time.monotonic_ns())

    @property
    def unpaired(self) -> int:
        """Frames so far without a partner."""
        return self._pairing.unpaired

    @property
    def pair_status(self) -> PairStatus:
        """What both have done so far."""
        with self._changed:
            left, right = self._eyes
            late = [abs(late_ns) / _NS for late_ns in self._late_ns]
            missed = [late_ns / _NS for late_ns in self._pairing.missed_ns]
            return PairStatus(
                eyes=(left.watch.status, right.watch.status),
                pairs=self._pairs,
                alone=self._alone,
                unpaired=self._pairing.unpaired,
                repeated=(left.repeated, right.repeated),
                apart_s=statistics.median(late) if late else None,
                apart_max_s=max(late) if late else None,
                missed_s=statistics.median(missed) if missed else None,
            )

    def read(self, timeout_s: float) -> Frame | StereoFrame | None:
        """The newest pair, the newest frame of one camera while the other one is missing, None if none came in time."""
        until_ns = time.monotonic_ns() + round(timeout_s * _NS)
        with self._changed:
            while True:
                now_ns = time.monotonic_ns()
                frame = self._take(now_ns)
                if frame is not None:
                    return frame
                if all(eye.error is not None for eye in self._eyes):
                    raise self._end()
                if now_ns >= until_ns:
                    return None
                self._changed.wait((min(until_ns, self._next_look_ns(now_ns)) - now_ns) / _NS)

    def close(self) -> None:
        """Stop both threads and release the cameras; may be called twice."""
        self._stop.set()
        for eye in self._eyes:
            eye.thread.join(_JOIN_S)

    def _take(self, now_ns: int) -> Frame | StereoFrame | None:
        frame: Frame | StereoFrame | None = self._newest
        self._newest = None
        if frame is None:
            frame = self._take_alone(now_ns)
        if frame is None or (self._delivered_ns is not None and frame.t_ns <= self._delivered_ns):
            return None
        self._delivered_ns = frame.t_ns
        return frame

    def _take_alone(self, now_ns: int) -> Frame | None:
        """The newest waiting frame of a camera whose partner is missing."""
        for number, waiting in enumerate(self._pairing.waiting):
            if waiting and self._missing(1 - number, now_ns):
                frame = waiting.pop()
                self._pairing.unpaired += len(waiting)
                waiting.clear()
                self._alone += 1
                return Frame(t_ns=frame.t_ns, index=self._numbered(), image=frame.image, eye=number)
        return None

    def _numbered(self) -> int:
        self._index += 1
        return self._index - 1

    def _next_look_ns(self, now_ns: int) -> int:
        """When a frame that waits may have to go alone."""
        due = [
            (self._eyes[1 - number].watch.new_ns or now_ns) + self._patience_ns
            for number, waiting in enumerate(self._pairing.waiting)
            if waiting
        ]
        return max(min(due, default=now_ns + _NS), now_ns + _NS // 1000)

    def _missing(self, number: int, now_ns: int) -> str:
        """Why a camera is missing, "" where it is not."""
        eye = self._eyes[number]
        if eye.error is not None:
            return str(eye.error) or "has ended"
        new_ns, arrived_ns = eye.watch.new_ns, eye.watch.arrived_ns
        if new_ns is None or arrived_ns is None:
            return f"no first frame within {_START_S:g} s" if now_ns - eye.opened_ns >= _START_S * _NS else ""
        if now_ns - new_ns < self._patience_ns or self._eyes[1 - number].ahead < _AHEAD:
            return ""
        return "no frame comes" if now_ns - arrived_ns >= self._patience_ns else "the same image again and again"

    def _trouble(self, now_ns: int) -> str:
        missing = [self._missing(number, now_ns) for number in (0, 1)]
        texts = [f"{side} camera: {why}" for side, why in zip(SIDES, missing, strict=True) if why]
        if texts or self._pairing.missed < _APART:
            return "; ".join(texts)
        most_ms = 1e3 * self._pairing.tolerance_s
        return (
            f"both cameras give frames, but none within {most_ms:.3g} ms of each other: trigger them together, or "
            "raise [camera.right] pair_tolerance_s"
        )

    def _end(self) -> OSError | EndOfSource:
        if all(isinstance(eye.error, EndOfSource) for eye in self._eyes):
            return EndOfSource()
        said = (f"{side} camera: {str(eye.error) or 'has ended'}" for side, eye in zip(SIDES, self._eyes, strict=True))
        return SourceError("; ".join(said))

    def _run(self, number: int) -> None:
        """The thread of a camera: its frames, and the camera again where it failed."""
        eye = self._eyes[number]
        end: OSError | EndOfSource = SourceError("its thread died")
        try:
            while not self._stop.is_set():
                try:
                    frame = eye.source.read(_POLL_S)
                    if frame is not None:
                        self._put(number, frame)
                    self._check(number)
                except (OSError, EndOfSource, ValueError) as error:  # the last: an image of a kind that none gives
                    self._failed(eye, error)
                    self._open_again(eye)
            end = EndOfSource("closed")
        finally:
            self._failed(eye, end)
            eye.source.close()

    def _put(self, number: int, frame: Frame | StereoFrame) -> None:
        if isinstance(frame, StereoFrame):
            raise SourceError("gives pairs by itself; remove [camera.right] device")
        eye, now_ns = self._eyes[number], time.monotonic_ns()
        with self._changed:
            eye.watch.arrived(frame, now_ns)
            if eye.watch.new_ns != now_ns:
                eye.repeated += 1
                return
            eye.error = None
            other = self._eyes[1 - number]
            eye.ahead += now_ns - (other.watch.new_ns or 0) > self._half_ns  # else it is that one's partner
            other.ahead = 0
            waiting = self._pairing.waiting[number]
            waiting.append(frame)
            if len(waiting) > self._most:
                waiting.popleft()
                self._pairing.unpaired += 1
            while (pair := self._pairing.step()) is not None:
                self._pairs += 1
                self._late_ns.append(pair.right_late_ns)
                self._newest = replace(pair, index=self._numbered())
            self._changed.notify_all()

    def _check(self, number: int) -> None:
        """Raise SourceError for a camera that has been missing for so long that it is opened again."""
        eye, now_ns = self._eyes[number], time.monotonic_ns()
        with self._changed:
            since_ns = eye.opened_ns + round(_START_S * _NS) if eye.watch.new_ns is None else eye.watch.new_ns
            why = self._missing(number, now_ns)
        if why and now_ns - since_ns >= _LASTING_S * _NS:
            raise SourceError(why)

    def _failed(self, eye: _Eye, error: Exception) -> None:
        with self._changed:
            eye.error = error if isinstance(error, OSError | EndOfSource) else SourceError(str(error))
            self._changed.notify_all()

    def _open_again(self, eye: _Eye) -> None:
        """Close a camera and open it again, as soon as that works; its error stays until a frame comes."""
        eye.source.close()
        while not self._stop.wait(_AGAIN_S):
            try:
                eye.source = eye.open()
            except (OSError, ValueError):
                continue  # it is still gone
            with self._changed:
                eye.opened_ns = time.monotonic_ns()
                eye.watch.opened(eye.opened_ns)
            return


def _opened(side: str, camera: Callable[[], Source]) -> Source:
    try:
        return camera()
    except SourceError as error:
        raise SourceError(f"{side} camera: {error}") from None
