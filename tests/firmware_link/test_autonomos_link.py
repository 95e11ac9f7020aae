"""`AutonomosLink` against the emulated boards in virtual time: what is written, when it stops, what it cannot do."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import pytest

from automodel.signals import NEUTRAL, BoardSensors
from firmware_link.errors import HandshakeError, PortLost

MS = 1_000_000
LEFT = (0.2, 1.0)


def tapped(rig: Any) -> list[list[bytes]]:
    """What is written from now on, one list a port."""
    cables = [rig.cable] if not hasattr(rig, "motor_cable") else [rig.cable, rig.motor_cable]
    written: list[list[bytes]] = [[] for _ in cables]
    for cable, log in zip(cables, written, strict=True):

        def write(data: bytes, log: list[bytes] = log, on: Callable[[bytes], None] = cable.write) -> None:
            on(data)
            log.append(data)

        cable.write = write
    return written


def polled(rig: Any, ms: int, step_ms: int = 5, drive: tuple[float, float] | None = None) -> list[Any]:
    """The states of so long."""
    states = []
    for _ in range(ms // step_ms):
        rig.wait(step_ms * MS)
        states.append(rig.link.poll(rig.now_ns()))
        if drive is not None:
            rig.link.send(rig.command(*drive), rig.now_ns())
    return states


def test_the_words_are_those_of_the_cars(autonomos: Any) -> None:
    written = tapped(autonomos)
    autonomos.link.arm(autonomos.now_ns())
    autonomos.link.send(autonomos.command(*LEFT), autonomos.now_ns())
    autonomos.link.close()
    if len(written) == 1:
        assert written == [[b"SenLdiLM0\r", b"S74LdiLM-250\r", b"S112LdiLM0\r", b"SdiLdiLM0\r"]]
    else:
        assert written[0] == [b"en\r", b"74\r", b"112\r", b"di\r"]
        assert [text for text in written[1] if text != b"gn\r\n"] == [
            b"v0\r\nen\r\n", b"v-250\r\n", b"v0\r\n", b"v0\r\ndi\r\n",
        ]  # fmt: skip


def test_a_fresh_command_is_said_again_and_so_is_en(autonomos: Any) -> None:
    autonomos.drive(*LEFT, autonomos.driven[0])
    written = tapped(autonomos)
    lasting = dataclasses.replace(autonomos.command(*LEFT), valid_until_ns=autonomos.now_ns() + 10_000 * MS)
    times: dict[bytes, list[int]] = {}
    for turn in range(100):
        if turn % 16 == 0:  # the host's own timer is to be fed
            autonomos.link.send(lasting, autonomos.now_ns())
        autonomos.wait(5 * MS)
        autonomos.link.poll(autonomos.now_ns())
        for text in written[0]:
            times.setdefault(text, []).append(autonomos.now_ns())
        written[0].clear()
    drive, enable = sorted(times, key=lambda text: b"en" in text)
    assert (b"74" in drive, b"en" in enable) == (True, True)
    for text, most_ms in ((drive, 50), (enable, 100)):
        gaps = [b - a for a, b in zip(times[text], times[text][1:], strict=False)]
        assert len(gaps) >= 4
        assert max(gaps) <= most_ms * MS


@pytest.mark.parametrize("phase_ms", range(0, 20, 4))
def test_the_host_times_out_as_the_board_cannot(autonomos: Any, phase_ms: int) -> None:
    """Its polls come every 5 ms here: 100 ms, up to 5 ms more, a line's time, a motor that obeys at once."""
    autonomos.drive(*LEFT, autonomos.driven[0])
    autonomos.wait(phase_ms * MS)
    autonomos.link.send(autonomos.command(*LEFT), autonomos.now_ns())
    sent_ns = autonomos.now_ns()
    states = polled(autonomos, 200)
    assert states[-1].faults == ("command_timeout",)
    stopped_ns = next(t for t, _, motor_us in autonomos.peripherals.pulses if t > sent_ns and motor_us == 1500.0)
    assert 100 * MS <= stopped_ns - sent_ns <= 110 * MS
    polled(autonomos, 1000, drive=LEFT)  # commands alone do not bring it back
    assert autonomos.at_rest()


def test_disarming_straightens_before_the_servo_goes_off(autonomos: Any) -> None:
    autonomos.drive(*LEFT, autonomos.driven[0])
    autonomos.link.disarm(autonomos.now_ns())
    begin_ns = autonomos.now_ns()
    polled(autonomos, 1000)
    after = [(t - begin_ns, servo_us) for t, servo_us, _ in autonomos.peripherals.pulses if t > begin_ns + 25 * MS]
    straight = [t for t, servo_us in after if servo_us == 1522.0]
    assert straight[0] < 30 * MS
    assert 300 * MS < straight[-1] < 420 * MS
    assert after[-1][1] == 0.0
    written = tapped(autonomos)
    polled(autonomos, 1000)
    words = [text for text in written[0] if text]
    assert len(words) == 10  # di again, in case it was lost
    assert {b"di" in text.replace(b"Ldi", b"") for text in words} == {True}


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_not_finite_goes_out_as_neutral(autonomos: Any, bad: float) -> None:
    autonomos.drive(*LEFT, autonomos.driven[0])
    for steering_rad, speed_mps in ((bad, 1.0), (0.2, bad)):
        autonomos.link.send(autonomos.command(steering_rad, speed_mps), autonomos.now_ns())
        polled(autonomos, 25)
        assert autonomos.at_rest()
        autonomos.drive(*LEFT, autonomos.driven[0])


def test_orders_beyond_the_car_are_clamped(make_autonomos: Callable[[], Any]) -> None:
    rig = make_autonomos()
    rig.drive(9.0, 99.0, (1100.0, 1900.0))
    rig.drive(-9.0, -99.0, (1900.0, 1100.0))


def test_a_closed_link_does_nothing(autonomos: Any) -> None:
    autonomos.link.close()
    link = autonomos.link
    for call in (lambda: link.send(NEUTRAL, 0), lambda: link.arm(0), lambda: link.disarm(0), lambda: link.poll(0)):
        with pytest.raises(PortLost, match="not open"):
            call()


def test_a_car_that_says_nothing_is_a_handshake_error(make_autonomos: Callable[[], Any]) -> None:
    rig = make_autonomos()
    rig.board.hang(rig.now_ns())
    rig.link.close()
    rig.board.reset = lambda now_ns: None
    rig.link.open()
    with pytest.raises(HandshakeError, match="the car sends nothing; check ports"):
        rig.ready()


def test_one_port_that_fails_stops_the_other_board(make_autonomos_of_2015: Callable[[], Any]) -> None:
    for lost in ("cable", "motor_cable"):
        rig = make_autonomos_of_2015()
        rig.drive(*LEFT, rig.driven[0])
        getattr(rig, lost).unplug()
        with pytest.raises(PortLost):
            polled(rig, 100, drive=LEFT)
        rig.board.advance(rig.now_ns() + 30 * MS)
        servo_us, motor_us = rig.peripherals.at_pins
        if lost == "cable":
            assert motor_us == 1500.0
        else:
            assert servo_us == 0.0
            assert motor_us == 1600.0  # nobody can tell it: it drives on


def test_a_host_that_is_killed_leaves_the_car_driving_until_another_one_comes(autonomos: Any) -> None:
    autonomos.drive(*LEFT, autonomos.driven[0])
    for _ in range(100):
        autonomos.wait(100 * MS)
        autonomos.board.advance(autonomos.now_ns())
    assert autonomos.peripherals.at_pins == autonomos.driven[0]
    autonomos.link = autonomos.make_link()
    autonomos.link.open()
    polled(autonomos, 50)
    assert autonomos.peripherals.at_pins[1] == 1500.0


def test_a_board_that_hangs_is_silent_and_drives_on(make_autonomos: Callable[[], Any]) -> None:
    rig = make_autonomos()
    rig.drive(*LEFT, rig.driven[0])
    rig.board.hang(rig.now_ns())
    states = polled(rig, 1000, drive=LEFT)
    first = next(index for index, state in enumerate(states) if not state.armed)
    assert 195 <= 5 * first <= 225
    assert states[-1].faults == ("link_silent",)
    assert rig.peripherals.at_pins == rig.driven[0]


@pytest.mark.parametrize("speed_mps", [2.0, 0.3, -1.0, 0.0])
def test_speed_is_that_of_the_ticks_with_the_ordered_sign(make_autonomos: Callable[[], Any], speed_mps: float) -> None:
    rig = make_autonomos()
    start_ns = rig.now_ns()

    def read_sensors(t_ns: int) -> BoardSensors:
        ticks = 1_000_000 + int(speed_mps * (t_ns - start_ns) * 1e-9 * 200.0 // 1)
        return dataclasses.replace(rig.peripherals.sensors, wheel_ticks=ticks)

    rig.peripherals.read_sensors = read_sensors
    rig.board._encoder = 32_700  # it wraps soon
    rig.link.arm(rig.now_ns())
    speeds = []
    for number in range(200):
        rig.link.send(rig.command(0.0, speed_mps), rig.now_ns())
        rig.wait((5 + number % 23) * MS)  # the host's own rhythm has no part in it
        state = rig.link.poll(rig.now_ns())
        if number > 60:
            speeds.append(state.speed_mps)
    one_tick_mps = 1 / 200.0 / 0.05
    assert max(abs(s - speed_mps) for s in speeds) <= one_tick_mps + 0.05 * abs(speed_mps)
    assert sum(speeds) / len(speeds) == pytest.approx(speed_mps, abs=0.1 * one_tick_mps)


def test_speed_of_2015_is_the_motor_controllers(make_autonomos_of_2015: Callable[[], Any]) -> None:
    rig = make_autonomos_of_2015()
    rig.drive(0.0, 1.5, (1522.0, 1650.0))
    assert polled(rig, 100, drive=(0.0, 1.5))[-1].speed_mps == pytest.approx(1.5)


def test_damaged_lines_are_counted_and_say_nothing(make_autonomos: Callable[[], Any]) -> None:
    rig = make_autonomos()
    read = rig.cable.read
    rig.cable.read = lambda: read() + b"y0.00s0e12x\n\xff\xfe\ny0.00s\n"
    polled(rig, 5)
    assert rig.link.errors.total == 3
    rig.cable.read = read
    assert polled(rig, 100)[-1].faults == ()


@pytest.mark.parametrize("part_ms", [0.3, 0.6, 0.9, 1.2, 5.0])
def test_a_restart_is_seen_though_it_cuts_a_line_short(make_autonomos: Callable[[], Any], part_ms: float) -> None:
    """A line takes 0.9 ms on the wire, and comes each 10 ms; what is left of it stands before the next one."""
    rig = make_autonomos()
    rig.drive(*LEFT, rig.driven[0])
    rig.link.poll(rig.now_ns())
    rig.t_ns = rig.board._report_due_ns + round(part_ms * MS)
    rig.link.poll(rig.now_ns())
    rig.board.brown_out(rig.now_ns())
    state = rig.until(lambda s: s is not None and "board_restarted" in s.faults, LEFT)
    assert not state.armed
