"""`ArduinoLink` against the emulated board in virtual time: times, faults on the way, what the car says."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import pytest

from automodel.bench.faults.hooks import time_stuck
from automodel.config import VehicleConfig
from automodel.signals import NEUTRAL, BoardSensors
from firmware_link import messages
from firmware_link.arduino import LATCHED_FAULTS, ArduinoLink, BatteryMeter
from firmware_link.emulator.logic import BoardOptions
from firmware_link.errors import HandshakeError, PortLost
from firmware_link.transport import MemoryTransport

MS = 1_000_000
STRAIGHT = (1520.0, 1500.0)
ROLLING = (1310.0, 1500.0)  # neutral, and the steering of the last command as long as the car rolls


def test_closed_link_does_nothing(make_rig: Callable[..., Any]) -> None:
    rig = make_rig()
    for call in (
        lambda: rig.link.send(NEUTRAL, 0),
        lambda: rig.link.arm(0),
        lambda: rig.link.disarm(0),
        lambda: rig.link.poll(0),
    ):
        with pytest.raises(PortLost, match="not open"):
            call()
    rig.link.close()


def test_no_hello_is_a_handshake_error(make_rig: Callable[..., Any]) -> None:
    rig = make_rig(BoardOptions(boot_ns=3600 * 1000 * MS))
    rig.link.open()
    with pytest.raises(HandshakeError, match="no Hello"):
        rig.ready()


def test_command_timer_runs_out_between_95_and_105_ms(virtual: Any) -> None:
    for phase_ms in range(0, 20, 3):
        virtual.drive(0.2, 1.0, (1310.0, 1600.0))
        virtual.wait(phase_ms * MS)
        virtual.link.send(virtual.command(0.2, 1.0), virtual.now_ns())
        sent_ns = virtual.now_ns()
        while virtual.board.armed:
            virtual.wait(MS // 4)
            virtual.link.poll(virtual.now_ns())
        assert 95 * MS <= virtual.now_ns() - sent_ns <= 105 * MS
        virtual.wait(20 * MS)
        virtual.link.poll(virtual.now_ns())
        t_ns, *_ = next(p for p in virtual.peripherals.pulses if p[0] > sent_ns + 90 * MS and p[1:] == ROLLING)
        assert 95 * MS <= t_ns - sent_ns <= 125 * MS  # at the pin
        virtual.wait(100 * MS)


def test_command_reaches_the_pins_within_a_servo_frame_and_5_ms(virtual: Any) -> None:
    virtual.drive(0.2, 1.0, (1310.0, 1600.0))
    for number in range(40):
        virtual.wait(7 * MS)
        steering_rad = 0.1 + 0.002 * number
        want = virtual.link._servo.pulse_us(steering_rad)
        start_ns = virtual.now_ns()
        while virtual.peripherals.at_pins[0] != want:
            virtual.link.poll(virtual.now_ns())
            virtual.link.send(virtual.command(steering_rad, 1.0), virtual.now_ns())
            virtual.wait(5 * MS)
            virtual.link.poll(virtual.now_ns())
        at_pin_ns = next(t for t, servo_us, _ in virtual.peripherals.pulses if servo_us == want)
        assert at_pin_ns - start_ns <= 25 * MS


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_not_finite_goes_out_as_neutral(virtual: Any, bad: float) -> None:
    virtual.drive(0.2, 1.0, (1310.0, 1600.0))
    for steering_rad, speed_mps in ((bad, 1.0), (0.2, bad)):
        virtual.link.send(virtual.command(steering_rad, speed_mps), virtual.now_ns())
        virtual.wait(25 * MS)
        virtual.link.poll(virtual.now_ns())
        assert virtual.peripherals.at_pins == ROLLING
        virtual.drive(0.2, 1.0, (1310.0, 1600.0))


def test_commands_beyond_the_tables_are_clamped(virtual: Any) -> None:
    virtual.drive(9.0, 99.0, (1100.0, 1800.0))
    virtual.drive(-9.0, -99.0, (1900.0, 1200.0))


@pytest.mark.parametrize(("delay_ms", "armed"), [(20, True), (60, True), (110, False), (500, False)])
def test_commands_held_up_on_the_way_are_not_fresh(virtual: Any, delay_ms: int, armed: bool) -> None:
    virtual.drive(0.2, 1.0, (1310.0, 1600.0))
    held: list[tuple[int, bytes]] = []
    pass_on = virtual.cable.write
    virtual.cable.write = lambda data: held.append((virtual.now_ns() + delay_ms * MS, data))
    seen: set[str] = set()
    state = None
    for _ in range(90):
        virtual.link.send(virtual.command(0.2, 1.0), virtual.now_ns())
        virtual.wait(10 * MS)
        while held and held[0][0] <= virtual.now_ns():
            pass_on(held.pop(0)[1])
        state = virtual.link.poll(virtual.now_ns())
        assert state is not None
        seen |= set(state.faults)
    assert state is not None
    if delay_ms <= 60:
        assert virtual.board.armed
        assert not seen
    else:
        assert not virtual.board.armed
        assert "command_timeout" in seen


def test_repeated_frames_feed_nothing(virtual: Any) -> None:
    virtual.drive(0.2, 1.0, (1310.0, 1600.0))
    frame = messages.encode(
        messages.Command(servo_us=1310.0, motor_us=1600.0, deadline_ms=0, flags=0), virtual.link._counter
    )
    virtual.cable.write(frame)  # the counter of the last command, again
    virtual.wait(22 * MS)
    state = virtual.link.poll(virtual.now_ns())
    assert state is not None
    assert state.faults == ("command_repeated",)


def test_arm_frame_of_another_arming_is_worth_nothing(virtual: Any) -> None:
    written: list[bytes] = []
    pass_on = virtual.cable.write

    def write(data: bytes) -> None:
        written.append(data)
        pass_on(data)

    virtual.cable.write = write
    virtual.drive(0.2, 1.0, (1310.0, 1600.0))
    virtual.link.disarm(virtual.now_ns())
    virtual.until(lambda s: s is not None and not s.armed)
    virtual.wait(50 * MS)
    for data in written:  # all that armed it and drove it, once more
        pass_on(data)
        virtual.wait(2 * MS)
        virtual.link.poll(virtual.now_ns())
    assert not virtual.board.armed
    assert virtual.peripherals.at_pins == ROLLING


def test_lost_frames_of_the_handshake_are_sent_again(make_rig: Callable[..., Any]) -> None:
    rig = make_rig()
    pass_on = rig.cable.write
    count = 0

    def write(data: bytes) -> None:
        nonlocal count
        count += 1
        if count % 3 == 1:
            data = data[:3] + bytes((data[3] ^ 0x55,)) + data[4:]
        pass_on(data)

    rig.cable.write = write
    rig.link.open()
    rig.ready()
    rig.link.arm(rig.now_ns())
    assert rig.until(lambda s: s is not None and s.armed)
    rig.link.disarm(rig.now_ns())
    rig.until(lambda _: not rig.board.armed)
    assert count > 4


def test_board_without_reset_line_is_disarmed_by_the_next_host(virtual: Any) -> None:
    """A host that dies leaves the board armed for 100 ms; the next one must not inherit that, nor its counter."""
    virtual.drive(0.2, 1.0, (1310.0, 1600.0))
    virtual.board.reset = lambda now_ns: None
    other = ArduinoLink(MemoryTransport(virtual.board, virtual), virtual.config, VehicleConfig())
    virtual.link = other
    other.open()
    assert virtual.board.armed
    virtual.ready()
    assert not virtual.board.armed
    virtual.drive(-0.25, -1.0, (1710.0, 1400.0))


def test_silent_board_counts_as_disarmed(virtual: Any) -> None:
    virtual.drive(0.2, 1.0, (1310.0, 1600.0))
    read = virtual.cable.read
    virtual.cable.read = lambda: read() and b""
    state = virtual.until(lambda s: s is not None and not s.armed, (0.2, 1.0), 300 * MS)
    assert state is not None
    assert state.faults == ("link_silent",)
    assert state.t_ns < virtual.now_ns() - 150 * MS
    virtual.cable.read = read
    virtual.until(lambda _: not virtual.board.armed, (0.2, 1.0))
    virtual.drive(0.2, 1.0, (1310.0, 1600.0))
    assert "link_silent" in LATCHED_FAULTS


def test_restart_is_noticed_even_when_the_hello_is_lost(virtual: Any) -> None:
    virtual.drive(0.2, 1.0, (1310.0, 1600.0))
    read = virtual.cable.read
    virtual.board.brown_out(virtual.now_ns())
    state = virtual.link.poll(virtual.now_ns())
    while virtual.board._state.value == "boot":
        virtual.wait()
        virtual.link.poll(virtual.now_ns())
    virtual.wait(5 * MS)
    read()  # thrown away: the hello, and the first status
    state = virtual.until(lambda s: s is not None and "board_restarted" in s.faults, limit_ns=60 * MS)
    assert state is not None
    assert not state.armed
    virtual.until(lambda s: s is not None and s.boot_id == virtual.board.boot_id, limit_ns=60 * MS)


@pytest.mark.parametrize("speed_mps", [2.0, 0.3, -1.0, 0.0])
def test_speed_is_that_of_the_ticks_over_board_time(virtual: Any, speed_mps: float) -> None:
    start_ns = virtual.now_ns()

    def read_sensors(t_ns: int) -> BoardSensors:
        ticks = int(speed_mps * (t_ns - start_ns) * 1e-9 * 200.0 // 1)
        return dataclasses.replace(virtual.peripherals.sensors, wheel_ticks=ticks)

    virtual.peripherals.read_sensors = read_sensors
    speeds = []
    for number in range(120):
        virtual.wait((5 + number % 37) * MS)  # the host's own rhythm has no part in it
        state = virtual.link.poll(virtual.now_ns())
        assert state is not None
        if number > 10:
            assert state.speed_mps is not None
            speeds.append(state.speed_mps)
    one_tick_mps = 1 / 200.0 / 0.06
    assert max(abs(s - speed_mps) for s in speeds) <= one_tick_mps + 1e-9
    assert sum(speeds) / len(speeds) == pytest.approx(speed_mps, abs=0.1 * one_tick_mps)


def test_stale_command_is_neutral_at_once_while_still_armed(virtual: Any) -> None:
    virtual.drive(0.2, 1.0, (1310.0, 1600.0))
    command = virtual.command(0.2, 1.0)
    virtual.link.send(dataclasses.replace(command, valid_until_ns=virtual.now_ns()), virtual.now_ns())  # just in time
    virtual.wait(MS)
    virtual.link.send(dataclasses.replace(command, valid_until_ns=virtual.now_ns() - 1), virtual.now_ns())
    virtual.wait(23 * MS)
    state = virtual.link.poll(virtual.now_ns())
    assert state.armed
    assert virtual.peripherals.at_pins == ROLLING


def written(rig: Any) -> list[Any]:
    """The messages that are written from now on; filled as they are."""
    decoder, pass_on = messages.decoder(on_board=True), rig.cable.write
    seen: list[Any] = []

    def write(data: bytes) -> None:
        seen.extend(map(messages.decode, decoder.feed(data)))
        pass_on(data)

    rig.cable.write = write
    return seen


def test_no_deadline_is_further_ahead_than_the_board_s_timer_takes(virtual: Any) -> None:
    virtual.drive(0.2, 1.0, (1310.0, 1600.0))
    seen = written(virtual)
    late = dataclasses.replace(virtual.command(0.2, 1.0), valid_until_ns=virtual.now_ns() + 3_000 * MS)
    virtual.link.send(late, virtual.now_ns())
    board_ms = (virtual.now_ns() - virtual.board._start_ns) // MS
    assert 95 <= (seen[0].deadline_ms - board_ms) & 0xFFFF <= 100


def test_another_board_that_was_started_later_is_a_restart(virtual: Any) -> None:
    """Its time is ahead, as after a restart in a long silence: only the Hello tells."""
    virtual.drive(0.2, 1.0, (1310.0, 1600.0))
    hello = dataclasses.replace(virtual.link.hello, boot_id=virtual.link.hello.boot_id + 1)
    read = virtual.cable.read
    virtual.cable.read = lambda: read() + messages.encode(hello, 0)
    state = virtual.link.poll(virtual.now_ns())
    assert (state.armed, state.faults) == (False, ("board_restarted",))


def test_a_board_without_limits_whose_hello_looks_right_is_sent_them(virtual: Any) -> None:
    seen = written(virtual)
    read = virtual.cable.read
    status = messages.Status(time_us=1 << 30, servo_us=0.0, motor_us=0.0, faults=0, nonce=1, command_counter=0, flags=2)
    virtual.cable.read = lambda: read() + messages.encode(status, 0)
    assert virtual.link.poll(virtual.now_ns()) is None
    virtual.wait(100 * MS)
    virtual.link.poll(virtual.now_ns())
    assert any(isinstance(message, messages.Limits) for message in seen)


def test_a_board_whose_time_stands_still_is_silent(virtual: Any) -> None:
    virtual.drive(0.2, 1.0, (1310.0, 1600.0))
    stuck, read, stuck_ns = time_stuck(), virtual.cable.read, virtual.now_ns()
    virtual.cable.read = lambda: b"".join(data for _, data in stuck(read(), virtual.now_ns()))
    state = virtual.until(lambda s: "link_silent" in s.faults, (0.2, 1.0), 500 * MS)
    assert not state.armed
    assert state.t_ns - stuck_ns < 40 * MS  # the safety machine has found it too old since


def test_closing_disarms_at_once(virtual: Any) -> None:
    virtual.drive(0.2, 1.0, (1310.0, 1600.0))
    seen = written(virtual)
    virtual.link.close()
    assert seen == [messages.Disarm()]


def test_commands_are_neutral_after_disarm_even_when_the_disarm_is_lost(virtual: Any) -> None:
    virtual.drive(0.2, 1.0, (1310.0, 1600.0))
    pass_on = virtual.cable.write
    virtual.cable.write = lambda data: pass_on(data) if data[2] == 0x01 else None  # only commands come through
    virtual.link.disarm(virtual.now_ns())
    for _ in range(3):
        virtual.link.send(virtual.command(0.2, 1.0), virtual.now_ns())
        virtual.wait(10 * MS)
        assert not virtual.link.poll(virtual.now_ns()).armed
    assert virtual.board.armed
    assert virtual.peripherals.at_pins == ROLLING
    virtual.cable.write = pass_on
    virtual.wait(10 * MS)
    virtual.link.send(virtual.command(0.2, 1.0), virtual.now_ns())
    virtual.until(lambda _: not virtual.board.armed, limit_ns=70 * MS)


def test_arming_asked_for_before_a_restart_does_not_arm_after_it(make_rig: Callable[..., Any]) -> None:
    rig = make_rig(BoardOptions(boot_ns=20 * MS))
    rig.link.open()
    rig.ready()
    rig.link.arm(rig.now_ns())
    rig.board.brown_out(rig.now_ns())
    for _ in range(40):
        state = rig.link.poll(rig.now_ns())
        rig.link.send(rig.command(0.2, 1.0), rig.now_ns())
        rig.wait(10 * MS)
        assert not rig.board.armed
    assert state.faults == ("board_restarted",)


def low(*spans: tuple[float, int], low_v: float = 6.4) -> list[bool]:
    """Whether the battery is low each 20 ms; spans are (voltage, milliseconds)."""
    meter, said, t_ms = BatteryMeter(low_v), [], 0
    for voltage, duration_ms in spans:
        for _ in range(0, duration_ms, 20):
            said.append(meter.step(voltage, t_ms * MS))
            t_ms += 20
    return said


def test_a_battery_is_low_after_a_second() -> None:
    said = low((7.4, 500), (6.3, 2000))
    assert said.index(True) == (500 + 1000) // 20
    assert all(said[75:])


def test_a_dip_is_not_low_and_a_recovery_not_full() -> None:
    assert not any(low((7.4, 500), (5.0, 980), (7.4, 20), (5.0, 980)))
    said = low((6.0, 2000), (7.4, 980), (6.0, 100))
    assert all(said[50:])


def test_it_is_well_again_after_a_second() -> None:
    assert low((6.0, 1200), (7.4, 1200))[-1] is False


def test_a_board_without_a_battery_input_and_a_car_that_does_not_care() -> None:
    assert not any(low((0.1, 3000)))
    assert not any(low((3.0, 3000), low_v=0.0))


def test_the_voltage_is_the_last_one() -> None:
    meter = BatteryMeter(6.4)
    assert meter.voltage_v is None
    meter.step(7.1, 0)
    assert meter.voltage_v == 7.1
    meter.reset()
    assert (meter.voltage_v, meter.low) == (None, False)
