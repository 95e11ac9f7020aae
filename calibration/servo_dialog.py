"""Finding a servo's centre and ends with keys: what each key does, as a value; the terminal is elsewhere."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

STEPS_US = {"left": -5.0, "right": 5.0, ",": -1.0, ".": 1.0, "[": -25.0, "]": 25.0}
HELP = (
    "arrows -/+5 us   , . -/+1   [ ] -/+25   c: straight ahead is here   l: the left end is here   r: the right end   "
    "g: go to straight   Enter: done   q: give up"
)
LEAST_SIDE_US = 50.0  # a side shorter than this is a slip of the finger


class DialogError(ValueError):
    """What was found is no servo; the text says why and what to do."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Dialog:
    """The pulse wanted now, what was found so far, and whether the person is done; `said` is one line for them."""

    low_us: float
    high_us: float
    pulse_us: float
    centre_us: float | None = None
    left_us: float | None = None
    right_us: float | None = None
    done: bool = False
    given_up: bool = False
    said: str = ""

    def key(self, key: str) -> Dialog:
        """The dialog after a key: one of `STEPS_US`, or c l r g, "enter", q; others change nothing."""
        now = replace(self, said="")
        if key in STEPS_US:
            pulse = min(max(self.pulse_us + STEPS_US[key], self.low_us), self.high_us)
            return replace(now, pulse_us=pulse, said="" if pulse != self.pulse_us else "no further: --span-us")
        if key == "c":
            return replace(now, centre_us=self.pulse_us)
        if key == "l":
            return replace(now, left_us=self.pulse_us)
        if key == "r":
            return replace(now, right_us=self.pulse_us)
        if key == "g" and self.centre_us is not None:
            return replace(now, pulse_us=self.centre_us)
        if key == "q":
            return replace(now, given_up=True)
        if key == "enter":
            try:
                ends_of(self)
            except DialogError as error:
                return replace(now, said=str(error))
            return replace(now, done=True)
        return now

    def line(self) -> str:
        """Where the servo is and what was found."""
        found = [f"{name} {'-' if us is None else f'{us:.0f}'}" for name, us in self._found()]
        return f"{self.pulse_us:6.0f} us   {'   '.join(found)}   {self.said}".rstrip()

    def _found(self) -> tuple[tuple[str, float | None], ...]:
        return ("left", self.left_us), ("straight", self.centre_us), ("right", self.right_us)


@dataclass(frozen=True, slots=True, kw_only=True)
class Ends:
    """A servo as it was found: pulses [us] of the left end, straight ahead, and the right end."""

    left_us: float
    centre_us: float
    right_us: float

    def table(self, left_rad: float, right_rad: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """(pulse_us, steering_rad) as `ServoConfig` has them, for the angles at the ends, both taken positive."""
        rows = sorted(((self.left_us, abs(left_rad)), (self.centre_us, 0.0), (self.right_us, -abs(right_rad))))
        return tuple(us for us, _ in rows), tuple(rad for _, rad in rows)


def ends_of(dialog: Dialog) -> Ends:
    """What was found; raises DialogError where something is missing or straight does not lie between the ends."""
    left, centre, right = dialog.left_us, dialog.centre_us, dialog.right_us
    if left is None or centre is None or right is None:
        missing = [f"{name} ({key})" for (name, us), key in zip(dialog._found(), "lcr", strict=True) if us is None]
        raise DialogError(f"still to be found: {', '.join(missing)}")
    if not min(left, right) < centre < max(left, right):
        raise DialogError(f"straight at {centre:.0f} us does not lie between the ends {left:.0f} and {right:.0f} us")
    shorter = min(abs(left - centre), abs(right - centre))
    if shorter < LEAST_SIDE_US:
        raise DialogError(f"one end is only {shorter:.0f} us from straight; {LEAST_SIDE_US:.0f} us at least are wanted")
    return Ends(left_us=left, centre_us=centre, right_us=right)


def keys_of(text: str) -> list[str]:
    """The keys in what a terminal sent: single characters, "enter", and the arrows "left" and "right"."""
    keys, i = [], 0
    while i < len(text):
        if text.startswith(("\x1b[", "\x1bO"), i):
            keys.append({"C": "right", "D": "left"}.get(text[i + 2 : i + 3], "other"))
            i += 3
            continue
        keys.append("enter" if text[i] in "\r\n" else text[i])
        i += 1
    return keys


def side_angles(steering_rad: tuple[float, ...], ends_deg: tuple[float | None, float | None]) -> tuple[float, float]:
    """The angles [rad] at the left and right end: as given [deg], or those that the table had so far."""
    left = max(steering_rad) if ends_deg[0] is None else math.radians(ends_deg[0])
    right = -min(steering_rad) if ends_deg[1] is None else math.radians(ends_deg[1])
    return left, right
