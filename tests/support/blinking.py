"""A camera that looks at an LED's file, and blinking as a camera would see it."""

from __future__ import annotations

import time
from collections import deque
from pathlib import Path

import numpy as np

from automodel.doctor.latency import Blinking
from automodel.signals import Frame

PERIOD_S = 1.0 / 60.0


class BlinkingCamera:
    """Implements `Source`: the LED lights a part of the image; frames come `latency_s` after what they show."""

    own_time = False

    def __init__(self, brightness: Path, latency_s: float) -> None:
        self._brightness, self._latency_s = brightness, latency_s
        self._seen: deque[tuple[float, bool]] = deque()
        self._index = 0

    def read(self, timeout_s: float) -> Frame:
        while True:
            time.sleep(PERIOD_S)
            now_s = time.monotonic()
            self._seen.append((now_s, self._brightness.read_text().strip() == "255"))
            if now_s - self._seen[0][0] >= self._latency_s:
                break
        _, on = self._seen.popleft()
        image = np.random.default_rng(self._index).integers(60, 70, (90, 160)).astype(np.uint8)
        image[20:50, 40:90] += np.uint8(120 * on)
        self._index += 1
        return Frame(t_ns=time.monotonic_ns(), index=self._index, image=image)

    def close(self) -> None:
        pass


def blinking(
    late_s: float, *, exposure_s: float = 0.008, rate_hz: float = 60.0, seed: int = 0, own_time: bool = False
) -> Blinking:
    """What a camera sees of a light that is switched at random: exposed in the middle of `exposure_s`, with noise,
    an eighth of the frames lost, and stamped `late_s` after the middle of the exposure."""
    rng = np.random.default_rng(seed)
    switched_s = np.cumsum(rng.uniform(0.15, 0.4, 48))
    middles_s = np.arange(0.0, switched_s[-1] + 0.5, 1.0 / rate_hz) + rng.uniform(0.0, 1.0 / rate_hz)
    middles_s = middles_s[rng.uniform(size=len(middles_s)) > 0.125]
    steps_s = np.linspace(-0.5, 0.5, 101) * exposure_s
    lit = (np.searchsorted(switched_s, middles_s[:, None] + steps_s) % 2).mean(axis=1)
    levels = rng.normal(80.0, 2.0, (len(middles_s), 12))
    levels[:, 7] += 60.0 * lit
    levels[:, 8] += 15.0 * lit
    levels[:, 3] += 40.0 * np.sin(middles_s * 7.0)  # something else that changes
    return Blinking(
        switched_ns=[round(1e9 * (5.0 + t)) for t in switched_s],
        stamps_ns=[round(1e9 * (5.0 + t + late_s)) for t in middles_s],
        levels=levels,
        own_time=own_time,
    )
