"""Two sources as one pair: by time, with a count of what has no partner."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import pytest

from automodel.signals import Frame, StereoFrame
from automodel.sources.cameras import CameraWatch, CaptureThread
from automodel.sources.errors import EndOfSource, SourceError, SourceStalled
from automodel.sources.pairs import LivePair, PairSource
from tests.support.fed_cameras import FedCamera

MS = 1_000_000


class Timed:
    """Frames of these times [ms], each with its time as grey level; None: no frame in time."""

    rate_hz = 50.0

    def __init__(self, times_ms: Sequence[int | None]) -> None:
        self.times_ms, self.next, self.closed = list(times_ms), 0, False

    def read(self, timeout_s: float) -> Frame | None:
        if self.next == len(self.times_ms):
            raise EndOfSource
        self.next += 1
        t_ms = self.times_ms[self.next - 1]
        if t_ms is None:
            return None
        return Frame(t_ns=t_ms * MS, index=self.next - 1, image=np.full((2, 2), t_ms, np.uint8))

    def close(self) -> None:
        self.closed = True


def pairs(left: Sequence[int | None], right: Sequence[int | None]) -> tuple[list[tuple[int, int, int]], int]:
    """Index, left and right time [ms] of each pair, and how many frames have no partner."""
    source = PairSource(Timed(left), Timed(right), tolerance_s=0.005)
    found: list[tuple[int, int, int]] = []
    while True:
        try:
            frame = source.read(0.0)
        except EndOfSource:
            return found, source.unpaired
        if frame is not None:
            assert isinstance(frame, StereoFrame)
            assert frame.t_ns == int(frame.left[0, 0]) * MS
            found.append((frame.index, int(frame.left[0, 0]), int(frame.right[0, 0])))


@pytest.mark.parametrize(
    ("left", "right", "expected", "unpaired"),
    [
        ([0, 20, 40], [0, 20, 40], [(0, 0, 0), (1, 20, 20), (2, 40, 40)], 0),
        ([0, 20, 40], [5, 15, 46], [(0, 0, 5), (1, 20, 15)], 2),  # the tolerance itself is within, 6 ms are not
        ([0, 40, 60], [0, 20, 40, 60], [(0, 0, 0), (1, 40, 40), (2, 60, 60)], 1),  # the left camera lost one
        ([0, 20, 40, 60], [0, 60], [(0, 0, 0), (3, 60, 60)], 2),
        ([0, 20, 40, 60, 80], [0, 20], [(0, 0, 0), (1, 20, 20)], 3),  # after the right one's end
        ([0, 20], [0, 20, 40, 60], [(0, 0, 0), (1, 20, 20)], 2),  # after the left one's end
        ([0, None, 20], [0, 20], [(0, 0, 0), (2, 20, 20)], 0),  # late, not lost
        ([0, 20], [0, None, 20], [(0, 0, 0), (1, 20, 20)], 0),
        ([0, 20, 40], [10, 30, 50], [], 6),  # cameras that take turns are no pair
    ],
)
def test_frames_pair_by_their_times(
    left: list[int | None], right: list[int | None], expected: list[tuple[int, int, int]], unpaired: int
) -> None:
    assert pairs(left, right) == (expected, unpaired)


def test_it_closes_both_and_knows_the_rate() -> None:
    left, right = Timed([0]), Timed([0])
    source = PairSource(left, right, 0.0)
    source.close()
    assert (left.closed, right.closed, source.rate_hz) == (True, True, 50.0)
    with pytest.raises(ValueError, match="tolerance_s"):
        PairSource(left, right, -1.0)


# --- live cameras ----------------------------------------------------------------------------------------------------

RATE_HZ = 10.0  # slow, so that a busy machine does not make a camera seem to be missing: that is after 250 ms
TOLERANCE_S = 0.025
WAIT_S = 20.0  # far beyond what any step takes; nothing waits for it when all is well


class Fed(FedCamera):
    """A camera whose frames have the driver's own time."""

    own_time = True

    def put(self, t_ms: int, image: np.ndarray | None = None) -> None:
        """A frame of this time; two of different times are never alike."""
        image = np.arange(64, dtype=np.uint8).reshape(8, 8) + np.uint8(t_ms % 250) if image is None else image
        self.inbox.put(Frame(t_ns=t_ms * MS, index=7, image=image))


class Rig:
    """A live pair, and the cameras that were opened for its left and its right eye."""

    def __init__(self) -> None:
        self.opened: tuple[list[Fed], list[Fed]] = ([], [])
        self.pair = LivePair((lambda: self.open(0), lambda: self.open(1)), TOLERANCE_S, RATE_HZ)

    def open(self, side: int) -> Fed:
        self.opened[side].append(Fed())
        return self.opened[side][-1]

    @property
    def left(self) -> Fed:
        return self.opened[0][-1]

    @property
    def right(self) -> Fed:
        return self.opened[1][-1]

    def read_pair(self) -> StereoFrame:
        frame = self.pair.read(WAIT_S)
        assert isinstance(frame, StereoFrame)
        return frame

    def start(self) -> None:
        """The first pair, at time 0."""
        self.left.put(0)
        self.right.put(0)
        self.read_pair()

    def read_alone(self, side: int) -> Frame:
        """The next frame of one camera, which is fed until the other one counts as missing."""
        for t_ms in itertools.count(100, 100):
            self.opened[side][-1].put(t_ms)
            frame = self.pair.read(1.0 / RATE_HZ)
            if frame is not None:
                assert isinstance(frame, Frame)
                assert frame.eye == side
                return frame
            assert t_ms < 1000.0 * WAIT_S
        raise AssertionError

    def pairs_again(self, t_ms: int) -> None:
        """Both cameras go on at a time; the first frame may still go alone, if its partner is behind it."""
        frame: Frame | StereoFrame | None = None
        while not isinstance(frame, StereoFrame):
            self.left.put(t_ms)
            self.right.put(t_ms)
            frame = self.pair.read(WAIT_S)
            assert frame is not None
            t_ms += 100


@pytest.fixture
def rig() -> Iterator[Rig]:
    made = Rig()
    yield made
    made.pair.close()
    for camera in (*made.opened[0], *made.opened[1]):
        assert camera.closed.is_set()


def eventually(true: Callable[[], bool]) -> None:
    until = time.monotonic() + WAIT_S
    while not true():
        assert time.monotonic() < until
        time.sleep(0.005)


def test_live_frames_pair_by_their_times_and_each_keeps_its_own(rig: Rig) -> None:
    for left_ms, right_ms in ((0, 10), (120, 100)):
        rig.left.put(left_ms)
        rig.right.put(right_ms)
        pair = rig.read_pair()
        assert (pair.t_ns, pair.right_late_ns) == (left_ms * MS, (right_ms - left_ms) * MS)
        assert (pair.left[0, 0], pair.right[0, 0]) == (left_ms % 250, right_ms % 250)
        assert pair.index == (left_ms > 0)
    assert rig.pair.read(0.0) is None  # none is delivered twice
    assert rig.pair.own_time
    rig.right.own_time = False
    assert rig.pair.own_time is False


def test_the_newest_live_pair_wins_and_what_has_no_partner_is_counted(rig: Rig) -> None:
    for t_ms in (0, 100, 150, 200):
        rig.left.put(t_ms)
    for t_ms in (0, 100, 210):
        rig.right.put(t_ms)
    eventually(lambda: rig.pair.pair_status.pairs == 3)
    pair = rig.read_pair()
    assert (pair.t_ns, pair.right_late_ns, pair.index) == (200 * MS, 10 * MS, 2)
    status = rig.pair.pair_status
    assert (status.unpaired, status.alone, status.repeated) == (1, 0, (0, 0))
    assert (status.apart_s, status.apart_max_s, status.missed_s) == (0.0, 0.01, 0.06)
    assert [eye.frames for eye in status.eyes] == [4, 3]
    assert str(status).endswith("3 pairs, 1 frames without a partner; images of a pair 0.0 ms apart, 10.0 at most")


@pytest.mark.parametrize("side", [0, 1])
def test_a_camera_that_is_gone_does_not_hold_up_the_other_one_and_comes_back(side: int) -> None:
    rig, name = Rig(), ("left", "right")[side]
    rig.start()
    rig.opened[side][-1].inbox.put(SourceError("/dev/video1: no more frames"))
    eventually(lambda: rig.pair.trouble != "")
    assert rig.pair.trouble == f"{name} camera: /dev/video1: no more frames"
    other = rig.opened[1 - side][-1]
    for index, t_ms in enumerate((100, 200, 300), 1):
        other.put(t_ms)
        frame = rig.pair.read(WAIT_S)
        assert isinstance(frame, Frame)
        assert (frame.eye, frame.t_ns, frame.index) == (1 - side, t_ms * MS, index)
    eventually(lambda: len(rig.opened[side]) == 2)  # it is opened again
    assert rig.pair.trouble != ""  # until it gives a frame
    rig.pairs_again(400)
    assert (rig.pair.trouble, rig.pair.pair_status.alone >= 3) == ("", True)
    assert rig.pair.pair_status.eyes[side].restarts == 1
    rig.pair.close()
    assert all(camera.closed.is_set() for camera in (*rig.opened[0], *rig.opened[1]))


@pytest.mark.parametrize("side", [0, 1])
def test_a_silent_camera_is_missing_after_a_while_and_pairs_come_again(side: int, rig: Rig) -> None:
    rig.start()
    since = time.monotonic()
    frame = rig.read_alone(1 - side)
    assert time.monotonic() - since > 2.0 / RATE_HZ
    assert rig.pair.trouble == f"{('left', 'right')[side]} camera: no frame comes"
    rig.pairs_again(frame.t_ns // MS + 100)
    assert rig.pair.trouble == ""


def test_a_camera_that_repeats_its_image_is_missing(rig: Rig) -> None:
    rig.start()
    still = np.arange(64, dtype=np.uint8).reshape(8, 8)
    for t_ms in itertools.count(100, 100):
        rig.left.put(t_ms)
        rig.right.put(t_ms, still)
        frame = rig.pair.read(1.0 / RATE_HZ)
        if t_ms > 100 and frame is not None:  # the first of them was new
            break
    assert isinstance(frame, Frame)
    assert frame.eye == 0
    assert rig.pair.trouble == "right camera: the same image again and again"
    assert rig.pair.pair_status.repeated[1] >= 2


def test_a_covered_lens_gives_pairs(rig: Rig) -> None:
    for t_ms in range(0, 800, 100):
        rig.left.put(t_ms)
        rig.right.put(t_ms, np.zeros((8, 8), np.uint8))
        assert rig.read_pair().t_ns == t_ms * MS


def test_both_silent_is_a_pause_and_neither_goes_alone(rig: Rig) -> None:
    rig.start()
    assert rig.pair.read(0.5) is None
    rig.right.put(600)
    assert rig.pair.read(0.05) is None
    assert rig.pair.trouble == ""
    rig.left.put(605)
    assert rig.read_pair().right_late_ns == -5 * MS


def test_cameras_that_take_turns_give_no_pair_and_the_reason(rig: Rig) -> None:
    for t_ms in range(0, 400, 100):
        rig.left.put(t_ms)
        rig.right.put(t_ms + 50)
        assert rig.pair.read(0.02) is None
    eventually(lambda: rig.pair.pair_status.unpaired == 7)
    assert rig.pair.pair_status.missed_s == 0.05
    assert rig.pair.trouble == (
        "both cameras give frames, but none within 25 ms of each other: trigger them together, or raise "
        "[camera.right] pair_tolerance_s"
    )
    rig.right.put(400)
    rig.left.put(400)
    assert rig.read_pair().t_ns == 400 * MS
    assert rig.pair.trouble == ""


def test_a_watch_says_why_there_are_no_pairs(rig: Rig) -> None:
    capture = CaptureThread(rig.pair, CameraWatch(RATE_HZ))
    rig.left.put(0)
    rig.right.put(0)
    assert capture.read(WAIT_S) is not None
    for t_ms in range(100, 500, 100):
        rig.left.put(t_ms)
        rig.right.put(t_ms + 50)
    eventually(lambda: capture.trouble != "")

    def wait() -> None:
        while capture.read(0.02) is None:
            pass

    with pytest.raises(SourceStalled, match=r"^no frame for 0\.\d+ s; both cameras give frames, but none within 25 ms"):
        wait()
    assert "frames without a partner" in str(capture.pair)
    capture.close()


def test_both_gone_is_an_error_and_both_at_their_end_is_the_end() -> None:
    for errors, expected in (
        ((SourceError("a"), SourceError("b")), (SourceError, "left camera: a; right camera: b")),
        ((SourceError("a"), EndOfSource()), (SourceError, "left camera: a; right camera: has ended")),
        ((EndOfSource(), EndOfSource()), (EndOfSource, "^$")),
        ((ValueError("Frame.image: expected uint8"), SourceError("b")), (SourceError, "left camera: Frame.image: .*")),
    ):
        rig = Rig()
        rig.left.inbox.put(errors[0])
        rig.right.inbox.put(errors[1])
        with pytest.raises(expected[0], match=expected[1]):
            rig.pair.read(WAIT_S)
        rig.pair.close()


def test_where_the_second_camera_cannot_be_opened_the_first_is_closed() -> None:
    left = Fed()

    def gone() -> Fed:
        raise SourceError("/dev/video1: cannot be opened")

    with pytest.raises(SourceError, match=r"^right camera: /dev/video1: cannot be opened$"):
        LivePair((lambda: left, gone), TOLERANCE_S, RATE_HZ)
    assert left.closed.is_set()
    with pytest.raises(SourceError, match=r"^left camera: /dev/video1"):
        LivePair((gone, lambda: left), TOLERANCE_S, RATE_HZ)
    with pytest.raises(ValueError, match="tolerance_s"):
        LivePair((lambda: left, lambda: left), -1.0, RATE_HZ)


def test_a_camera_that_gives_pairs_is_told_so(rig: Rig) -> None:
    image = np.zeros((2, 2), np.uint8)
    rig.left.inbox.put(StereoFrame(t_ns=0, index=0, left=image, right=image))  # type: ignore[arg-type]
    eventually(lambda: "gives pairs by itself; remove [camera.right] device" in rig.pair.trouble)


def test_what_has_no_partner_is_counted_through_the_capture_thread(rig: Rig) -> None:
    rig.start()
    rig.pair._pairing.unpaired = 4
    paired, single = CaptureThread(rig.pair), CaptureThread(Timed([]))
    assert (rig.pair.unpaired, rig.pair.pair_status.unpaired, paired.unpaired, single.unpaired) == (4, 4, 4, None)
    paired.close()
    single.close()


def test_a_source_of_pairs_is_frozen_where_both_images_are() -> None:
    rng = np.random.default_rng(1)
    images = rng.integers(0, 256, (60, 4, 4), dtype=np.uint8)
    for stuck, found in (((0,), False), ((1,), False), ((0, 1), True)):
        watch = CameraWatch(50.0)
        watch.opened(0)
        for index in range(30):
            left, right = (images[0 if eye in stuck else 1 + index] + np.uint8(eye) for eye in (0, 1))
            watch.arrived(StereoFrame(t_ns=index * 20 * MS, index=index, left=left, right=right), index * 20 * MS)
        fault = watch.fault(29 * 20 * MS)
        assert (fault is not None) is found
