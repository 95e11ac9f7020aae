from __future__ import annotations

from firmware_link import messages
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.emulator.faulty_board import FaultyBoard
from firmware_link.emulator.pty import BenchPeripherals

MS = 1_000_000


class Notes:
    """A board that notes what reaches it, and says a byte a millisecond."""

    def __init__(self) -> None:
        self.heard: list[tuple[int, bytes]] = []
        self.now_ns = self.told_ns = 0

    def reset(self, now_ns: int) -> None:
        self.heard.append((now_ns // MS, b"reset"))

    def receive(self, data: bytes, now_ns: int) -> int:
        assert now_ns == self.now_ns, "the board is run up to the time at which bytes reach it"
        self.heard.append((now_ns // MS, data))
        return len(data)

    def transmit(self, now_ns: int) -> bytes:
        count, self.told_ns = (now_ns - self.told_ns) // MS, now_ns
        return b"." * count

    def advance(self, now_ns: int) -> None:
        assert now_ns >= self.now_ns
        self.now_ns = now_ns


def run(line: FaultyBoard, writes: dict[int, bytes], until_ms: int, step_ms: int = 7) -> dict[int, bytes]:
    """Write at these times [ms]; what was read when [ms]."""
    read = {}
    for t_ms in range(0, until_ms, step_ms):
        line.advance(t_ms * MS)
        for write_ms in range(t_ms, t_ms + step_ms):
            if write_ms in writes:
                line.advance(write_ms * MS)
                line.receive(writes[write_ms], write_ms * MS)
        read[t_ms + step_ms - 1] = b""
        line.advance((t_ms + step_ms - 1) * MS)
        read[t_ms + step_ms - 1] = line.transmit((t_ms + step_ms - 1) * MS)
    return read


def test_without_hooks_it_is_the_board() -> None:
    board = Notes()
    run(FaultyBoard(board, 0, 1000 * MS), {3: b"a", 50: b"b"}, 70)
    assert board.heard == [(3, b"a"), (50, b"b")]


def test_hooks_are_asked_while_the_fault_lasts_and_bytes_arrive_at_their_very_time() -> None:
    board = Notes()
    line = FaultyBoard(board, 20 * MS, 40 * MS, to_board=lambda data, t_ns: [(t_ns + 30 * MS, data)])
    run(line, {5: b"a", 22: b"b", 39: b"c", 45: b"d", 90: b"e"}, 105)
    assert board.heard == [(5, b"a"), (52, b"b"), (69, b"c"), (69, b"d"), (90, b"e")]  # d does not overtake c


def test_what_the_board_says_may_be_late_and_lost_too() -> None:
    late = FaultyBoard(Notes(), 20 * MS, 40 * MS, from_board=lambda data, t_ns: [(t_ns + 15 * MS, data)])
    read = run(late, {}, 70)
    assert sum(map(len, read.values())) == 69
    assert [t_ms for t_ms, data in read.items() if not data] == [20, 27, 34]
    lost = FaultyBoard(Notes(), 20 * MS, 40 * MS, from_board=lambda data, t_ns: [])
    assert sum(map(len, run(lost, {}, 70).values())) == 69 - 3 * 7


def test_planned_calls_come_in_order_at_their_time() -> None:
    board, called = Notes(), []
    line = FaultyBoard(board, 0, 0)
    for t_ms in (33, 11, 11):
        line.at(t_ms * MS, lambda t_ns: called.append((t_ns // MS, board.now_ns // MS)))
    line.advance(60 * MS)
    assert called == [(11, 11), (11, 11), (33, 33)]
    other = Notes()
    line.board = other
    line.advance(70 * MS)
    assert (board.now_ns, other.now_ns) == (60 * MS, 70 * MS)


def test_pulses_of_commands_are_changed_and_nothing_else() -> None:
    board = Notes()
    line = FaultyBoard(board, 0, 100 * MS, pulses=lambda servo_us, motor_us: (servo_us + 100.0, 2000.0))
    command = messages.Command(servo_us=1400.0, motor_us=1600.0, deadline_ms=77, flags=1)
    arm = messages.encode(messages.Arm(nonce=3, boot_id=4), 8)
    run(line, {5: messages.encode(command, 9), 10: arm}, 20)
    (_, changed), (_, same) = board.heard
    assert same == arm
    (frame,) = messages.decoder(on_board=True).feed(changed)
    wanted = messages.Command(servo_us=1500.0, motor_us=2000.0, deadline_ms=77, flags=1)
    assert (messages.decode(frame), frame.counter) == (wanted, 9)


def test_around_the_emulated_board_it_changes_nothing() -> None:
    plain, wrapped = (EmulatedArduino(BenchPeripherals()) for _ in range(2))
    line = FaultyBoard(wrapped, 0, 0)
    said = []
    for board in (plain, line):
        board.advance(0)
        out = b""
        for t_ms in range(0, 700, 16):
            board.advance(t_ms * MS)
            board.receive(messages.encode(messages.HelloRequest(), t_ms & 0xFF), t_ms * MS)
            out += board.transmit(t_ms * MS)
        said.append(out)
    assert said[0] == said[1]
    assert len(said[0]) > 500
