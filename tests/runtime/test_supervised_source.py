from __future__ import annotations

import itertools

import numpy as np
import pytest

from automodel.runtime.clocks import NS_PER_S, VirtualClock
from automodel.runtime.run_log import RunLog
from automodel.runtime.supervised_source import START_S, SupervisedSource
from automodel.signals import Frame, StereoFrame
from automodel.sources.errors import SourceError, SourceStalled


class Broken:
    def read(self, timeout_s: float) -> Frame | None:
        raise SourceError("unplugged")

    def close(self) -> None:
        pass


class Starting:
    """A camera that has not given its first frame yet."""

    def __init__(self, clock: VirtualClock) -> None:
        self.clock = clock

    def read(self, timeout_s: float) -> Frame | None:
        self.clock.sleep(timeout_s)
        return None

    def close(self) -> None:
        pass


def test_a_camera_opened_again_has_its_time_to_start() -> None:
    clock = VirtualClock()
    opened: list[float] = []

    def reopen() -> Starting:
        opened.append(clock.now_ns() * 1e-9)
        return Starting(clock)

    source = SupervisedSource(Broken(), clock, RunLog(None, None), reopen)
    start_s = clock.now_ns() * 1e-9
    while clock.now_ns() * 1e-9 - start_s < 2.2 * START_S:
        assert source.read(0.02, at_rest=True) is None
    assert len(opened) == 3
    assert all(b - a >= START_S for a, b in itertools.pairwise(opened))


class Stalling:
    """A camera without frames from a time on, as a watch tells it; and with frames again from another one on."""

    def __init__(self, clock: VirtualClock, back_ns: int | None) -> None:
        self.clock, self.back_ns = clock, back_ns

    def read(self, timeout_s: float) -> Frame | None:
        self.clock.sleep(timeout_s)
        now_ns = self.clock.now_ns()
        if self.back_ns is not None and now_ns >= self.back_ns:
            return Frame(t_ns=now_ns, index=1, image=np.zeros((2, 2), np.uint8))
        raise SourceStalled("no frame for some time", lasting=now_ns >= NS_PER_S)

    def close(self) -> None:
        pass


@pytest.mark.parametrize("back_s", [0.5, None])
def test_a_stall_is_reported_at_once_and_the_camera_opened_again_where_it_lasts(back_s: float | None) -> None:
    clock = VirtualClock()
    log = RunLog(None, None)
    opened: list[int] = []

    def reopen() -> Stalling:
        opened.append(clock.now_ns())
        return Stalling(clock, 0)

    back_ns = None if back_s is None else round(back_s * NS_PER_S)
    source = SupervisedSource(Stalling(clock, back_ns), clock, log, reopen)
    frames = 0
    for _ in range(100):
        frames += source.read(0.02, at_rest=True) is not None
    assert frames > 10
    assert (len(opened) == 1 and opened[0] >= NS_PER_S) if back_s is None else opened == []
    assert [event.kind for event in log.events][:1] == ["source-failed"]
    assert log.events[0].t_ns <= 0.02 * NS_PER_S
    assert [event.text for event in log.events][-1] == "frames come again; arm to drive on"


def test_what_a_camera_died_of_is_told_though_a_stall_was_told_just_before() -> None:
    clock, log = VirtualClock(), RunLog(None, None)

    class Dying(Starting):
        def read(self, timeout_s: float) -> Frame | None:
            stalled = clock.now_ns() < 0.5 * NS_PER_S
            raise SourceStalled("no frame for 0.1 s", lasting=False) if stalled else SourceError("unplugged")

    source = SupervisedSource(Dying(clock), clock, log, None)
    for _ in range(40):
        assert source.read(0.02, at_rest=True) is None
    assert [event.text for event in log.events] == ["no frame for 0.1 s", "unplugged"]


class PairOfCameras:
    """A pair that gives what it is told to give: pairs, or frames of one camera for a reason."""

    trouble = ""

    def read(self, timeout_s: float) -> Frame | StereoFrame:
        image = np.zeros((2, 2), np.uint8)
        if self.trouble:
            return Frame(t_ns=1, index=1, image=image)
        return StereoFrame(t_ns=1, index=1, left=image, right=image)

    def close(self) -> None:
        pass


def test_a_camera_of_a_pair_that_is_missing_is_reported_once_with_the_reason_and_that_it_is_back() -> None:
    clock, log, pair = VirtualClock(), RunLog(None, None), PairOfCameras()
    source = SupervisedSource(pair, clock, log, None)

    def seen(trouble: str, unseen: str = "") -> None:
        pair.trouble = trouble
        for _ in range(5):
            frame = source.read(0.02, at_rest=False)
            assert frame is not None
            source.report_eyes(frame, unseen)
        clock.sleep(0.1)

    for trouble in ("", "right camera: no frame comes", ""):
        seen(trouble)
    assert [(event.kind, event.text) for event in log.events] == [
        ("camera-missing", "right camera: no frame comes; the other one goes on alone"),
        ("camera-back", "pairs of frames come again"),
    ]
    assert not source.dead
    seen("left camera: no frame comes")  # too soon after the last report of its kind: it is told later
    assert len(log.events) == 2
    clock.sleep(1.0)
    seen("left camera: no frame comes")
    assert log.events[-1].text == "left camera: no frame comes; the other one goes on alone"
    clock.sleep(1.0)
    seen("", "right camera: the image is blank")  # of a pair that came
    assert log.events[-1].text == "right camera: the image is blank; the other one goes on alone"
    seen("")
    kinds = [event.kind for event in log.events]
    assert kinds[2:] == ["camera-missing", "camera-missing", "camera-back"]


def test_frames_without_a_partner_are_counted_over_all_sources() -> None:
    class Pair(PairOfCameras):
        unpaired = 3
        gone = False

        def read(self, timeout_s: float) -> Frame | StereoFrame:
            if self.gone:
                raise SourceError("gone")
            return super().read(timeout_s)

    clock, first, second = VirtualClock(), Pair(), Pair()
    source = SupervisedSource(first, clock, RunLog(None, None), lambda: second)
    source.read(0.02, at_rest=True)
    first.unpaired = 5
    assert source.unpaired == 5
    first.gone = True
    source.read(0.02, at_rest=True)
    clock.sleep(1.0)
    source.read(0.02, at_rest=True)
    assert source.unpaired == 8
    single = SupervisedSource(Stalling(clock, 0), clock, RunLog(None, None), None)
    assert single.unpaired is None


def test_a_stall_while_the_car_drives_opens_nothing() -> None:
    clock = VirtualClock()

    def reopen() -> Stalling:
        raise AssertionError("opening a camera takes seconds")

    log = RunLog(None, None)
    source = SupervisedSource(Stalling(clock, 3 * NS_PER_S), clock, log, reopen)
    while source.read(0.02, at_rest=False) is None:
        assert not source.dead
    assert log.events[-1].text == "frames come again"
