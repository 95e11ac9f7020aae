"""The delay of a camera from a blinking light: constructed, and asked for back."""

from __future__ import annotations

import dataclasses
import io
import sys
from pathlib import Path

import numpy as np
import pytest

from automodel.config import CarConfig, parse_car
from automodel.doctor.findings import Verdict
from automodel.doctor.latency import Blinking, judge_latency, latency_finding, led, screen, stamp_delay
from tests.support.blinking import blinking

CAR = parse_car('[camera]\nsource = "usb"\nlatency_s = 0.01\n[link]\nport = "x"\n', "car.toml")


@pytest.mark.parametrize("late_s", [-0.02, 0.0, 0.0173, 0.05, 0.12, 0.31])
@pytest.mark.parametrize("exposure_s", [0.001, 0.008, 0.016])
@pytest.mark.parametrize("rate_hz", [30.0, 60.0])
def test_a_constructed_delay_is_found(late_s: float, exposure_s: float, rate_hz: float) -> None:
    found = [stamp_delay(blinking(late_s, exposure_s=exposure_s, rate_hz=rate_hz, seed=seed)) for seed in range(5)]
    errors_s = [delay.late_s - late_s for delay in found if delay is not None]
    assert len(errors_s) == 5
    assert max(map(abs, errors_s)) < 0.1 / rate_hz  # a tenth of a period
    assert abs(np.mean(errors_s)) < 0.05 / rate_hz
    assert all(delay.sigma_s < 0.1 / rate_hz and delay.correlation > 0.9 for delay in found if delay is not None)


def test_nothing_is_found_where_nothing_blinks() -> None:
    seen = blinking(0.05)
    dark = np.delete(seen.levels, (7, 8), axis=1)
    assert stamp_delay(dataclasses.replace(seen, levels=dark)) is None
    assert stamp_delay(dataclasses.replace(seen, levels=np.full_like(seen.levels, 7.0))) is None
    assert stamp_delay(Blinking(switched_ns=[1], stamps_ns=[1, 2], levels=np.zeros((2, 3)))) is None
    found = judge_latency(dataclasses.replace(seen, levels=dark), CAR, "screen")
    assert (found.verdict, found.what) == (Verdict.WARN, "no part of the picture blinks with screen")


def test_the_result_is_what_car_toml_needs() -> None:
    found = judge_latency(blinking(0.05), CAR, "led0")
    assert found.verdict is Verdict.WARN
    wanted = float(found.do.partition("latency_s = ")[2].split()[0])
    assert wanted == pytest.approx(0.06, abs=0.002)  # 10 ms are taken off already
    assert judge_latency(blinking(0.002), CAR, "led0").verdict is Verdict.OK
    own = judge_latency(blinking(0.05, own_time=True), CAR, "screen")
    assert (own.verdict, "own times are off" in own.do, "screen's own delay" in own.what) == (Verdict.WARN, True, True)
    early = judge_latency(blinking(-0.03), CAR, "led0")  # the latency of car.toml was too large
    assert "set [camera] latency_s = 0.000" in early.do


def test_an_led_shows_afterwards_what_it_showed_before(tmp_path: Path) -> None:
    for name, text in (("trigger", "none [mmc0] timer"), ("brightness", "1"), ("max_brightness", "255")):
        (tmp_path / name).write_text(text)
    with led(tmp_path) as light:
        assert (tmp_path / "trigger").read_text() == "none"
        light(True)
        assert (tmp_path / "brightness").read_text() == "255"
        light(False)
        assert (tmp_path / "brightness").read_text() == "0"
    assert (tmp_path / "trigger").read_text() == "mmc0"
    assert (tmp_path / "brightness").read_text() == "1"


def test_a_terminal_turns_bright_and_is_left_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    said = io.StringIO()
    monkeypatch.setattr(said, "isatty", lambda: True)
    monkeypatch.setattr(sys, "stdout", said)
    with screen() as light:
        light(True)
    assert said.getvalue() == "\x1b[?5h\x1b[?5l"


def test_a_simulated_camera_is_not_looked_at() -> None:
    assert latency_finding(CarConfig(), lambda: pytest.fail("opened"), "screen").verdict is Verdict.SKIP
