"""Estimation of the board's time from the host, and the speed from wheel ticks."""

from __future__ import annotations

from collections import deque

_WRAP_US = 1 << 32
_BUCKET_NS = 500_000_000
_WINDOW_NS = 50_000_000
_GAP_NS = 500_000_000
_PERIODIC_NS = 1_000_000_000
_PERIODIC_MIN_NS = 200_000_000


class BoardClock:
    """Converts host time to board time by the smallest observed delay.

    A message with board time b arrives at host time h with an unknown delay: h - b is the offset of the clocks plus the
    delay. The minimum of the last 0.5 to 1 s is used, so that the derived board time is behind the true one by the
    shortest delay, and never ahead except for the clocks' drift in that second. If all messages are delayed, it falls
    behind, and deadlines in board time have passed on arrival: late commands are not taken for fresh ones.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the offset, for another board or after a restart."""
        self._last_us: int | None = None
        self._bucket_end_ns = 0
        self._least_ns: int | None = None  # of the current bucket
        self._least_before_ns: int | None = None  # of the previous bucket

    def observe(self, time_us: int, host_ns: int) -> int | None:
        """Process a board time (modulo 2^32 us) that arrived at `host_ns`.

        Gives the unwrapped board time [ns], or None if it went back: the board has restarted.
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
    """Signed speed [m/s] from wheel ticks over the last 50 ms of board time."""

    def __init__(self, ticks_per_m: float) -> None:
        self._ticks_per_m = ticks_per_m
        self._readings: deque[tuple[int, int]] = deque()

    def reset(self) -> None:
        """Forget all readings."""
        self._readings.clear()

    def step(self, board_ns: int, ticks: int) -> float | None:
        """Process a reading; gives the speed, or None until there are two readings at different times."""
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
    """Speed [m/s] from periodic wheel ticks without timestamps.

    The times of arrival are inaccurate, as the host polls. The period of the readings is therefore averaged over the
    last second, and the speed is computed from the ticks of about the last 50 ms and the number of readings in it.
    """

    def __init__(self, ticks_per_m: float) -> None:
        self._ticks_per_m = ticks_per_m
        self._readings: deque[tuple[int, int, int]] = deque()

    def reset(self) -> None:
        """Forget all readings."""
        self._readings.clear()

    def step(self, count: int, ticks: int, now_ns: int) -> float | None:
        """Process the newest reading, number `count`, at `now_ns`; gives the speed, or None in the first 200 ms."""
        readings = self._readings
        if readings and now_ns - readings[-1][0] > _GAP_NS:
            readings.clear()
        readings.append((now_ns, count, ticks))
        while now_ns - readings[1 if len(readings) > 1 else 0][0] >= _PERIODIC_NS:
            readings.popleft()
        first_ns, first_count, _ = readings[0]
        if now_ns - first_ns < _PERIODIC_MIN_NS or count == first_count:
            return None
        period_ns = (now_ns - first_ns) / (count - first_count)
        for _, before, ticks_before in reversed(readings):
            elapsed_ns = (count - before) * period_ns
            if elapsed_ns >= _WINDOW_NS:
                return (ticks - ticks_before) / self._ticks_per_m / (elapsed_ns * 1e-9)
        return None
