"""What the operator's page says, on its way to the run: a byte a word, and what a person wants who drives by hand."""

from __future__ import annotations

import enum
import math
import struct

_WANTED = struct.Struct("<cdd")
LONGEST = _WANTED.size  # bytes


class Word(enum.Enum):
    """The page's words without numbers; one byte each."""

    STOP = b"S"
    ARM = b"A"  # the button that lets the pipeline drive was pressed
    TAKE = b"T"  # the one to drive by hand was
    HOLD = b"H"  # and is held
    RELEASE = b"R"


Wanted = tuple[float, float]  # shares -1 .. 1 of the greatest steering, left positive, and speed
_WORDS = {word.name.lower(): word for word in Word}


def from_page(text: str) -> Word | Wanted | None:
    """A page's text: "stop", "arm", "take", "hold", "release" or "drive STEERING SPEED"; None for anything else."""
    if text in _WORDS:
        return _WORDS[text]
    verb, _, numbers = text.partition(" ")
    try:
        steering, speed = map(float, numbers.split(" "))
    except ValueError:
        return None
    known = verb == "drive" and math.isfinite(steering) and abs(steering) <= 1.0 and abs(speed) <= 1.0
    return (steering, speed) if known else None


def to_bytes(said: Word | Wanted) -> bytes:
    """For the pipe to the run."""
    return said.value if isinstance(said, Word) else _WANTED.pack(b"D", *said)


def from_bytes(data: bytes) -> Word | Wanted:
    """From the pipe; raises ValueError for what `to_bytes` does not give."""
    if len(data) != LONGEST:
        return Word(data)
    _, steering, speed = _WANTED.unpack(data)
    return steering, speed
