"""Arming by a button that has to be held, and is heard of again and again."""

from __future__ import annotations

HOLD_TIMEOUT_S = 0.5  # without word of the held button for so long, the car stops: 5 words of a page's 10 a second


class DeadMan:
    """From a held button to a request to arm and a reason to stop; pure, time passed in.

    From `press` on, the car is the operator's until it was stopped: it stops when the button is released or nothing
    has been heard of it for `HOLD_TIMEOUT_S`. `place` says in the reasons where the button is: "the web page".
    """

    def __init__(self, place: str) -> None:
        self._place = place
        self._heard_ns: int | None = None  # of the held button; None where it is not held
        self._arm = False

    @property
    def held(self) -> bool:
        """Whether the button is held."""
        return self._heard_ns is not None

    def press(self, now_ns: int) -> None:
        """The button is pressed; once more while it is held changes nothing."""
        self._arm = self._arm or not self.held
        self._heard_ns = now_ns

    def hold(self, now_ns: int) -> None:
        """The button is still held; one that was never pressed, or was let go, stays so."""
        if self.held:
            self._heard_ns = now_ns

    def release(self) -> str | None:
        """The button is released; why the car has to stop, None where it was not held."""
        was_held = self.held
        self._let_go()
        return f"{self._place}'s button was released" if was_held else None

    def stop(self) -> str:
        """STOP was pressed; why the car has to stop."""
        self._let_go()
        return f"STOP on {self._place}"

    def overdue(self, now_ns: int) -> str | None:
        """Why the car has to stop where nothing was heard for too long; only once."""
        if self._heard_ns is None or now_ns - self._heard_ns < HOLD_TIMEOUT_S * 1e9:
            return None
        self._let_go()
        return f"{self._place}'s button has not been heard of for {HOLD_TIMEOUT_S:g} s"

    def take_arm(self) -> bool:
        """Whether arming was asked for since the last call."""
        asked, self._arm = self._arm, False
        return asked

    def _let_go(self) -> None:
        self._heard_ns, self._arm = None, False
