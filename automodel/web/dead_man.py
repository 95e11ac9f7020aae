"""Arming from a distance: only while the operator holds a button, which is heard of again and again."""

from __future__ import annotations

import enum

HOLD_TIMEOUT_S = 0.5  # without word of the held button for so long, the car stops: 5 words of the page's 10 a second


class Word(enum.Enum):
    """What the operator's page says; one byte each."""

    STOP = b"S"
    ARM = b"A"  # the button was pressed
    HOLD = b"H"  # and is held
    RELEASE = b"R"


class DeadMan:
    """From the page's words to a request to arm and a reason to stop; pure, time passed in.

    From `ARM` on, the car is the operator's until it was stopped: it stops when the button is released or nothing
    has been heard of it for `HOLD_TIMEOUT_S`.
    """

    def __init__(self) -> None:
        self._heard_ns: int | None = None  # of the held button; None where it is not held
        self._arm = False

    @property
    def held(self) -> bool:
        """Whether the button is held."""
        return self._heard_ns is not None

    def hear(self, word: Word, now_ns: int) -> str | None:
        """Take up a word; why the car has to stop, None where it has not."""
        if word is Word.STOP:
            self._let_go()
            return "STOP on the web page"
        if word is Word.RELEASE:
            was_held = self.held
            self._let_go()
            return "the web page's button was released" if was_held else None
        if word is Word.ARM and not self.held:
            self._arm = True
        if word is Word.ARM or self.held:
            self._heard_ns = now_ns
        return None

    def overdue(self, now_ns: int) -> str | None:
        """Why the car has to stop where nothing was heard for too long; only once."""
        if self._heard_ns is None or now_ns - self._heard_ns < HOLD_TIMEOUT_S * 1e9:
            return None
        self._let_go()
        return f"the web page's button has not been heard of for {HOLD_TIMEOUT_S:g} s"

    def take_arm(self) -> bool:
        """Whether arming was asked for since the last call."""
        asked, self._arm = self._arm, False
        return asked

    def _let_go(self) -> None:
        self._heard_ns, self._arm = None, False
