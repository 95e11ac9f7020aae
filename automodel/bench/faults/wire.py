"""What can go wrong on a serial line: hooks that take bytes and say when which bytes arrive instead."""

from __future__ import annotations

from random import Random

from automodel.bench.faults.hooks import WireHook

Arrivals = tuple[tuple[int, bytes], ...]


def silent(data: bytes, t_ns: int) -> Arrivals:
    """Nothing arrives."""
    return ()


def held_back(until_ns: int) -> WireHook:
    """Nothing arrives before `until_ns`, then everything at once: what nobody read meanwhile."""
    return lambda data, t_ns: ((until_ns, data),)


def delayed(by_ns: int) -> WireHook:
    """Everything arrives, so much later."""
    return lambda data, t_ns: ((t_ns + by_ns, data),)


def falling_behind(from_ns: int, rate: float) -> WireHook:
    """Everything arrives later and later: by `rate` seconds for each second since `from_ns`."""
    return lambda data, t_ns: ((t_ns + round(rate * (t_ns - from_ns)), data),)


def noise_before(random: Random, at_most: int) -> WireHook:
    """Up to `at_most` random bytes ahead of what was sent."""
    return lambda data, t_ns: ((t_ns, random.randbytes(random.randint(1, at_most)) + data),)


def random_bytes(random: Random) -> WireHook:
    """Other bytes, as many as were sent."""
    return lambda data, t_ns: ((t_ns, random.randbytes(len(data))),)


def cut(random: Random) -> WireHook:
    """Only the beginning of what was sent."""
    return lambda data, t_ns: ((t_ns, data[: random.randint(1, max(len(data) - 2, 1))]),)


def doubled(data: bytes, t_ns: int) -> Arrivals:
    """Everything arrives twice."""
    return ((t_ns, data + data),)


class Swapped:
    """Every other piece arrives after the one that was sent after it."""

    def __init__(self) -> None:
        self._held: bytes | None = None

    def __call__(self, data: bytes, t_ns: int) -> Arrivals:
        """Two pieces, or none yet."""
        held, self._held = self._held, None
        if held is not None:
            return ((t_ns, data + held),)
        self._held = data
        return ()


def corrupt(random: Random) -> WireHook:
    """One to five wrong bits in every piece."""

    def hook(data: bytes, t_ns: int) -> Arrivals:
        spoilt = bytearray(data)
        for bit in random.sample(range(8 * len(data)), min(random.randint(1, 5), 8 * len(data))):
            spoilt[bit // 8] ^= 1 << bit % 8
        return ((t_ns, bytes(spoilt)),)

    return hook


def once(spoil: WireHook) -> WireHook:
    """The first piece only."""
    done = False

    def hook(data: bytes, t_ns: int) -> Arrivals:
        nonlocal done
        if done or not data:
            return ((t_ns, data),)
        done = True
        return tuple(spoil(data, t_ns))

    return hook


def one_byte(random: Random) -> WireHook:
    """One byte of the first piece is another."""

    def spoil(data: bytes, t_ns: int) -> Arrivals:
        place = random.randrange(len(data))
        other = (data[place] + random.randint(1, 255)) & 0xFF
        return ((t_ns, data[:place] + bytes((other,)) + data[place + 1 :]),)

    return once(spoil)
