"""The serial port and the board on a pty, with real file descriptors."""

from __future__ import annotations

import contextlib
import os
import select
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from serial.tools import list_ports

from firmware_link import messages
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.emulator.logic import BoardOptions
from firmware_link.emulator.pty import BenchPeripherals, PtyBoard
from firmware_link.errors import LinkError, PortLost, PortNotFound, PortRefused
from firmware_link.framing import Decoder, RawFrame
from firmware_link.transport import SerialTransport

MS = 1_000_000


@pytest.fixture
def pty() -> Iterator[PtyBoard]:
    pty = PtyBoard(EmulatedArduino(BenchPeripherals(), options=BoardOptions(boot_ns=10 * MS)))
    yield pty
    pty.close()


def emulated(pty: PtyBoard) -> EmulatedArduino:
    assert isinstance(pty.board, EmulatedArduino)
    return pty.board


def stepped(pty: PtyBoard, start_ms: int, count: int, each: Callable[[], None] = lambda: None) -> int:
    for t_ms in range(start_ms, start_ms + count):
        pty.step(t_ms * MS)
        each()
    return start_ms + count


def stepped_until(pty: PtyBoard, start_ms: int, wanted: Callable[[], bool], limit: int = 300) -> int:
    """Steps until it is as wanted; the kernel hands a pty's bytes on in its own time."""
    for t_ms in range(start_ms, start_ms + limit):
        pty.step(t_ms * MS)
        if wanted():
            return t_ms + 1
        time.sleep(0.001)
    raise AssertionError("never came to be")


def heard(port: SerialTransport, decoder: Decoder, frames: list[RawFrame]) -> bool:
    """Whether a frame has arrived; it joins the others."""
    frames += decoder.feed(port.read())
    return bool(frames)


def repeat(function: Callable[[], object], times: int) -> None:
    for _ in range(times):
        function()


def test_an_empty_port_is_neither_read_nor_polled(pty: PtyBoard, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both wait for the kernel's worker, whatever the timeout: see `SerialTransport.read`."""
    port = SerialTransport(pty.path, 115200)
    port.open()
    at_ms = stepped_until(pty, 0, lambda: port.read() == b"")
    poll_of_the_board, waited = pty._poll, []
    with monkeypatch.context() as patch:
        for name in ("select", "poll"):
            patch.setattr(select, name, lambda *_: waited.append("polled"))
        patch.setattr(os, "read", lambda *_: waited.append("read"))
        assert port.read() == b""
    assert not waited
    pty._poll = poll_of_the_board
    stepped_until(pty, at_ms, lambda: port.read() != b"")
    port.close()


def test_missing_port_names_the_likely_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    ports = [
        SimpleNamespace(device="/dev/ttyUSB3", description="USB Serial CH340", vid=0x1A86),
        SimpleNamespace(device="/dev/ttyS0", description="n/a", vid=None),
    ]
    monkeypatch.setattr(list_ports, "comports", lambda: ports)
    with pytest.raises(PortNotFound) as error:
        SerialTransport("/dev/no-such-port", 115200).open()
    assert str(error.value) == (
        "/dev/no-such-port: no such port; likely: /dev/ttyUSB3 (USB Serial CH340); set [link] port in car.toml"
    )
    monkeypatch.setattr(list_ports, "comports", lambda: ports[1:])
    with pytest.raises(PortNotFound, match="plug the board in"):
        SerialTransport("/dev/no-such-port", 115200).open()


def test_what_is_no_serial_port_is_refused_in_one_line(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("not a port")
    for path in (file, tmp_path):
        with pytest.raises(LinkError, match=str(path)) as error:
            SerialTransport(str(path), 115200).open()
        assert "\n" not in str(error.value)


def test_port_is_held_alone(pty: PtyBoard) -> None:
    first, second = SerialTransport(pty.path, 115200), SerialTransport(pty.path, 115200)
    first.open()
    with pytest.raises(PortRefused, match="another program"):
        second.open()
    first.close()
    second.open()
    second.close()


def test_not_open(pty: PtyBoard) -> None:
    port = SerialTransport(pty.path, 115200)
    for call in (port.read, lambda: port.write(b"x")):
        with pytest.raises(PortLost, match="not open"):
            call()
    port.close()


def test_port_that_takes_nothing_is_lost_and_never_blocks(pty: PtyBoard) -> None:
    port = SerialTransport(pty.path, 115200)
    port.open()
    with pytest.raises(PortLost, match="accepts no more bytes"):
        repeat(lambda: port.write(b"x" * 14), 100_000)  # nobody steps the board
    port.close()


def test_opening_resets_each_time_and_stepping_needs_no_thread(pty: PtyBoard) -> None:
    port = SerialTransport(pty.path, 115200)
    decoder = messages.decoder(on_board=False)
    t_ms = stepped(pty, 0, 50)
    board = emulated(pty)
    assert board.counters.starts == 1  # power
    for opening in range(2, 5):
        port.open()
        decoder.reset()  # closing may have cut a frame in two: as the link does
        frames: list[RawFrame] = []
        t_ms = stepped(pty, t_ms, 30)
        t_ms = stepped_until(pty, t_ms, lambda: heard(port, decoder, frames))  # noqa: B023 - called within the turn
        assert board.counters.starts == opening
        hello = messages.decode(frames[0])
        assert isinstance(hello, messages.Hello)
        assert hello.boot_id == opening
        port.close()
        t_ms = stepped(pty, t_ms, 5)
    assert decoder.errors.total == 0


def test_a_host_hears_nothing_of_the_time_before_it_opened(pty: PtyBoard) -> None:
    """Not even where the board was held up meanwhile, and makes up for it in the step that sees the host."""
    stepped(pty, 0, 50)
    port = SerialTransport(pty.path, 115200)
    port.open()
    pty.step(350 * MS)
    decoder = messages.decoder(on_board=False)
    heard: list[object] = []

    def anything() -> bool:
        heard.extend(messages.decode(frame) for frame in decoder.feed(port.read()))
        return bool(heard)

    stepped_until(pty, 350, anything)
    assert isinstance(heard[0], messages.Hello)
    assert heard[0].boot_id == 2
    port.close()


def test_bytes_arrive_as_they_were_sent_without_echo(pty: PtyBoard) -> None:
    """Raw in both directions, also for a host that opens the port and sets nothing up."""
    t_ms = stepped(pty, 0, 5)
    slave = os.open(pty.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        t_ms = stepped(pty, t_ms, 15)
        os.write(slave, messages.encode(messages.HelloRequest(), 0x0A))
        decoder = messages.decoder(on_board=False)
        kinds: list[type] = []

        def two_hellos() -> bool:
            with contextlib.suppress(BlockingIOError):
                kinds.extend(type(messages.decode(f)) for f in decoder.feed(os.read(slave, 4096)))
            return kinds.count(messages.Hello) == 2

        stepped_until(pty, t_ms, two_hellos)
        assert decoder.errors.total == 0
        assert emulated(pty)._decoder.errors.total == 0
        assert emulated(pty).counters.rx_in_boot == 0
    finally:
        os.close(slave)


def test_host_that_does_not_read_holds_nothing_up(pty: PtyBoard) -> None:
    port = SerialTransport(pty.path, 115200)
    port.open()
    t_ms = stepped(pty, 0, 1)
    for _ in range(300):  # 60 s at 2.6 kB/s
        t_ms += 200
        pty.step(t_ms * MS)
    assert len(pty._unread) <= 4096
    total = 0
    for _ in range(100):
        data = port.read()
        assert len(data) <= 4096
        total += len(data)
    assert 0 < total < 100_000
    port.close()


def test_host_that_writes_too_much_is_held_up(pty: PtyBoard) -> None:
    slave = os.open(pty.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        written, t_ms = 0, stepped(pty, 0, 20)
        for _ in range(200):
            try:
                while True:
                    written += os.write(slave, b"\1" * 1000)
            except BlockingIOError:
                t_ms = stepped(pty, t_ms, 1)
        assert written < 100_000
    finally:
        os.close(slave)


def test_unplug_and_replug_keep_the_path(pty: PtyBoard) -> None:
    port = SerialTransport(pty.path, 115200)
    port.open()
    t_ms = stepped(pty, 0, 30)
    path = pty.path
    pty.unplug()
    pty.unplug()
    t_ms = stepped(pty, t_ms, 10)
    assert not os.path.lexists(path)
    with pytest.raises(PortLost, match="disappeared"):
        repeat(port.read, 2)  # the first may still have bytes
    with pytest.raises(PortLost):
        port.write(b"x")
    port.close()
    with pytest.raises(PortNotFound):
        port.open()
    pty.replug()
    assert pty.path == path
    starts = emulated(pty).counters.starts
    port.open()
    stepped(pty, t_ms, 10)
    assert emulated(pty).counters.starts == starts + 1
    port.close()


def test_close_removes_everything(tmp_path: Path) -> None:
    before = set(os.listdir("/proc/self/fd"))
    board = EmulatedArduino(BenchPeripherals())
    with PtyBoard(board) as pty:
        directory = Path(pty.path).parent
        assert Path(pty.path).exists()
    assert not directory.exists()
    named = PtyBoard(board, path=tmp_path / "board")
    assert named.path == str(tmp_path / "board")
    named.close()
    named.close()
    assert list(tmp_path.iterdir()) == []
    assert set(os.listdir("/proc/self/fd")) == before


def test_path_that_is_taken_is_left_alone(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("mine")
    with pytest.raises(FileExistsError):
        PtyBoard(EmulatedArduino(BenchPeripherals()), path=file)
    assert file.read_text() == "mine"


@pytest.mark.realtime
def test_thread_serves_on_the_monotonic_clock(pty: PtyBoard) -> None:
    pty.start()
    pty.start()
    port = SerialTransport(pty.path, 115200)
    port.open()
    decoder = messages.decoder(on_board=False)
    seen: set[type] = set()
    end_ns = time.monotonic_ns() + 10_000 * MS
    while len(seen) < 4 and time.monotonic_ns() < end_ns:
        seen |= {type(messages.decode(frame)) for frame in decoder.feed(port.read())}
        time.sleep(0.002)
    assert seen == {messages.Hello, messages.Status, messages.Odometry, messages.Ranges}
    port.close()
