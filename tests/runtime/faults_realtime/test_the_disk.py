"""A disk that is full: the car drives on without a recording, and stops as ever."""

from __future__ import annotations

import resource
import signal
from collections.abc import Callable

import pytest

from automodel.recording.recover import recover
from tests.support.realtime_rig import Car, emulated
from tests.support.realtime_stops import LAST_TURN_MS, check_stop, phase_ms

pytestmark = [pytest.mark.realtime, pytest.mark.slow, pytest.mark.timeout(120)]


def test_a_disk_that_is_full(make_car: Callable[..., Car]) -> None:
    """By the system's own limit of a file's size, which fails the same calls in the same place."""
    car = make_car(emulated)
    car.until_driving(press=True)
    (file,) = (car.folder / "recordings").glob("*.mcap")
    begun_bytes = file.stat().st_size  # before the first sync perhaps: nothing but the car's texts
    car.bench.until(lambda: file.stat().st_size > begun_bytes + (1 << 17), "it records no image")
    full_bytes = file.stat().st_size + 1000
    resource.prlimit(car.child.pid, resource.RLIMIT_FSIZE, (full_bytes, full_bytes))
    car.bench.until(lambda: file.stat().st_size >= full_bytes, "it records no longer")
    check_stop(car.bench, car.struck(lambda: car.kill(signal.SIGINT), phase_ms("disk")), LAST_TURN_MS)
    assert car.ended() in (0, 1)
    assert "stopped early: File too large; recover it with: automodel recover" in car.said
    assert recover(file).frames > 0
    car.bench.check_asked_for()
