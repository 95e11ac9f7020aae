"""A board behind a faulty line: lost, changed and late bytes, and events at planned times."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable

from firmware_link import messages
from firmware_link.transport import Board

WireHook = Callable[[bytes, int], Iterable[tuple[int, bytes]]]
PulseHook = Callable[[float, float], tuple[float, float]]


class FaultyBoard:
    """Implements `Board` around another one; hooks are called for bytes that are sent from `start_ns` to `end_ns`.

    `to_board` and `from_board` get bytes and their time of sending, and give the bytes that arrive instead with their
    times; bytes do not overtake each other. `pulses` replaces the servo's and the motor's pulse [us] of each command.
    `at` plans a call. Everything happens at its time between two steps of the inner board `board`, which may be
    replaced by assignment.
    """

    def __init__(
        self,
        board: Board,
        start_ns: int,
        end_ns: int,
        *,
        to_board: WireHook | None = None,
        from_board: WireHook | None = None,
        pulses: PulseHook | None = None,
    ) -> None:
        self.board = board
        self._start_ns, self._end_ns = start_ns, end_ns
        self._hooks = (to_board, from_board)
        self._pulses = pulses
        self._last_ns = [0, 0]  # when the last bytes arrive, to the board and from it
        self._planned: list[tuple[int, int, Callable[[int], None]]] = []
        self._count = 0
        self._from: list[tuple[int, bytes]] = []
        self._decoder = messages.decoder(on_board=True)

    def at(self, t_ns: int, call: Callable[[int], None]) -> None:
        """Plan `call(t_ns)`."""
        self._count += 1
        heapq.heappush(self._planned, (t_ns, self._count, call))

    def reset(self, now_ns: int) -> None:
        """As the board's."""
        self.board.reset(now_ns)

    def receive(self, data: bytes, now_ns: int) -> int:
        """Put bytes on the line; gives their number, even if they get lost on the line."""
        for t_ns, piece in self._changed(0, self._with_pulses(data, now_ns), now_ns):
            if t_ns <= now_ns:
                self.board.receive(piece, now_ns)
            else:
                self.at(t_ns, lambda due_ns, piece=piece: self._put(piece, due_ns))  # type: ignore[misc]
        return len(data)

    def transmit(self, now_ns: int) -> bytes:
        """The bytes that have arrived at this end."""
        sent = self.board.transmit(now_ns)
        if sent:
            self._from.extend(self._changed(1, sent, now_ns))
        arrived = b"".join(piece for t_ns, piece in self._from if t_ns <= now_ns)
        self._from = [(t_ns, piece) for t_ns, piece in self._from if t_ns > now_ns]
        return arrived

    def advance(self, now_ns: int) -> None:
        """Run the board up to `now_ns` with the calls that are planned until then."""
        while self._planned and self._planned[0][0] <= now_ns:
            t_ns, _, call = heapq.heappop(self._planned)
            self.board.advance(t_ns)
            call(t_ns)
        self.board.advance(now_ns)

    def _put(self, piece: bytes, t_ns: int) -> None:
        self.board.receive(piece, t_ns)

    def _changed(self, direction: int, data: bytes, now_ns: int) -> Iterable[tuple[int, bytes]]:
        hook = self._hooks[direction]
        if hook is None or not self._lasts(now_ns):
            pieces: Iterable[tuple[int, bytes]] = ((now_ns, data),)
        else:
            pieces = hook(data, now_ns)
        for t_ns, piece in pieces:
            self._last_ns[direction] = max(t_ns, self._last_ns[direction])
            yield self._last_ns[direction], piece

    def _with_pulses(self, data: bytes, now_ns: int) -> bytes:
        if self._pulses is None or not self._lasts(now_ns):
            return data
        out = b""
        for frame in self._decoder.feed(data):
            message = messages.decode(frame)
            if not isinstance(message, messages.Command):
                return data
            servo_us, motor_us = self._pulses(message.servo_us, message.motor_us)
            changed = messages.Command(
                servo_us=servo_us, motor_us=motor_us, deadline_ms=message.deadline_ms, flags=message.flags
            )
            out += messages.encode(changed, frame.counter)
        return out

    def _lasts(self, t_ns: int) -> bool:
        return self._start_ns <= t_ns < self._end_ns
