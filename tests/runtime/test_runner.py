from __future__ import annotations

import gc
import itertools
import signal
from dataclasses import replace

import pytest

from automodel.runtime.loop import Loop
from automodel.runtime.runner import RunConfig, RunEnd, Runner, RunParts
from automodel.signals import VehicleState
from tests.support.runner_car import ARMING, DISARMED, DRIVING, HOLD, STOPPED, Car, assert_parked, sent
from tests.support.runner_fakes import MS, frames


def test_arms_drives_and_parks() -> None:
    car = Car()
    result = car.run()
    assert car.modes() == [DISARMED, ARMING, DRIVING]
    assert (result.end, result.frames, result.stops, result.skipped, result.overruns) == (RunEnd.SOURCE, 120, 0, 0, 0)
    assert car.kinds() == ["arming", "driving", "end"]
    driven = car.link.driven()
    # The first frame comes at 16 ms; 500 ms after it is the 33rd, the car is armed in the turn after that.
    assert len(driven) == 120 - 33
    assert len(car.link.commands) == 120 + 1
    assert [c.speed_mps for c in driven[:3]] == pytest.approx([0.1, 0.2, 0.3])  # the ramp did not run while disarmed
    assert all(c.valid_until_ns == c.t_ns - 2 * MS + 100 * MS for c in driven)
    assert_parked(car)


def test_latency_is_from_capture_until_the_command_is_out() -> None:
    car = Car()
    car.at.update({i: lambda: car.clock.sleep(0.003) for i in range(100)})
    car.at.update({i: lambda: car.clock.sleep(0.015) for i in range(100, 120)})
    result = car.run()
    assert len(result.latencies) == len(car.link.driven())
    assert result.latency_ms(50) == pytest.approx(2.0 + 3.0)
    assert result.latency_ms(100) == pytest.approx(2.0 + 15.0)
    assert result.overruns == 0


def test_a_signal_that_comes_while_everything_is_closed_is_told() -> None:
    """The run is over, but whoever called it must not go on with the next one."""
    assert not Car().run().interrupted
    car = Car()
    close = car.recorder.close

    def closing() -> None:
        close()
        signal.raise_signal(signal.SIGINT)

    car.recorder.close = closing  # type: ignore[method-assign]
    result = car.run()
    assert (result.end, result.interrupted) == (RunEnd.SOURCE, True)


def test_without_driving_there_is_no_latency() -> None:
    assert Car(auto_arm=False).run().latency_ms(50) is None


def test_stays_disarmed_without_a_person() -> None:
    car = Car(auto_arm=False)
    car.run()
    assert car.modes() == [DISARMED]
    assert not car.link.driven()
    assert not [sent for sent in car.link.log if sent.what == "arm"]


def test_arms_by_key_and_refuses_too_early_a_key() -> None:
    car = Car(auto_arm=False, arm_requested=lambda: car.clock.now_ns() // MS in (160, 800))
    car.run()
    assert car.modes() == [DISARMED, ARMING, DRIVING]
    assert car.kinds() == ["arm-refused", "arming", "driving", "end"]


@pytest.mark.parametrize(("side", "which"), [(1, "left"), (-1, "right")])
def test_a_lane_change_is_an_event(side: int, which: str) -> None:
    car = Car()
    step = car.pipeline.step
    car.pipeline.step = lambda frame, motion: replace(  # type: ignore[method-assign]
        step(frame, motion), lane_change=side * (frame.index == 60)
    )
    result = car.run()
    told = [event.text for event in result.events if event.kind == "lane-change"]
    assert told == [f"the lane on the {which} is the lane now"]


def test_a_camera_that_is_not_as_configured_is_an_event() -> None:
    car = Car()
    step = car.pipeline.step
    car.pipeline.step = lambda frame, motion: replace(  # type: ignore[method-assign]
        step(frame, motion), camera_pitch_rad=-0.0262 * (frame.index >= 60)
    )
    told = [event.text for event in car.run().events if event.kind == "camera-pitch"]
    assert told == ["by the lane's lines the camera's pitch_rad is -0.026 off car.toml's"]


def test_a_person_at_a_distance_stops_the_car() -> None:
    car = Car(stop_requested=lambda: "STOP" if car.clock.now_ns() // MS == 1600 else None)
    result = car.run()
    assert result.stops == 1
    assert [event.text for event in car.recorder.of("event") if event.kind == "stop"] == ["STOP"]
    assert car.modes() == [DISARMED, ARMING, DRIVING, STOPPED]


def test_what_the_pipeline_saw_is_recorded_in_its_order() -> None:
    car = Car()
    car.run()
    for_frame = [kind for kind, _ in car.recorder.entries if kind != "event"]
    assert for_frame == ["state", "frame", "motion", "estimate", "command"] * 120
    assert car.recorder.of("frame") == car.pipeline.seen
    assert car.recorder.of("motion") == car.pipeline.motions
    assert car.recorder.of("command") == car.link.commands[:-1]  # the parting neutral comes after the last turn


def test_the_motion_stage_gets_what_is_on_the_wire() -> None:
    car = Car()
    car.run()
    given = [command for _, command in car.motion.given[1:]]
    assert given == car.link.commands[:119]


def test_hello_after_two_seconds() -> None:
    car = Car(hello_ms=2000.0, items=frames(250))
    car.run()
    assert car.modes() == [DISARMED, ARMING, DRIVING]
    assert [sent.what for sent in car.link.log[:3]] == ["open?", "open", "send"]
    assert car.link.log[2].t_ns >= 2000 * MS  # nothing is sent before the hello
    assert next(sent.t_ns for sent in car.link.log if sent.what == "arm") >= 2500 * MS
    assert car.watcher.records[0].decision.reason == "the vehicle has not said hello"


def test_no_frame_in_time_holds_then_stops_and_rolls_out() -> None:
    car = Car(silent_for_ms=600.0)
    car.run()
    assert car.modes() == [DISARMED, ARMING, DRIVING, HOLD, STOPPED]
    captured_ns = car.items[-1][1].t_ns
    after = [r for r in car.watcher.records if r.t_ns > car.items[-1][0]]
    held = [r for r in after if r.decision.mode is HOLD]
    assert held[0].t_ns == captured_ns + 60 * MS  # not a slice later
    assert {sent(r) for r in held} == {(0.2, 0.0)}
    stopped = next(r for r in after if r.decision.mode is STOPPED)
    assert captured_ns + 360 * MS <= stopped.t_ns <= captured_ns + 380 * MS
    assert sent(stopped) == (0.2, 0.0)
    at_stop = next(i for i, sent in enumerate(car.link.log) if sent.what == "disarm")
    assert car.link.log[at_stop - 1].command == stopped.sent  # neutral went out before the disarm


def test_nothing_is_sent_between_frames_while_driving() -> None:
    car = Car(items=frames(40, period_ms=50.0))
    car.run()
    idle = [r for r in car.watcher.records if r.frame is None and r.decision.mode is DRIVING]
    assert len(idle) > 20
    assert all(r.sent is None and r.latency_ns is None for r in idle)
    assert len(car.link.commands) == sum(r.sent is not None for r in car.watcher.records) + 1


def test_waits_are_short_so_that_signals_are_answered() -> None:
    car = Car(items=frames(40, period_ms=50.0), silent_for_ms=500.0)
    car.run()
    assert min(car.source.waits_s) >= 0.001
    assert max(car.source.waits_s) <= 0.020


def test_a_link_is_polled_when_it_asks_for_it() -> None:
    """It asks for 7 ms after each poll; frames come every 16 ms."""
    car, polls_ns = Car(), []
    poll = car.link.poll

    def polling(now_ns: int) -> VehicleState | None:
        polls_ns.append(now_ns)
        car.link.wake_ns = now_ns + 7 * MS
        return poll(now_ns)

    car.link.poll = polling  # type: ignore[method-assign]
    car.run()
    assert max(b - a for a, b in itertools.pairwise(polls_ns)) == 7 * MS


def test_a_link_whose_time_has_passed_does_not_stop_the_clock() -> None:
    car = Car()
    car.link.wake_ns = 0
    car.run()
    assert min(car.source.waits_s) == max(car.source.waits_s) == 0.001


def test_without_a_recorder() -> None:
    car = Car(recorded=False)
    assert car.run().frames == 120


def test_skipped_frames_and_overruns_are_counted() -> None:
    items = frames(120)
    del items[50:53], items[80]
    car = Car(items=items)
    car.at[100] = lambda: car.clock.sleep(0.02)
    result = car.run()
    assert (result.frames, result.skipped, result.overruns) == (116, 4, 1)


def test_max_frames_and_stop_end_the_run() -> None:
    car = Car()
    assert (car.run(max_frames=7).end, len(car.pipeline.seen)) == (RunEnd.FRAMES, 7)
    assert_parked(car)
    car = Car()
    result = car.run(stop=lambda: car.clock.now_ns() > 900 * MS)
    assert result.end is RunEnd.STOP
    assert car.link.driven()
    assert_parked(car)


def test_the_collector_is_back_after_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    car = Car()
    states: list[bool] = []
    monkeypatch.setattr(car.watcher, "on_tick", lambda record: states.append(gc.isenabled()))
    parts = RunParts(
        source=car.source,
        link=car.link,
        recorder=car.recorder,
        motion=car.motion,
        loop=Loop(car.pipeline, car.controller, car.limits, validity_s=0.1),
        safety=car.safety,
        clock=car.clock,
    )
    Runner(parts, RunConfig(collector_off=True), observer=car.watcher).run()
    assert not any(states)
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0


def test_config_refuses_times_of_nothing() -> None:
    with pytest.raises(ValueError, match="period_s"):
        RunConfig(period_s=0.0)
