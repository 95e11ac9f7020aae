"""A CAN bus by python-can: what it carries, when that came, and what a bus says of itself."""

from __future__ import annotations

import time

import pytest

from firmware_link.can_port import BusTrouble, PythonCanPort, trouble_of
from firmware_link.can_receiver import CanFrame
from firmware_link.errors import LinkError, PortLost, PortNotFound

MS = 1_000_000


def test_error_frames_of_socketcan() -> None:
    assert trouble_of(0x40, bytes(8)) is BusTrouble.OFF
    assert trouble_of(0x04, bytes((0, 0x10, 0, 0, 0, 0, 0, 0))) is BusTrouble.PASSIVE
    assert trouble_of(0x04, bytes((0, 0x01, 0, 0, 0, 0, 0, 0))) is BusTrouble.ERROR
    assert trouble_of(0x08, bytes(8)) is BusTrouble.ERROR


def test_a_virtual_bus_carries_frames_with_the_time_of_their_arrival() -> None:
    first, second = (PythonCanPort("virtual", "test_can_port", 500_000) for _ in range(2))
    first.open()
    second.open()
    first.send(0x123, b"\x01\x02", False)
    (frame,) = second.receive(1_000).frames
    assert (frame.frame_id, frame.data, frame.extended, frame.t_ns) == (0x123, b"\x01\x02", False, 1_000)
    assert isinstance(frame, CanFrame)
    assert second.receive(2_000).frames == ()
    first.close()
    second.close()
    with pytest.raises(PortLost):
        second.receive(0)


def test_what_waited_in_a_queue_is_not_late() -> None:
    """Bus time runs 5 s behind; the second frame came in time and was fetched 50 ms late."""
    port = PythonCanPort("virtual", "x", 500_000)
    assert port._arrival_ns(1_000 * MS, 6_000 * MS) == 6_000 * MS
    assert port._arrival_ns(1_010 * MS, 6_060 * MS) == 6_010 * MS
    assert port._arrival_ns(1_060 * MS, 6_055 * MS) == 6_055 * MS  # a smaller delay: never after now
    assert port._arrival_ns(3_000 * MS, 8_500 * MS) == 8_500 * MS  # the others are too long ago


def test_a_bus_that_is_not_there_is_one_line() -> None:
    with pytest.raises(PortNotFound, match="the CAN bus cannot be opened") as caught:
        PythonCanPort("nonsense", "can0", 500_000).open()
    assert "\n" not in str(caught.value)


def test_two_ports_of_a_multicast_bus_hear_each_other_and_not_themselves() -> None:
    first, second = (PythonCanPort("udp_multicast", "239.74.163.42", 500_000) for _ in range(2))
    try:
        first.open()
        second.open()
        first.send(0x100, b"\x01", False)
    except LinkError as error:
        pytest.skip(f"no multicast here: {error}")
    assert heard(second) == [(0x100, b"\x01")]
    second.send(0x100, b"\x02", False)
    assert heard(first) == [(0x100, b"\x02")]
    first.close()
    second.close()


def heard(port: PythonCanPort) -> list[tuple[int, bytes]]:
    """What comes within a second, but no longer than until something has come."""
    for t_ms in range(200):
        frames = port.receive(t_ms * MS).frames
        if frames:
            return [(frame.frame_id, frame.data) for frame in frames]
        time.sleep(0.005)
    return []
