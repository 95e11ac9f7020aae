"""The board's time seen from the host, and the speed by the board's time or by its rhythm."""

from __future__ import annotations

from collections import deque

_WRAP_US = 1 << 32
_BUCKET_NS = 500_000_000
_WINDOW_NS = 50_000_000
_GAP_NS = 500_000_000
_RHYTHM_NS = 1_000_000_000
_RHYTHM_MIN_NS = 200_000_000


class BoardClock:
    """Host time -> board time, from the least delay seen.

    A message that says board time b arrives at host time h, later than b by an unknown delay: h - b is the offset of
    the clocks plus that delay. The least of the last 0.5 to 1 s is taken, so the board time derived from it is behind
    the true one by the shortest delay, never ahead but for the clocks' drift in that second. When everything is
    delayed, it falls behind, and deadlines written in it are past when they arrive: late commands do not pass for
    fresh ones.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the offset, as for another board or after its restart."""
        self._last_us: int | None = None
        self._bucket_end_ns = 0
        self._least_ns: int | None = None  # of the bucket that is being filled
        self._least_before_ns: int | None = None  # of the bucket before

    def observe(self, time_us: int, host_ns: int) -> int | None:
        """Take in a board time (modulo 2^32 us) that arrived at `host_ns`.

        Gives the board time [ns] unwrapped, or None where the board's time went back: it has restarted.
        """
        if self._last_us is None:
            self._last_us = time_us
        step_us = (time_us - self._last_us) % _WRAP_US
        if step_us >= _WRAP_US // 2:
            return None
        self._last_us += step_us
        board_ns = self._last_us * 1000
        offset_ns = host_ns - board_ns
        if host_ns >= self._bucket_end_ns:
            self._least_before_ns, self._least_ns = self._least_ns, None
            self._bucket_end_ns = host_ns + _BUCKET_NS
        if self._least_ns is None or offset_ns < self._least_ns:
            self._least_ns = offset_ns
        return board_ns

    def board_ns(self, host_ns: int) -> int | None:
        """The board's time [ns] at `host_ns`; None before the first `observe`."""
        if self._least_ns is None:
            return None
        before = self._least_before_ns
        return host_ns - (self._least_ns if before is None else min(before, self._least_ns))


class SpeedMeter:
    """Speed [m/s] from wheel ticks: the way of the last 50 ms of board time over just that time, signed."""

    def __init__(self, ticks_per_m: float) -> None:
        self._ticks_per_m = ticks_per_m
        self._readings: deque[tuple[int, int]] = deque()

    def reset(self) -> None:
        """Forget all readings."""
        self._readings.clear()

    def step(self, board_ns: int, ticks: int) -> float | None:
        """Take in a reading; the speed, or None until two readings lie apart in time."""
        readings = self._readings
        if readings and not 0 < board_ns - readings[-1][0] < _GAP_NS:
            readings.clear()
        readings.append((board_ns, ticks))
        while len(readings) > 2 and board_ns - readings[1][0] >= _WINDOW_NS:
            readings.popleft()
        first_ns, first_ticks = readings[0]
        if first_ns == board_ns:
            return None
        return (ticks - first_ticks) / self._ticks_per_m / ((board_ns - first_ns) * 1e-9)


class LineSpeedMeter:
    """Speed [m/s] from wheel ticks that come in an even rhythm without saying when.

    A host that looks now and then sees their times only roughly. So their mean distance is taken from the last second,
    and the speed is the way of the last 50 ms over the number of readings in it times that distance.
    """

    def __init__(self, ticks_per_m: float) -> None:
        self._ticks_per_m = ticks_per_m
        self._readings: deque[tuple[int, int, int]] = deque()

    def reset(self) -> None:
        """Forget all readings."""
        self._readings.clear()

    def step(self, count: int, ticks: int, now_ns: int) -> float | None:
        """Take in the newest reading, the `count`-th, at `now_ns`; the speed, or None in the first 200 ms."""
        readings = self._readings
        if readings and now_ns - readings[-1][0] > _GAP_NS:
            readings.clear()
        readings.append((now_ns, count, ticks))
        while now_ns - readings[1 if len(readings) > 1 else 0][0] >= _RHYTHM_NS:
            readings.popleft()
        first_ns, first_count, _ = readings[0]
        if now_ns - first_ns < _RHYTHM_MIN_NS or count == first_count:
            return None
        period_ns = (now_ns - first_ns) / (count - first_count)
        for _, before, ticks_before in reversed(readings):
            way_ns = (count - before) * period_ns
            if way_ns >= _WINDOW_NS:
                return (ticks - ticks_before) / self._ticks_per_m / (way_ns * 1e-9)
        return None
