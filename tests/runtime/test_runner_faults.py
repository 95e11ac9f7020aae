from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from automodel.runtime.runner import RunEnd
from automodel.runtime.safety import Action, SafetyMode
from automodel.signals import Frame, LaneStatus, MotionSource, StereoFrame
from tests.support.runner_car import (
    ARMING,
    DISARMED,
    DRIVING,
    HOLD,
    STOPPED,
    Car,
    assert_parked,
    frame_index,
    sent,
)
from tests.support.runner_devices import BrokenSource, FakeRecorder, ScriptedSource
from tests.support.runner_fakes import MS, frame, frames


def test_lost_for_a_moment_holds_and_drives_on_from_a_low_speed() -> None:
    car = Car(at=dict.fromkeys(range(60, 65), LaneStatus.LOST))
    result = car.run()
    assert car.modes() == [DISARMED, ARMING, DRIVING, HOLD, DRIVING]
    held = [r for r in car.watcher.records if r.decision.mode is HOLD and r.frame is not None]
    assert [frame_index(r) for r in held] == [60, 61, 62, 63, 64]
    assert {sent(r) for r in held} == {(0.2, 0.0)}
    assert car.limits.reset_to[-1] == held[-1].sent  # the steering rate is counted from what the wheels really do
    after = [sent(r)[1] for r in car.watcher.records if frame_index(r) in (65, 66)]
    assert after == pytest.approx([0.1, 0.2])
    assert result.stops == 0


def test_an_exception_of_the_chain_holds_at_once_and_is_told_after() -> None:
    car = Car(at={60: RuntimeError("boom\nand more")})
    result = car.run()
    assert car.modes() == [DISARMED, ARMING, DRIVING, HOLD, DRIVING]
    record = next(r for r in car.watcher.records if frame_index(r) == 60)
    assert (record.decision.action, sent(record)[1]) == (Action.HOLD_STEERING, 0.0)
    assert record.tick is not None
    assert record.tick.estimate.status is LaneStatus.LOST
    fault = next(e for e in car.recorder.of("event") if e.kind == "fault")
    assert fault.text.startswith("RuntimeError: boom and more at runner_fakes.py:")
    assert result.traceback is not None
    assert "in step" in result.traceback
    assert car.pipeline.resets == 0  # it still knows the lane
    assert car.limits.reset_to[-1] == record.sent
    assert len(car.recorder.of("frame")) == len(car.recorder.of("estimate")) == 120


def test_a_chain_that_always_fails_stops_and_is_told_once_a_second() -> None:
    car = Car(at=dict.fromkeys(range(60, 250), ValueError("no")), items=frames(250))
    car.run()
    assert car.pipeline.resets == 190 // 4
    assert car.modes() == [DISARMED, ARMING, DRIVING, HOLD, STOPPED]
    assert car.kinds().count("fault") == math.ceil(190 * 0.016)


def test_a_motion_stage_that_fails_is_part_of_the_chain(monkeypatch: pytest.MonkeyPatch) -> None:
    car = Car()
    monkeypatch.setattr(car.motion, "step", lambda state, command, t_ns: 1 / 0)
    car.run()
    assert car.modes() == [DISARMED]
    assert {m.source for m in car.recorder.of("motion")} == {MotionSource.NONE}


def test_a_chain_that_fails_on_a_motion_that_is_not_finite_records_none_of_it() -> None:
    car = Car(at={60: RuntimeError("boom")})
    car.motion.speed_mps = math.nan
    car.run()
    assert {m.source for m in car.recorder.of("motion")} == {MotionSource.NONE}


@pytest.mark.parametrize("where", ["estimate", "motion", "command", "state"])
def test_anything_not_finite_holds_at_once(where: str) -> None:
    car = Car()

    def spoil() -> None:
        if where == "motion":
            car.motion.speed_mps = math.nan
        elif where == "command":
            car.limits.override = replace(car.link.commands[-1], speed_mps=math.inf)
        elif where == "state":
            car.link.state_at = lambda state: replace(state, speed_mps=math.nan)

    car.at[60] = math.nan if where == "estimate" else spoil
    result = car.run()
    assert car.modes()[3] is HOLD
    first = next(r for r in car.watcher.records if r.decision.mode is HOLD)
    assert frame_index(first) == (60 if where in ("estimate", "command") else 61)
    assert "fault" in [event.kind for event in result.events]
    assert all(math.isfinite(c.speed_mps) and math.isfinite(c.steering_rad) for c in car.link.commands)
    assert all(math.isfinite(m.speed_mps) for m in car.recorder.of("motion"))
    assert all(math.isfinite(s.speed_mps) for s in car.recorder.of("state"))
    assert car.modes()[-1] is (DRIVING if where == "estimate" else STOPPED)


def test_a_pipeline_that_takes_300_ms_once_stops_the_car() -> None:
    car = Car()
    car.at[60] = lambda: car.clock.sleep(0.3)
    result = car.run()
    assert car.modes() == [DISARMED, ARMING, DRIVING, STOPPED]
    record = next(r for r in car.watcher.records if r.decision.mode is STOPPED)
    assert sent(record) == (0.2, 0.0)
    stop = next(e for e in car.recorder.of("event") if e.kind == "stop")
    assert stop.text == "the loop stood still for 0.316 s"  # 16 ms of waiting for the frame, too
    assert (result.stops, result.overruns) == (1, 1)


def test_a_slow_first_frame_only_puts_the_arming_off() -> None:
    car = Car()
    car.at[0] = lambda: car.clock.sleep(0.5)
    car.run()
    assert car.modes() == [DISARMED, ARMING, DRIVING]


@pytest.mark.parametrize("offset_ms", [-40.0, 80.0, 1e6, -1e6])
def test_a_frame_whose_time_is_wrong_is_not_looked_at(offset_ms: float) -> None:
    car = Car()
    t_ns, good = car.source._items[60]
    assert isinstance(good, Frame)
    bad = frame(good.t_ns / MS + offset_ms, 60)
    car.source._items[60] = (t_ns, bad)
    car.run()
    assert bad not in car.pipeline.seen
    assert bad not in car.recorder.of("frame")
    assert car.modes() == [DISARMED, ARMING, DRIVING, HOLD, DRIVING]
    held = [r.frame.index for r in car.watcher.records if r.decision.mode is HOLD and r.frame is not None]
    assert held == ([60] if offset_ms < 0 else [60, 61])  # the next good one is older than one from the future


def test_a_recorder_that_is_full_does_not_stop_the_car() -> None:
    car = Car()
    car.recorder = FakeRecorder(fails_after=300)
    result = car.run()
    assert car.modes() == [DISARMED, ARMING, DRIVING]
    failed = [event for event in result.events if event.kind == "recorder-failed"]
    assert [event.text for event in failed] == ["recording has ended: run.mcap: no space left on the device"]
    assert_parked(car)


@pytest.mark.parametrize("where", ["observer", "recorder", "stop", "controls"])
def test_an_unexpected_exception_parks_the_car_and_goes_up(where: str, monkeypatch: pytest.MonkeyPatch) -> None:
    car = Car()

    def fail(*_: object) -> None:
        if car.clock.now_ns() > 900 * MS:
            raise LookupError("a bug")

    if where == "observer":
        monkeypatch.setattr(car.watcher, "on_tick", fail)
    elif where == "recorder":
        monkeypatch.setattr(car.recorder, "estimate", fail)
    elif where == "controls":
        car.at[80] = LaneStatus.LOST
        monkeypatch.setattr(car.limits, "reset", fail)
    with pytest.raises(LookupError):
        car.run(stop=fail if where == "stop" else None)
    assert car.link.driven()
    assert_parked(car)
    assert car.recorder.of("event")[-1].text == "an error"


def test_everything_is_closed_even_when_closing_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    car = Car()

    def fail() -> None:
        car.recorder.closed += 1
        raise LookupError("a bug")

    monkeypatch.setattr(car.recorder, "close", fail)
    with pytest.raises(LookupError):
        car.run()
    assert_parked(car)


@pytest.mark.parametrize("error", [OSError("camera: gone"), ValueError("Frame.image: uint8 wanted, not uint16")])
def test_a_source_that_fails_stops_the_car_and_ends_the_run(error: Exception) -> None:
    car = Car(items=[*frames(60), *((1000 * MS, error) for _ in range(200))])
    result = car.run()
    assert result.end is RunEnd.SOURCE_FAILED
    assert car.modes() == [DISARMED, ARMING, DRIVING, HOLD, STOPPED]
    assert car.kinds() == ["arming", "driving", "source-failed", "hold", "stop", "end"]
    assert_parked(car)


def test_a_source_that_never_worked_ends_the_run_at_once() -> None:
    car = Car()
    car.source = BrokenSource()
    assert car.run().end is RunEnd.SOURCE_FAILED
    assert car.source.closed == 1


def test_a_source_is_opened_again_only_when_the_car_stands_and_it_stays_disarmed() -> None:
    tries: list[tuple[float, SafetyMode]] = []

    def reopen():
        tries.append((car.clock.now_ns() / MS, car.safety.mode))
        if len(tries) < 3:
            raise OSError("camera: still gone")
        start_ms = car.clock.now_ns() / MS
        return ScriptedSource(car.clock, frames(80, start_ms=start_ms))

    car = Car(items=[*frames(60), *((1000 * MS, OSError("camera: gone")) for _ in range(200))], reopen=reopen)
    result = car.run()
    assert result.end is RunEnd.SOURCE
    assert [mode for _, mode in tries] == [STOPPED] * 3
    assert all(b - a >= 200.0 for (a, _), (b, _) in itertools.pairwise(tries))
    assert car.modes() == [DISARMED, ARMING, DRIVING, HOLD, STOPPED]  # healthy for over a second, and still stopped
    assert "source-back" in car.kinds()


def test_a_dark_eye_of_a_pair_is_reported_with_its_reason_and_that_it_is_back() -> None:
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (240, 8, 8), dtype=np.uint8)
    items = []
    for due_ns, plain in frames(120):
        assert isinstance(plain, Frame)
        k = plain.index
        left = np.zeros((8, 8), np.uint8) if 50 <= k < 90 else images[2 * k]
        items.append((due_ns, StereoFrame(t_ns=plain.t_ns, index=k, left=left, right=images[2 * k + 1])))
    car = Car(items=items)
    car.pipeline.cameras = 2  # type: ignore[attr-defined]
    car.source.unpaired = 7  # type: ignore[attr-defined]
    assert car.run().unpaired == 7
    assert {record.unpaired for record in car.watcher.records} == {7}
    assert car.modes() == [DISARMED, ARMING, DRIVING]
    assert [(e.kind, e.text) for e in car.recorder.of("event") if e.kind.startswith("camera")] == [
        ("camera-missing", "left camera: the image is blank; the other one goes on alone"),
        ("camera-back", "pairs of frames come again"),
    ]
    alone = {frame.index for frame in car.pipeline.seen if isinstance(frame, Frame)}
    assert alone == set(range(50, 90))
    assert all(isinstance(frame, StereoFrame) for frame in car.recorder.of("frame"))  # recorded as it came
