from __future__ import annotations

import itertools
import math
from dataclasses import replace

import pytest

from automodel.runtime.clocks import VirtualClock
from automodel.runtime.supervised_link import SupervisedLink
from automodel.signals import NEUTRAL, Event, VehicleState
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
from tests.support.runner_devices import FakeLink
from tests.support.runner_fakes import MS, frames


def test_a_port_that_vanishes_stops_the_car_and_comes_back_disarmed() -> None:
    car = Car(items=frames(250))
    car.link.down_ms = (1000.0, 1700.0)
    result = car.run()
    assert car.modes() == [DISARMED, ARMING, DRIVING, STOPPED]
    assert car.kinds() == ["arming", "driving", "link-lost", "stop", "link-back", "end"]
    tries = [sent.t_ns / MS for sent in car.link.log if sent.what == "open?"][1:]
    assert 1000.0 + 200.0 <= tries[0] <= 1000.0 + 240.0
    assert all(200.0 <= b - a <= 220.0 for a, b in itertools.pairwise(tries))
    back_ns = next(sent.t_ns for sent in car.link.log[2:] if sent.what == "open")
    assert 1700 * MS <= back_ns <= 1920 * MS  # within 1 s, and every frame was looked at meanwhile
    assert len(car.pipeline.seen) == 250
    after = [sent for sent in car.link.log if sent.t_ns >= back_ns]
    assert not [sent for sent in after if sent.what == "arm"]
    assert all(sent.command.speed_mps == 0.0 for sent in after if sent.command is not None)
    assert result.stops == 1
    assert_parked(car)


def test_a_frame_that_comes_while_the_link_is_down_sends_nothing() -> None:
    car = Car(items=frames(150))
    car.link.down_ms = (1000.0, math.inf)
    result = car.run()
    down = [r for r in car.watcher.records if r.t_ns >= 1010 * MS]
    assert all(r.sent is None and r.latency_ns is None for r in down)
    assert len(down) > 50
    assert len(car.recorder.of("estimate")) == 150
    assert car.motion.given[-1] == (None, NEUTRAL)  # the vehicle has fallen back to neutral by itself
    assert car.recorder.closed == 1
    assert result.frames == 150


def test_a_send_that_fails_leaves_no_command_recorded() -> None:
    car = Car()
    with pytest.MonkeyPatch.context() as patch:

        def fail(command, now_ns):
            patch.undo()
            raise OSError("port: gone")

        car.at[60] = lambda: patch.setattr(car.link, "send", fail)
        car.run()
    record = next(r for r in car.watcher.records if frame_index(r) == 60)
    assert (record.decision.mode, record.sent, record.latency_ns) == (DRIVING, None, None)
    assert car.modes() == [DISARMED, ARMING, DRIVING, STOPPED]


def test_after_the_link_is_back_a_person_can_arm_again() -> None:
    car = Car(items=frames(250), arm_requested=lambda: car.clock.now_ns() // MS // 16 == 170)
    car.link.down_ms = (1000.0, 1500.0)
    car.run()
    assert car.modes() == [DISARMED, ARMING, DRIVING, STOPPED, ARMING, DRIVING]


@pytest.mark.parametrize(
    ("what", "text"),
    [
        ("restart_ms", "the vehicle's controller has restarted"),
        ("disarm_ms", "the vehicle has disarmed itself"),
        ("silent_ms", "the vehicle has said nothing for"),
    ],
)
def test_a_board_that_restarts_disarms_or_falls_silent_stops_the_car(what: str, text: str) -> None:
    car = Car(items=frames(150))
    setattr(car.link, what, 1000.0)
    car.run()
    assert car.modes() == [DISARMED, ARMING, DRIVING, STOPPED]
    stop = next(event for event in car.recorder.of("event") if event.kind == "stop")
    assert stop.text.startswith(text)
    assert stop.t_ns <= (1280 if what == "silent_ms" else 1020) * MS
    assert sent(next(r for r in car.watcher.records if r.decision.mode is STOPPED)) == (0.2, 0.0)


def test_a_loop_that_is_held_up_does_not_take_its_own_delay_for_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    """The board's last word was a turn old when the loop fell behind: it has said more since, to be heard first."""
    car = Car()
    car.at[60] = lambda: car.clock.sleep(0.083)
    poll = car.link.poll
    state: list[VehicleState | None] = []

    def poll_less(now_ns):
        if not state or not 944 * MS <= now_ns < 1000 * MS:
            state[:] = [poll(now_ns)]
        return state[0]

    monkeypatch.setattr(car.link, "poll", poll_less)
    car.run()
    held = next(r for r in car.watcher.records if frame_index(r) == 60)
    assert held.state is not None
    assert held.t_ns - held.state.t_ns > 100 * MS
    assert car.kinds() == ["arming", "driving", "hold", "driving", "end"]  # the frame was late, and nothing else


def test_a_board_that_does_not_obey_arming() -> None:
    car = Car(auto_arm=False, items=frames(200), arm_requested=lambda: car.clock.now_ns() == 800 * MS)
    car.link.obeys_arm = False
    car.run()
    assert car.modes() == [DISARMED, ARMING, DISARMED]
    assert len([sent for sent in car.link.log if sent.what == "arm"]) == 9  # about every 100 ms, for a second
    assert not car.link.driven()


def test_new_faults_of_the_vehicle_are_told_once_and_stop_nothing() -> None:
    car = Car()
    car.link.state_at = lambda state: (
        replace(state, faults=("frame errors", "rx overflow")) if state.t_ns > 900 * MS else state
    )
    car.run()
    assert car.modes() == [DISARMED, ARMING, DRIVING]
    told = [event.text for event in car.recorder.of("event") if event.kind == "vehicle-fault"]
    assert told == ["the vehicle reports frame errors, rx overflow"]


def test_no_such_port_goes_up_and_everything_is_closed() -> None:
    car = Car()
    car.link.down_ms = (0.0, math.inf)
    with pytest.raises(OSError, match="ttyUSB0 is gone"):
        car.run()
    assert (car.recorder.closed, car.source.closed) == (1, 1)
    assert not car.pipeline.seen


def test_a_vehicle_that_never_says_a_right_hello_goes_up() -> None:
    car = Car(hello_ms=500.0)
    car.link.down_ms = (100.0, math.inf)  # as when the board speaks another message table
    with pytest.raises(OSError, match="ttyUSB0 is gone"):
        car.run()
    assert not [sent for sent in car.link.log if sent.what == "send"]
    assert car.recorder.closed == 1


def test_a_port_that_vanishes_in_hold_stops_too() -> None:
    car = Car(items=frames(100), silent_for_ms=500.0)
    car.link.down_ms = (1700.0, math.inf)
    car.run()
    assert car.modes() == [DISARMED, ARMING, DRIVING, HOLD, STOPPED]
    stop = next(event for event in car.recorder.of("event") if event.kind == "stop")
    assert stop.text == "the link to the vehicle is down"


def test_a_link_that_is_down_asks_for_nothing() -> None:
    events: list[Event] = []
    link = FakeLink(VirtualClock())
    supervised = SupervisedLink(link, events.append)
    assert supervised.wake_ns is None
    supervised.open(0)
    supervised.poll(0)
    link.wake_ns = 7 * MS
    assert supervised.wake_ns == 7 * MS
    link.down_ms = (0.0, math.inf)
    supervised.poll(MS)
    assert supervised.wake_ns is None


def test_the_supervised_link_alone() -> None:
    clock = VirtualClock()
    events: list[Event] = []
    inner = FakeLink(clock, hello_ms=50.0)
    link = SupervisedLink(inner, events.append)
    link.open(0)
    assert (link.up, link.ready, link.poll(0)) == (True, False, None)
    assert not link.send(NEUTRAL, 0)  # not before the hello
    clock.advance_to(50 * MS)
    assert link.poll(50 * MS) is not None
    assert link.send(NEUTRAL, 50 * MS)
    inner.down_ms = (60.0, 300.0)
    clock.advance_to(60 * MS)
    assert not link.arm(60 * MS)
    assert not link.up
    for t_ms in range(61, 400):
        clock.advance_to(t_ms * MS)
        link.poll(t_ms * MS)
    assert not link.up  # tried at 260 ms, in vain
    clock.advance_to(460 * MS)
    assert link.poll(460 * MS) is None
    assert (link.up, link.ready) == (True, False)
    clock.advance_to(510 * MS)
    assert link.poll(510 * MS) is not None
    assert [event.kind for event in events] == ["link-lost", "link-back"]
    link.close()
    assert not link.send(NEUTRAL, 511 * MS)
