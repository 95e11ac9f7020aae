from __future__ import annotations

import contextlib
import threading
import time

import numpy as np
import pytest

from automodel.signals import Frame, StereoFrame
from automodel.sources.cameras import CameraWatch, CaptureThread, captured_ns, flipped
from automodel.sources.errors import EndOfSource, SourceError, SourceStalled
from tests.support.fed_cameras import FedCamera

WAIT_S = 20.0  # far beyond what any step takes; nothing waits for it when all is well


def frame(index: int) -> Frame:
    return Frame(t_ns=index, index=index, image=np.zeros((2, 2), np.uint8))


def wait_until_end(capture: CaptureThread, source: FedCamera) -> None:
    assert source.closed.wait(WAIT_S)


def test_the_newest_frame_is_delivered_once_and_older_ones_count_as_drops() -> None:
    source = FedCamera()
    for index in range(5):
        source.inbox.put(frame(index))
    source.inbox.put(EndOfSource())  # so that all five have gone through the thread
    capture = CaptureThread(source)
    wait_until_end(capture, source)
    newest = capture.read(WAIT_S)
    assert newest is not None
    assert newest.index == 4
    assert capture.drops == 4
    with pytest.raises(EndOfSource):
        capture.read(WAIT_S)


def test_every_frame_arrives_when_the_reader_is_fast() -> None:
    source = FedCamera()
    capture = CaptureThread(source)
    for index in range(20):
        source.inbox.put(frame(index))
        got = capture.read(WAIT_S)
        assert got is not None
        assert got.index == index
    assert capture.drops == 0
    capture.close()


def test_no_frame_is_delivered_twice() -> None:
    source = FedCamera()
    capture = CaptureThread(source)
    source.inbox.put(frame(0))
    assert capture.read(WAIT_S) is not None
    assert capture.read(0.0) is None
    assert capture.read(0.01) is None
    capture.close()


def test_an_error_is_passed_on_after_the_last_frame_and_stays() -> None:
    source = FedCamera()
    source.inbox.put(frame(0))
    source.inbox.put(SourceError("/dev/video0: unplugged"))
    capture = CaptureThread(source)
    wait_until_end(capture, source)
    assert capture.read(WAIT_S) is not None
    for _ in range(2):
        with pytest.raises(SourceError, match="unplugged"):
            capture.read(WAIT_S)


def test_a_waiting_reader_is_woken_by_an_error() -> None:
    source = FedCamera()
    capture = CaptureThread(source)
    threading.Timer(0.05, source.inbox.put, (OSError("gone"),)).start()
    with pytest.raises(OSError, match="gone"):
        capture.read(WAIT_S)


def test_closing_closes_the_source_in_its_own_thread_and_may_be_repeated() -> None:
    source = FedCamera()
    capture = CaptureThread(source)
    capture.close()
    capture.close()
    assert source.closed.is_set()
    assert source.closed_by == "capture"
    with pytest.raises(EndOfSource):
        capture.read(0.0)


def test_a_bug_in_a_source_is_not_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threading, "excepthook", lambda args: None)
    source = FedCamera()
    source.inbox.put(KeyError("bug"))
    capture = CaptureThread(source)
    with pytest.raises(SourceError, match="died"):
        capture.read(WAIT_S)
    capture.close()


def test_what_the_watch_finds_costs_no_frame() -> None:
    source = FedCamera()
    capture = CaptureThread(source, CameraWatch(60.0))
    for index in range(3):  # 0.1 s apart: a slow camera, of which the frames are right
        source.inbox.put(Frame(t_ns=index * 100_000_000, index=index, image=TEXTURE + np.uint8(index)))
    source.inbox.put(EndOfSource())
    wait_until_end(capture, source)
    with pytest.raises(SourceStalled, match="less than half of its 60 frames/s"):
        capture.read(WAIT_S)
    with contextlib.suppress(SourceStalled):  # of a machine that is busy
        newest = capture.read(WAIT_S)
        assert newest is not None
        assert newest.index == 2
    with pytest.raises((EndOfSource, SourceStalled)):
        capture.read(WAIT_S)


@pytest.mark.parametrize(
    ("own_ns", "want_ns"),
    [
        (4_990e6, 4_990_000_000),  # 10 ms ago on the same clock
        (4_990_000_000, 4_990_000_000),
        (5_000.5e6, 4_960_000_000),  # in the future: another clock
        (1_000e6, 4_960_000_000),  # 4 s ago: another clock
        (0.0, 4_960_000_000),
        (-1e6, 4_960_000_000),
        (float("nan"), 4_960_000_000),
        (None, 4_960_000_000),
    ],
)
def test_the_cameras_time_counts_where_it_can_be_right(own_ns: float | None, want_ns: int) -> None:
    assert captured_ns(own_ns, 5_000_000_000, 0.04) == want_ns


def test_flips_of_an_image_with_a_corner() -> None:
    image = np.zeros((2, 3), np.uint8)
    image[0, 0] = 9
    corners = {"none": (0, 0), "rotate-180": (1, 2), "horizontal": (0, 2), "vertical": (1, 0)}
    for flip, corner in corners.items():
        turned = flipped(image, flip)
        assert (turned.shape, turned[corner], turned.sum()) == ((2, 3), 9, 9)


# --- the watch: times are given, nothing waits ----------------------------------------------------------------------

PERIOD_NS = 16_666_667
TEXTURE = np.arange(64 * 64, dtype=np.uint8).reshape(64, 64)


def watched(watch: CameraWatch, count: int, period_ns: int = PERIOD_NS, start_ns: int = 0, same: bool = False) -> int:
    """Frames of a camera, one a period; the time of the last one."""
    t_ns = start_ns
    for index in range(count):
        image = TEXTURE if same else TEXTURE + np.uint8(t_ns // 1_000_000 % 250)
        t_ns = start_ns + (index + 1) * period_ns
        watch.arrived(Frame(t_ns=t_ns, index=index, image=image), t_ns)
        if not same:
            assert watch.fault(t_ns) is None
    return t_ns


def first_fault_s(watch: CameraWatch, since_ns: int) -> tuple[float, str]:
    """How long after `since_ns` a loop that looks every 20 ms is told, and what."""
    for step in range(1, 1000):
        fault = watch.fault(since_ns + step * 20_000_000)
        if fault is not None:
            assert not fault.lasting
            return step * 0.02, str(fault)
    raise AssertionError("no fault")


def test_a_dead_camera_is_noticed_within_100_ms() -> None:
    watch = CameraWatch(60.0)
    watch.opened(0)
    last_ns = watched(watch, 100)
    after_s, fault = first_fault_s(watch, last_ns)
    assert after_s <= 0.1
    assert fault.startswith("no frame for 0.")
    watched(watch, 100, start_ns=last_ns + 500_000_000)  # it comes back by itself
    assert watch.status.restarts == 0
    assert watch.status.lost == 30


def test_a_stall_is_lasting_after_a_second() -> None:
    watch = CameraWatch(60.0)
    watch.opened(0)
    last_ns = watched(watch, 10)
    lasting = {}
    for after_s in (0.5, 0.99, 1.0, 3.0):
        fault = watch.fault(last_ns + round(after_s * 1e9))
        assert fault is not None
        lasting[after_s] = fault.lasting
    assert lasting == {0.5: False, 0.99: False, 1.0: True, 3.0: True}


def test_a_frozen_camera_is_noticed_within_100_ms_though_frames_come() -> None:
    watch = CameraWatch(60.0)
    watch.opened(0)
    watched(watch, 10)
    frozen_ns = watched(watch, 1, start_ns=10 * PERIOD_NS, same=True)
    for step in range(1, 7):
        now_ns = frozen_ns + step * PERIOD_NS
        watch.arrived(Frame(t_ns=now_ns, index=step, image=TEXTURE), now_ns)
        fault = watch.fault(now_ns)
        assert (fault is not None) == (step * PERIOD_NS >= 80_000_000)
    assert now_ns - frozen_ns <= 100_000_000 + 2
    assert fault is not None
    assert "the same frame" in str(fault)
    watched(watch, 3, start_ns=now_ns)


def test_a_covered_lens_is_not_a_frozen_camera() -> None:
    watch = CameraWatch(60.0)
    watch.opened(0)
    for step in range(1, 60):
        t_ns = step * PERIOD_NS
        watch.arrived(StereoFrame(t_ns=t_ns, index=step, left=TEXTURE * 0, right=TEXTURE), t_ns)
        assert watch.fault(t_ns) is None


@pytest.mark.parametrize("rate_hz", [20.0, 30.0, 60.0, 120.0])
def test_a_slow_camera_is_told_once_until_it_was_well(rate_hz: float) -> None:
    watch = CameraWatch(rate_hz)
    period_ns, slow_ns = round(1e9 / rate_hz), round(2.3e9 / rate_hz)
    watch.opened(0)
    last_ns = watched(watch, 50, period_ns)

    def until_told(count: int, now_ns: int) -> tuple[int, SourceStalled | None]:
        for index in range(count):
            now_ns += slow_ns
            watch.arrived(Frame(t_ns=now_ns, index=index, image=TEXTURE + np.uint8(index)), now_ns)
            fault = watch.fault(now_ns)
            if fault is not None:
                return now_ns, fault
        return now_ns, None

    now_ns, fault = until_told(99, last_ns)
    assert fault is not None
    assert fault.lasting  # opened anew, once
    assert f"less than half of its {rate_hz:g} frames/s" in str(fault)
    assert now_ns - last_ns <= max(100_000_000, 2 * slow_ns)
    now_ns, fault = until_told(30, now_ns)
    assert fault is None
    watch.opened(now_ns + 500_000_000)
    now_ns, fault = until_told(30, now_ns + 600_000_000)
    assert fault is None  # nor is one opened again that is slow as before
    now_ns = watched(watch, 3, period_ns, now_ns)
    assert until_told(9, now_ns)[1] is not None


def test_what_comes_before_the_car_would_hold_is_no_fault() -> None:
    watch = CameraWatch(60.0, timeout_s=0.5)
    watch.opened(0)
    last_ns = watched(watch, 100, 240_000_000)  # a quarter of a second is far less than half the rate
    assert watch.fault(last_ns + 490_000_000) is None
    fault = watch.fault(last_ns + 500_000_000)
    assert fault is not None
    assert str(fault) == "no frame for 0.50 s"


def test_a_single_lost_frame_is_no_fault_and_is_counted() -> None:
    watch = CameraWatch(60.0)
    watch.opened(0)
    last_ns = watched(watch, 60)
    watched(watch, 60, start_ns=last_ns + PERIOD_NS)
    watch.dropped()
    status = watch.status
    assert (status.frames, status.dropped, status.lost, status.restarts) == (120, 1, 1, 0)
    assert status.rate_hz == pytest.approx(60.0 * 119 / 120, rel=1e-6)
    assert str(status) == "59.5 frames/s, 120 frames, 1 dropped, 1 lost"


def test_a_camera_that_never_starts() -> None:
    watch = CameraWatch(60.0)
    watch.opened(7_000_000_000)
    assert watch.fault(11_900_000_000) is None
    fault = watch.fault(12_000_000_000)
    assert fault is not None
    assert (str(fault), fault.lasting) == ("no first frame within 5 s", True)
    watch.opened(13_000_000_000)
    assert watch.fault(17_000_000_000) is None
    assert str(watch.status) == "no rate, 0 frames, 0 dropped, 0 lost, opened again 1 times"


def test_the_thread_raises_what_the_watch_finds_and_goes_on() -> None:
    source = FedCamera()
    capture = CaptureThread(source, CameraWatch(60.0))
    now_ns = time.monotonic_ns()
    source.inbox.put(Frame(t_ns=now_ns, index=0, image=TEXTURE))
    assert capture.read(WAIT_S) is not None

    def wait() -> None:
        while capture.read(0.02) is None:
            pass

    with pytest.raises(SourceStalled, match="no frame for"):
        wait()
    source.inbox.put(Frame(t_ns=now_ns + 1, index=1, image=TEXTURE + np.uint8(1)))
    again = None
    while again is None:
        with contextlib.suppress(SourceStalled):  # of a machine that is busy
            again = capture.read(WAIT_S)
    assert again.index == 1
    capture.close()
