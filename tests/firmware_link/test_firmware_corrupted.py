"""Corrupted command frames, ten million of them, at the board's C++ decoder: none may be taken, and it goes on hearing.

Corrupted as a serial line corrupts: wrong bits, bursts, lost and doubled bytes, frames cut short, frames spliced.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from automodel.types import Image
from firmware_link import messages

Damage = Callable[[np.random.Generator, Image], bytes]
BATCH = 100_000
CHECK_BITS = 40


def command_frames(rng: np.random.Generator, count: int) -> Image:
    """(count, 17): frames of random commands; 17 bytes, the first and the last are the delimiters."""
    wires = []
    for servo, motor, deadline, flags, counter in rng.integers(
        [1000, 1000, 0, 0, 0], [5001, 5001, 65536, 2, 256], (count, 5)
    ):
        command = messages.Command(
            servo_us=float(servo) / 2, motor_us=float(motor) / 2, deadline_ms=int(deadline), flags=int(flags)
        )
        wires.append(np.frombuffer(messages.encode(command, int(counter)), dtype=np.uint8))
    return np.array(wires)


def wrong_bits(rng: np.random.Generator, frames: Image) -> bytes:
    """One to seven, anywhere between the delimiters."""
    count, length = len(frames), frames.shape[1] - 2
    wrong = np.zeros((count, length), dtype=np.uint8)
    used = np.arange(7)[:, None] < rng.integers(1, 8, count)
    for place, use in zip(rng.integers(8 * length, size=(7, count)), used, strict=True):
        wrong[np.arange(count), place // 8] ^= np.where(use, 1 << place % 8, 0).astype(np.uint8)
    return flipped(frames, wrong)


def burst(rng: np.random.Generator, frames: Image) -> bytes:
    """Wrong bits within 32 that follow each other on the line, where the lowest of a byte comes first."""
    count, bits = len(frames), 8 * (frames.shape[1] - 2)
    pattern = np.zeros((count, bits), dtype=np.uint8)
    first = rng.integers(0, bits - CHECK_BITS - 31, size=count)
    pattern[np.arange(count)[:, None], first[:, None] + np.arange(32)] = rng.integers(0, 2, (count, 32), dtype=np.uint8)
    return flipped(frames, np.packbits(pattern, axis=1, bitorder="little"))


def noise(rng: np.random.Generator, frames: Image) -> bytes:
    """Each bit wrong once in a hundred times."""
    wrong = rng.integers(100, size=(len(frames), 8 * (frames.shape[1] - 2)), dtype=np.uint8) == 0
    return flipped(frames, np.packbits(wrong, axis=1))


def lost_bytes(rng: np.random.Generator, frames: Image) -> bytes:
    """One to three, not the delimiters."""
    kept = np.ones(frames.shape, dtype=bool)
    for _ in range(3):
        kept[np.arange(len(frames)), rng.integers(1, frames.shape[1] - 1, len(frames))] = False
    return frames[kept].tobytes()


def doubled_byte(rng: np.random.Generator, frames: Image) -> bytes:
    """One, not the delimiters."""
    times = np.ones(frames.shape, dtype=np.intp)
    times[np.arange(len(frames)), rng.integers(1, frames.shape[1] - 1, len(frames))] = 2
    return np.repeat(frames.ravel(), times.ravel()).tobytes()


def cut(rng: np.random.Generator, frames: Image) -> bytes:
    """The end or the beginning is missing, not the delimiters."""
    count, length = frames.shape
    place = np.arange(length)
    ends = place < rng.integers(2, length - 1, count)[:, None]
    begins = place >= rng.integers(2, length - 1, count)[:, None]
    first: Any = rng.integers(0, 2, (count, 1), dtype=bool)
    kept = np.where(first, ends, begins)
    kept[:, [0, -1]] = True
    return frames[kept].tobytes()


def flipped(frames: Image, wrong: Image) -> bytes:
    """All frames behind each other, with `wrong` (count, 15) put over them; where that is nothing, a bit."""
    wrong[~wrong.any(axis=1), 0] = 1
    frames[:, 1:-1] ^= wrong
    return frames.tobytes()


DAMAGES: tuple[Damage, ...] = (wrong_bits, burst, noise, lost_bytes, doubled_byte, cut)


def accepted(library: Any, stream: bytes) -> list[bytes]:
    """Type, counter and payload of what is taken."""
    out = (ctypes.c_uint8 * (len(stream) + 64))()
    errors = ctypes.c_uint32()
    count = library.decode_stream(stream, len(stream), out, ctypes.byref(errors))
    return [bytes(out[9 * index : 9 * index + 9]) for index in range(count)]


def corrupted(library: Any, total: int, seed: int) -> int:
    """How many corrupted frames were tried; each batch must be thrown away whole but for the good frame behind it."""
    rng = np.random.default_rng(seed)
    pool, tried = command_frames(rng, 4096), 0
    good = messages.encode(messages.Command(servo_us=1234.5, motor_us=1500.0, deadline_ms=7, flags=1), 99)
    (wanted,) = accepted(library, good)
    while tried < total:
        damage = DAMAGES[tried // BATCH % len(DAMAGES)]
        frames = pool[rng.integers(len(pool), size=BATCH)]
        stream = damage(rng, frames.copy())
        assert accepted(library, stream + good) == [wanted], damage.__name__
        tried += BATCH
    return tried


def test_corrupted_frames_are_thrown_away(library: Any) -> None:
    assert corrupted(library, 600_000, 1) == 600_000


@pytest.mark.slow
def test_ten_million_corrupted_frames_are_thrown_away(library: Any) -> None:
    assert corrupted(library, 10_000_000, 2) == 10_000_000


def test_frames_that_are_not_corrupted_are_taken(library: Any) -> None:
    frames = command_frames(np.random.default_rng(3), 1000)
    assert len(accepted(library, frames.tobytes())) == 1000


def bodies(seed: int) -> tuple[bytes, int, int]:
    """4096 commands without their delimiters one after the other, their number, and the length of each."""
    frames = command_frames(np.random.default_rng(seed), 4096)[:, 1:-1]
    return frames.tobytes(), len(frames), frames.shape[1]


@pytest.mark.parametrize("aligned", [False, True])
def test_no_frame_is_spliced_from_two(library: Any, aligned: bool) -> None:
    assert library.splice(*bodies(4), aligned, 10_000_000, ctypes.c_uint64(5)) == 0


@pytest.mark.parametrize("bits", [6, 7, 8, 12])
def test_frames_with_many_wrong_bits_are_thrown_away(library: Any, bits: int) -> None:
    assert library.wrong_bits(*bodies(6), bits, 3_000_000, ctypes.c_uint64(7)) == 0


def test_what_is_not_damaged_is_taken_by_the_trials(library: Any) -> None:
    assert library.wrong_bits(*bodies(8), 0, 1000, ctypes.c_uint64(9)) == 1000
