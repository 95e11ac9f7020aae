"""Ways to damage a file: bits, bytes, lengths and numbers."""

from __future__ import annotations

import re
from random import Random

NUMBERS = (b"0", b"-1", b"1e300", b"-1e300", b"1e-300", b"nan", b"inf", b"9" * 400, b"0x7fffffff", b"[1]", b'"x"', b"")
TOKENS = (b"\0", b"\xff\xfe", b"\r\n", b'"', b"[[", b"{" * 50, b",,,", b"=", b"\n\n", b"#" * 100, b"\xc3\x28", b"-")


def damaged(data: bytes, random: Random) -> bytes:
    """`data` with one to four kinds of damage."""
    for _ in range(random.choice((1, 1, 1, 2, 4))):
        data = random.choice((_flipped, _cut, _inserted, _repeated, _numbered, _zeroed, _without_line))(data, random)
    return data


def _flipped(data: bytes, random: Random) -> bytes:
    spoilt = bytearray(data)
    for _ in range(random.choice((1, 1, 8)) if data else 0):
        spoilt[random.randrange(len(spoilt))] ^= 1 << random.randrange(8)
    return bytes(spoilt)


def _cut(data: bytes, random: Random) -> bytes:
    return data[: random.randrange(len(data) + 1)]


def _inserted(data: bytes, random: Random) -> bytes:
    at = random.randrange(len(data) + 1)
    return data[:at] + random.choice((*TOKENS, random.randbytes(random.randint(1, 40)))) + data[at:]


def _repeated(data: bytes, random: Random) -> bytes:
    start = random.randrange(len(data) + 1)
    piece = data[start : start + random.randint(1, 200)]
    return data[:start] + piece * random.randint(2, 20) + data[start:]


def _numbered(data: bytes, random: Random) -> bytes:
    numbers = list(re.finditer(rb"-?\d+(\.\d+)?", data[:100_000]))
    if not numbers:
        return data
    number = random.choice(numbers)
    return data[: number.start()] + random.choice(NUMBERS) + data[number.end() :]


def _zeroed(data: bytes, random: Random) -> bytes:
    at, count = random.randrange(len(data) + 1), random.randint(1, 64)
    return data[:at] + random.choice((b"\0", b"\xff")) * len(data[at : at + count]) + data[at + count :]


def _without_line(data: bytes, random: Random) -> bytes:
    lines = data.split(b"\n")
    del lines[random.randrange(len(lines))]
    return b"\n".join(lines)
