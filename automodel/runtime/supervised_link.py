"""A vehicle link that may die and come back: its errors become values, and it is opened again without waiting."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

from automodel.interfaces import VehicleLink, wake_of
from automodel.runtime.clocks import NS_PER_S
from automodel.runtime.loop import state_faults
from automodel.runtime.safety import LINK_SILENCE_S
from automodel.signals import Command, Event, VehicleState

RECONNECT_S = 0.2  # between two tries to open a port that is gone


class SupervisedLink:
    """Wraps a `VehicleLink`: an OSError of any call sets `up` to False and goes to `note` as an event.

    Only until the vehicle has said hello for the first time do `open` and `poll` raise: a wrong port or a wrong
    firmware is the user's to put right. After that `poll` opens a lost link again every `RECONNECT_S`. It stays down
    for at least that long, so that whoever asks sees that it was.
    """

    def __init__(self, link: VehicleLink, note: Callable[[Event], None]) -> None:
        self._link = link
        self._note = note
        self._up = False
        self._hello = False  # whether the vehicle has answered since the link was opened
        self._met = False  # whether the vehicle has ever answered
        self._tried_ns = 0  # when the link was lost, or opened, or tried last

    @property
    def up(self) -> bool:
        """Whether the pipe holds, as far as is known."""
        return self._up

    @property
    def ready(self) -> bool:
        """Whether the vehicle has said hello through a pipe that holds: before that nothing may be sent."""
        return self._up and self._hello

    @property
    def wake_ns(self) -> int | None:
        """When the link wants to be polled next, None where it does not say."""
        return wake_of(self._link) if self._up else None

    def open(self, now_ns: int) -> None:
        """Open the pipe for the first time; raises the link's OSError."""
        self._link.open()
        self._up, self._tried_ns = True, now_ns

    def poll(self, now_ns: int) -> VehicleState | None:
        """The vehicle's newest state; None while the link is down or the vehicle has not said hello.

        Raises the link's OSError where the vehicle has never said hello.
        """
        if not self._up and not self._reopen(now_ns):
            return None
        try:
            state = self._link.poll(now_ns)
        except OSError as error:
            if not self._met:
                raise
            self._lost(error, now_ns)
            return None
        self._hello = state is not None
        self._met = self._met or self._hello
        return state

    def newest(self, state: VehicleState | None, now_ns: int) -> VehicleState | None:
        """`state`, or what the vehicle says now where that one is so old that the vehicle may have fallen silent.

        A loop that was held up since it listened does not take its own delay for the vehicle's silence.
        """
        if state is None or now_ns - state.t_ns <= LINK_SILENCE_S * NS_PER_S:
            return state
        said = self.poll(now_ns)
        return state if said is None or state_faults(said) else said

    def send(self, command: Command, now_ns: int) -> bool:
        """Whether the command went out."""
        return self._try(lambda: self._link.send(command, now_ns), now_ns)

    def arm(self, now_ns: int) -> bool:
        """Whether the request went out."""
        return self._try(lambda: self._link.arm(now_ns), now_ns)

    def disarm(self, now_ns: int) -> bool:
        """Whether the request went out."""
        return self._try(lambda: self._link.disarm(now_ns), now_ns)

    def close(self) -> None:
        """Close the pipe, whatever state it is in."""
        self._up = self._hello = False
        with contextlib.suppress(OSError):
            self._link.close()

    def _try(self, call: Callable[[], None], now_ns: int) -> bool:
        if not self.ready:
            return False
        try:
            call()
        except OSError as error:
            self._lost(error, now_ns)
            return False
        return True

    def _lost(self, error: OSError, now_ns: int) -> None:
        self._up = self._hello = False
        self._tried_ns = now_ns
        self._note(Event(t_ns=now_ns, kind="link-lost", text=str(error)))

    def _reopen(self, now_ns: int) -> bool:
        if now_ns - self._tried_ns < RECONNECT_S * NS_PER_S:
            return False
        self._tried_ns = now_ns
        with contextlib.suppress(OSError):
            self._link.close()
        try:
            self._link.open()
        except OSError:
            return False
        self._up = True
        self._note(Event(t_ns=now_ns, kind="link-back", text="the link is open again; arm to drive on"))
        return True
