"""The contract of a `VehicleLink`: over memory in virtual time, over a pty in real time, with the firmware.

The AutoNOMOS cars run it too, as far as they can keep it.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from automodel.signals import BoardSensors
from firmware_link import messages
from firmware_link.emulator.logic import BoardOptions
from firmware_link.errors import HandshakeError, PortLost, PortNotFound

MS = 1_000_000
LEFT, RIGHT = (0.2, 1.0), (-0.25, -1.0)


def test_hello_comes_first_and_nothing_is_sent_before(rig: Any) -> None:
    rig.link.open()
    assert rig.link.poll(rig.now_ns()) is None
    rig.link.arm(rig.now_ns())
    rig.link.disarm(rig.now_ns())
    rig.link.send(rig.command(0.1, 1.0), rig.now_ns())
    state = rig.until(lambda s: s is not None, (0.1, 1.0))
    assert state is not None
    assert not state.armed
    assert state.boot_id == rig.board.boot_id if rig.tells_boot_id else state.boot_id is not None
    assert state.battery_v is None or state.battery_v == pytest.approx(7.4, abs=0.05)
    assert rig.board.counters.rx_in_boot == 0
    assert rig.link.errors.total == 0
    rig.until(lambda _: rig.at_rest())  # the board has taken the car's own limits over


def test_commands_move_nothing_until_armed(rig: Any) -> None:
    rig.link.open()
    rig.ready()
    for _ in range(12):
        rig.link.send(rig.command(*LEFT), rig.now_ns())
        rig.link.poll(rig.now_ns())
        rig.wait()
    assert all(rig.at_rest(pulses[1:]) for pulses in list(rig.peripherals.pulses)[-10:])


def test_drives_once_armed(rig: Any) -> None:
    rig.link.open()
    rig.ready()
    rig.drive(*LEFT, rig.driven[0])
    state = rig.driving(LEFT, lambda s: s.armed and s.steering_rad == pytest.approx(0.2, abs=0.003))
    assert state.faults == ()
    rig.drive(*RIGHT, rig.driven[1])


def test_sensors_are_told(rig: Any) -> None:
    if not rig.has_sensors:
        pytest.skip("this car has no such sensors, or does not tell")
    rig.peripherals.sensors = BoardSensors(
        ranges_m=(0.5, None, 1.25), wheel_ticks=7, battery_v=8.1, yaw_rate_radps=-0.3
    )
    rig.link.open()
    rig.ready()
    state = rig.driving(LEFT, lambda s: s.armed and s.ranges_m[0] and s.ranges_m[2])
    assert state.battery_v == pytest.approx(8.1, abs=0.05)  # a step of the board's converter is 12 mV
    assert state.faults == ()
    assert state.ranges_m == (pytest.approx(0.5, abs=2e-3), None, pytest.approx(1.25, abs=2e-3))
    assert state.yaw_rate_radps == pytest.approx(-0.3, abs=3e-4)


def test_disarm_stops_for_good(rig: Any) -> None:
    rig.link.open()
    rig.ready()
    rig.drive(*LEFT, rig.driven[0])
    rig.link.disarm(rig.now_ns())
    rig.until(lambda _: rig.at_rest(), LEFT)
    state = rig.until(lambda s: s is not None and not s.armed, LEFT)
    assert state is not None
    assert rig.realtime or state.faults == ()
    assert rig.at_rest()
    rig.drive(*RIGHT, rig.driven[1])  # and goes on when armed again


def test_silence_of_the_host_stops_and_disarms(rig: Any) -> None:
    rig.link.open()
    rig.ready()
    rig.drive(*LEFT, rig.driven[0])
    state = rig.until(lambda s: s is not None and not s.armed)
    assert state is not None
    assert state.faults == ("command_timeout",)
    rig.until(lambda _: rig.at_rest())
    for _ in range(12):  # commands alone do not bring it back
        rig.link.send(rig.command(*LEFT), rig.now_ns())
        rig.wait()
        state = rig.link.poll(rig.now_ns())
    assert state is not None
    assert not state.armed
    assert state.faults == ("command_timeout",)
    rig.driving(LEFT, lambda s: s.armed and s.faults == ())


def test_stale_commands_are_neutral_and_feed_nothing(rig: Any) -> None:
    rig.link.open()
    rig.ready()
    rig.drive(*LEFT, rig.driven[0])
    stale = dataclasses.replace(rig.command(*LEFT), valid_until_ns=rig.now_ns() - 1)
    end_ns = rig.now_ns() + 2_000 * MS
    state = rig.link.poll(rig.now_ns())
    while rig.now_ns() < end_ns and state is not None and state.armed:
        rig.link.send(stale, rig.now_ns())
        rig.wait()
        state = rig.link.poll(rig.now_ns())
    assert state is not None
    assert not state.armed
    assert "command_timeout" in state.faults
    rig.until(lambda _: rig.at_rest())


def test_board_that_restarts_is_disarmed_until_armed_again(rig: Any) -> None:
    if not rig.tells_restart:
        pytest.skip("this car does not say that it has restarted")
    rig.link.open()
    first = rig.ready()
    rig.drive(*LEFT, rig.driven[0])
    rig.do(lambda: rig.board.brown_out(rig.now_ns()))
    rig.until(lambda _: rig.at_rest(), LEFT)
    state = rig.until(lambda s: s is not None and "board_restarted" in s.faults, LEFT)
    assert state is not None
    assert not state.armed
    assert state.boot_id != first.boot_id
    for _ in range(12):
        rig.link.send(rig.command(*LEFT), rig.now_ns())
        rig.wait()
        state = rig.link.poll(rig.now_ns())
    assert state is not None
    assert not state.armed
    assert "board_restarted" in state.faults
    assert rig.at_rest()
    rig.driving(LEFT, lambda s: s.armed and s.faults == ())


def test_program_that_hangs_is_restarted_by_the_watchdog(rig: Any) -> None:
    if not rig.has_watchdog:
        pytest.skip("this car has no watchdog")
    rig.link.open()
    rig.ready()
    rig.drive(*LEFT, rig.driven[0])
    rig.do(lambda: rig.board.hang(rig.now_ns()))
    rig.until(lambda _: rig.at_rest(), LEFT)
    rig.until(lambda s: s is not None and not s.armed and "board_restarted" in s.faults, LEFT)
    assert rig.link.hello is not None
    assert rig.link.hello.reset_cause == messages.ResetCause.WATCHDOG


def test_other_message_table_is_a_handshake_error(rig: Any) -> None:
    other = type(rig)(BoardOptions(table_hash=0xDEAD, boot_ns=20 * MS))
    try:
        other.link.open()
        with pytest.raises(HandshakeError, match=r"0xdead.*flash the matching firmware"):
            other.ready()
    finally:
        other.close()


def test_unplugged_and_plugged_in_again(rig: Any) -> None:
    rig.link.open()
    rig.ready()
    rig.drive(*LEFT, rig.driven[0])
    rig.unplug()
    with pytest.raises(PortLost):
        rig.until(lambda _: False, LEFT)
    rig.link.close()
    with pytest.raises(PortNotFound):
        rig.link.open()
    rig.replug()
    rig.link.open()
    assert not rig.ready().armed
    assert rig.at_rest()
    rig.drive(*LEFT, rig.driven[0])


def test_closing_disarms(rig: Any) -> None:
    rig.link.open()
    rig.ready()
    rig.drive(*LEFT, rig.driven[0])
    rig.link.close()
    rig.link.close()
    end_ns = rig.now_ns() + 2_000 * MS
    while rig.board.armed and rig.now_ns() < end_ns:
        rig.wait()
        if not rig.realtime:
            rig.board.advance(rig.now_ns())
            rig.board.transmit(rig.now_ns())
    assert not rig.board.armed
    with pytest.raises(PortLost):
        rig.link.poll(rig.now_ns())
