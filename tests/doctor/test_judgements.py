"""What the doctor makes of what it measured: every limit from both sides, every figure from a construction."""

from __future__ import annotations

import dataclasses
import datetime
from typing import Any

import cv2
import numpy as np
import pytest

from automodel.config import (
    CalibrationRecord,
    CalibrationRecords,
    CarConfig,
    Intrinsics,
    RecordingConfig,
    SafetyConfig,
    parse_car,
)
from automodel.config.camera import SecondCamera
from automodel.doctor import board as board_health
from automodel.doctor import machine
from automodel.doctor.board import Listened
from automodel.doctor.camera import (
    Capture,
    blur_px,
    judge_exposure,
    judge_rate,
    judge_resolution,
    judge_sharpness,
    judge_stamps,
    judge_width,
    line_distance_m,
)
from automodel.doctor.examination import judge_lens, judge_mode, judge_records, judge_steering
from automodel.doctor.findings import Finding, Verdict, failed, summary
from automodel.signals import Frame, VehicleState
from tests.support.fake_cars import road

OK, WARN, FAIL, SKIP = Verdict.OK, Verdict.WARN, Verdict.FAIL, Verdict.SKIP
CAR = CarConfig()
REAL = parse_car('[camera]\nsource = "usb"\n[link]\nport = "/dev/ttyUSB0"\n', "car.toml")
ROAD = road()


def flat(level: float, noise: float = 2.0) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.clip(rng.normal(level, noise, (360, 640)), 0, 255).astype(np.uint8)


def test_a_warning_says_what_to_do() -> None:
    with pytest.raises(ValueError, match="x says WARN, but not what to do"):
        Finding(name="x", verdict=WARN, what="y")
    found = [Finding(name="x", verdict=v, what="y", do="z") for v in (OK, OK, WARN, SKIP)]
    assert summary(found) == "4 checks: 2 OK, 1 WARN, 1 SKIP"
    assert not failed(found)
    assert failed([*found, Finding(name="x", verdict=FAIL, what="y", do="z")])


@pytest.mark.parametrize(
    ("grey", "verdict", "said"),
    [
        (ROAD, OK, "grey levels"),
        (flat(4), FAIL, "black"),
        (flat(128), FAIL, "nothing is visible"),
        ((ROAD * 0.25).astype(np.uint8), WARN, "too dark"),
        (np.where(np.arange(360)[:, None] < 100, 255, ROAD).astype(np.uint8), WARN, "overexposed"),
        (np.where(np.arange(360)[:, None] < 200, 255, ROAD).astype(np.uint8), FAIL, "overexposed: 5"),
    ],
)
def test_exposure(grey: np.ndarray, verdict: Verdict, said: str) -> None:
    found = judge_exposure(grey)
    assert (found.verdict, said in found.what) == (verdict, True), found


@pytest.mark.parametrize("sigma", [1.5, 2.0, 3.0])
@pytest.mark.parametrize("contrast", [60, 180])
def test_the_blur_of_a_known_edge(sigma: float, contrast: int) -> None:
    """Steps far apart, blurred by a Gaussian and seen through noise: the variances of blur and smoothing add up."""
    bars = np.where(np.arange(640) // 80 % 2, 40 + contrast, 40) + np.zeros((360, 1))
    seen = cv2.GaussianBlur(bars, (0, 0), sigma) + np.random.default_rng(1).normal(0, 1, bars.shape)
    found = blur_px(seen.astype(np.uint8))
    assert found == pytest.approx(np.hypot(sigma, 0.7), rel=0.12)


def test_sharpness_of_a_road_and_of_one_out_of_focus() -> None:
    assert judge_sharpness(ROAD).verdict is OK
    blurred = [judge_sharpness(np.asarray(cv2.GaussianBlur(ROAD, (0, 0), s))) for s in (2.2, 5.0)]
    assert [found.verdict for found in blurred] == [WARN, FAIL]
    assert judge_sharpness(flat(128, 4)).verdict is SKIP
    assert judge_sharpness(np.zeros((8, 8), np.uint8)).verdict is SKIP


def captured(steps_ms: list[float], images: list[np.ndarray] | None = None) -> Capture:
    capture = Capture()
    stamps = np.cumsum([1000.0, *steps_ms])
    for index, t_ms in enumerate(stamps):
        image = ROAD + np.uint8(index % 2) if images is None else images[index % len(images)]
        capture.add(Frame(t_ns=round(t_ms * 1e6), index=index, image=image), keep=5)
    return capture


@pytest.mark.parametrize(
    ("steps_ms", "verdict"),
    [
        ([1000 / 60] * 60, OK),
        ([1000 / 56] * 60, OK),
        ([1000 / 50] * 50, WARN),
        ([1000 / 90] * 90, WARN),
        ([1000 / 25] * 25, FAIL),
        ([1000 / 60] * 58 + [61], WARN),
        ([0.0] * 20, FAIL),
        ([], FAIL),
    ],
)
def test_rate(steps_ms: list[float], verdict: Verdict) -> None:
    assert judge_rate(captured(steps_ms), CAR).verdict is verdict


def test_a_camera_that_is_slower_than_the_timeout_fails_even_where_car_toml_says_so() -> None:
    slow = dataclasses.replace(CAR, camera=dataclasses.replace(CAR.camera, rate_hz=15.0))
    found = judge_rate(captured([1000 / 15] * 15), slow)
    assert (found.verdict, "frame_timeout_s above 0.100" in found.do) == (FAIL, True)
    waiting = dataclasses.replace(slow, safety=SafetyConfig(frame_timeout_s=0.1))
    assert judge_rate(captured([1000 / 15] * 15), waiting).verdict is OK


def test_stamps_and_pictures() -> None:
    assert judge_stamps(captured([16.7] * 10)).verdict is OK
    assert judge_stamps(captured([16.7] * 10, [ROAD])).verdict is WARN
    assert judge_stamps(captured([16.7, -1.0, 16.7])).verdict is FAIL
    assert judge_stamps(captured([])).verdict is FAIL
    assert len(captured([16.7] * 10).frames) == 5


def test_resolution() -> None:
    assert judge_resolution(captured([16.7]), CAR).verdict is OK
    found = judge_resolution(captured([16.7], [ROAD[:, :320]]), CAR)
    assert (found.verdict, found.what) == (FAIL, "expected 640x360 pixels as in car.toml, got 320x360")


@pytest.mark.parametrize("curvature_per_m", [0.0, 0.8])
@pytest.mark.parametrize("heading_rad", [0.0, 0.2])
def test_distance_of_two_lines(curvature_per_m: float, heading_rad: float) -> None:
    """Points of two concentric circles about one centre, turned and shifted; some points are far off."""
    rng = np.random.default_rng(2)
    lines = []
    for offset_m, n in ((0.2, 14), (-0.2, 9)):
        s = rng.uniform(0.3, 1.2, n)
        if curvature_per_m:
            radius = 1.0 / curvature_per_m - offset_m
            x, y = radius * np.sin(s * curvature_per_m), 1.0 / curvature_per_m - radius * np.cos(s * curvature_per_m)
        else:
            x, y = s, np.full(n, offset_m)
        c, si = np.cos(heading_rad), np.sin(heading_rad)
        lines.append(np.stack((c * x - si * y, si * x + c * y + 0.03), axis=1) + rng.normal(0, 0.001, (n, 2)))
    lines[0][3, 1] += 0.15
    assert line_distance_m(*lines) == pytest.approx(0.4, rel=0.02)
    assert line_distance_m(lines[0], lines[1][:2]) is None
    assert line_distance_m(np.tile(lines[0][:1], (5, 1)), np.tile(lines[1][:1], (5, 1))) is None


@pytest.mark.parametrize(
    ("seen_m", "verdict"), [(0.40, OK), (0.43, OK), (0.44, WARN), (0.36, WARN), (0.51, FAIL), (0.29, FAIL)]
)
def test_width(seen_m: float, verdict: Verdict) -> None:
    assert judge_width([seen_m] * 5 + [2.0], CAR).verdict is verdict
    assert judge_width([seen_m] * 4, CAR).verdict is SKIP


def test_calibrations() -> None:
    today = datetime.date(2026, 6, 1)

    def found(days: int) -> Finding:
        record = CalibrationRecord(date=today - datetime.timedelta(days), method="board", residual="0.4 px")
        car = dataclasses.replace(REAL, calibration=CalibrationRecords(ground=record))
        camera, ground, servo, odometry = judge_records(car, today)
        assert {camera.verdict, servo.verdict, odometry.verdict} == {WARN}
        assert camera.do == "automodel calibrate camera"
        return ground

    assert [found(days).verdict for days in (0, 180, 181, -1)] == [OK, OK, WARN, WARN]
    assert found(3).what == "2026-05-29 by board: 0.4 px"
    assert [f.verdict for f in judge_records(CAR, today)] == [SKIP]
    pair = dataclasses.replace(REAL, camera=dataclasses.replace(REAL.camera, right=SecondCamera(device=1)))
    assert "automodel calibrate stereo" in [found.do for found in judge_records(pair, today)]


@pytest.mark.parametrize(
    ("lens", "verdict"),
    [
        ({"fx_px": 500.0, "fy_px": 501.0}, OK),
        ({}, WARN),  # the simulated camera's, in a real car
        ({"fx_px": 1000.0, "fy_px": 1000.0, "cx_px": 640.0, "cy_px": 360.0}, WARN),
        ({"fx_px": 4000.0, "fy_px": 4000.0}, WARN),
        ({"fx_px": 500.0, "fy_px": 400.0}, WARN),
    ],
)
def test_lens(lens: dict[str, Any], verdict: Verdict) -> None:
    car = dataclasses.replace(REAL, camera=dataclasses.replace(REAL.camera, intrinsics=Intrinsics(**lens)))
    assert judge_lens(car).verdict is verdict
    assert judge_lens(CAR).verdict is OK


def test_the_servo_must_reach_what_the_limits_allow() -> None:
    assert judge_steering(CAR).verdict is OK
    found = judge_steering(dataclasses.replace(CAR, safety=SafetyConfig(steering_max_rad=0.5)))
    assert (found.verdict, "steering_max_rad to 0.45" in found.do) == (WARN, True)


def listened(count: int = 50, damaged: int = 0, **values: object) -> Listened:
    states = tuple(VehicleState(t_ns=20_000_000 * i, **values) for i in range(count))  # type: ignore[arg-type]
    return Listened(states=states, span_s=1.0, damaged=damaged)


def test_board() -> None:
    assert [board_health.judge_reset(c).verdict for c in ("power_on", "brown_out", "watchdog")] == [OK, WARN, WARN]
    assert [board_health.judge_wire(x).verdict for x in (listened(), listened(20), listened(50, 9))] == [OK, WARN, WARN]
    assert board_health.judge_faults(listened()).verdict is OK
    assert board_health.judge_faults(listened(faults=("gyro_failed",))).what == "gyro_failed"
    volts = [board_health.judge_battery(listened(battery_v=v), CAR).verdict for v in (None, 0.2, 6.3, 6.4, 8.0)]
    assert volts == [SKIP, SKIP, WARN, OK, OK]


def test_ranges() -> None:
    def verdict(*ranges_m: float | None, car: CarConfig = REAL) -> Verdict:
        return board_health.judge_ranges(listened(ranges_m=ranges_m), car).verdict

    assert verdict(1.0, 1.0, 1.0) is OK
    assert verdict(1.0, None, 1.0) is WARN
    assert verdict(1.0, 0.2, 1.0) is WARN  # something stands in the way
    assert verdict(None, None, None) is WARN
    assert verdict() is WARN
    assert verdict(None, None, None, car=CAR) is OK
    now_and_then = Listened(
        states=(VehicleState(t_ns=0, ranges_m=(1.0, 1.0, None)), VehicleState(t_ns=1, ranges_m=(None, None, 1.0))),
        span_s=1.0,
        damaged=0,
    )
    assert board_health.judge_ranges(now_and_then, REAL).verdict is OK


def test_a_car_that_stands_must_say_so() -> None:
    motions = [(0.0, None), (0.0, 0.01), (0.1, 0.0), (0.0, 0.2), (None, None)]
    found = [board_health.judge_motion(listened(speed_mps=v, yaw_rate_radps=w)).verdict for v, w in motions]
    assert found == [OK, OK, WARN, WARN, OK]


def test_what_the_servo_was_asked_for() -> None:
    assert board_health.judge_followed((0.2, -0.2), (0.21, -0.2)).verdict is OK
    assert board_health.judge_followed((0.2, -0.2), (0.2, 0.0)).verdict is FAIL
    assert board_health.judge_followed((0.2,), (None,)).verdict is FAIL


def test_packages() -> None:
    lines = ["numpy>=1.26", "tomlkit >= 0.12", 'tomli>=2.0; python_version < "3.11"', 'torch>=2; extra == "train"']
    wanted = machine.wanted_packages(lines)
    assert wanted == {"numpy": "1.26", "tomlkit": "0.12"}
    assert machine.wanted_packages(lines, frozenset({"train"})) == {**wanted, "torch": "2"}
    assert machine.needed_extras(CAR) == {"centerline"}
    can = parse_car('[link]\nkind = "can"\n[pipeline]\nname = "windows"\n', "car.toml")
    assert machine.needed_extras(can) == {"can"}

    def verdict(numpy: str | None) -> Verdict:
        return machine.judge_packages(wanted, {"numpy": numpy, "tomlkit": "0.13.2"}).verdict

    assert [verdict(v) for v in ("1.26", "1.26.0rc1", "2.0", "1.3", "1.9.9", None)] == [OK, OK, OK, FAIL, FAIL, FAIL]


def test_opencv_and_gstreamer() -> None:
    build = "  Video I/O:\n    FFMPEG:      {}\n    v4l/v4l2:     {} (linux/videodev2.h)\n"
    cases = [
        ("YES", "YES", "usb", OK),
        ("NO", "YES", "usb", WARN),
        ("YES", "NO", "usb", FAIL),
        ("YES", "NO", "csi", OK),
    ]
    for ffmpeg, v4l, source, verdict in cases:
        assert machine.judge_opencv("5.0", build.format(ffmpeg, v4l), source).verdict is verdict
    there = [(True, True), (True, False), (False, False)]
    assert [machine.judge_gstreamer(a, b, "csi").verdict for a, b in there] == [OK, FAIL, FAIL]
    assert [machine.judge_gstreamer(a, b, "usb").verdict for a, b in there] == [OK, OK, OK]


def test_scheduling() -> None:
    assert machine.judge_scheduling(4, ()).verdict is OK
    assert machine.judge_scheduling(1, ("the loop waits",)).verdict is Verdict.SKIP
    found = machine.judge_scheduling(4, ("the loop waits", "memory may be swapped out"))
    assert (found.verdict, "nice -15" in found.do) == (WARN, True)
    assert found.what == "the loop waits; memory may be swapped out"


def test_clock() -> None:
    day = datetime.date(2026, 3, 1)
    assert machine.judge_clock(day, day, 1e-9, 0).verdict is OK
    assert machine.judge_clock(datetime.date(1970, 1, 1), day, 1e-9, 0).verdict is WARN
    assert machine.judge_clock(day, day, 0.01, 0).verdict is FAIL
    assert machine.judge_clock(day, day, 1e-9, 1).verdict is FAIL


def test_disk() -> None:
    needed = machine.recording_bytes_per_s(CAR.camera, RecordingConfig(), 100_000)
    assert needed == 6e6
    assert machine.recording_bytes_per_s(CAR.camera, RecordingConfig(), None) == pytest.approx(640 * 360 * 0.2 * 60)

    def verdict(minutes: float, mbps: float) -> Verdict:
        return machine.judge_disk("x", round(minutes * 60 * needed), mbps * 1e6, needed).verdict

    assert [verdict(60, 100), verdict(10, 100), verdict(1, 100)] == [OK, WARN, FAIL]
    assert [verdict(60, 7), verdict(60, 5)] == [WARN, FAIL]


def test_whose_times_the_stamps_are() -> None:
    capture = captured([16.7] * 10)
    for own, latency_s, verdict in ((True, 0.0, OK), (False, 0.0, WARN), (False, 0.03, OK), (None, 0.0, OK)):
        capture.own_time = own
        assert judge_stamps(capture, latency_s).verdict is verdict
    assert "less 30 ms" in judge_stamps(dataclasses.replace(capture, own_time=False), 0.03).what


@pytest.mark.parametrize(
    ("camera", "mode", "verdict", "said"),
    [
        ('source = "csi"\nsensor_mode = 4', "csi 640x360, sensor mode 4", OK, "78% of its width"),
        (
            'source = "csi"\nsensor_mode = 4',
            "csi 640x360, sensor mode 3",
            FAIL,
            "was calibrated for csi 640x360, sensor",
        ),
        ('source = "csi"\nsensor_mode = 4', "", OK, "does not say for which"),
        ('source = "csi"', None, WARN, "the driver's sensor mode"),
        ('source = "csi"\nsensor_mode = 2', None, WARN, "up to 30 Hz"),
        ('source = "csi"\nsensor_mode = 3\nrate_hz = 30', None, WARN, "1640x1232"),
        ('source = "csi"\nsensor_mode = 3\nrate_hz = 30\nheight_px = 480', None, OK, "1640x1232"),
        ('source = "csi"\nsensor_mode = 9', None, OK, "sensor mode 9"),  # of another sensor
        ('source = "usb"', None, OK, "usb 640x360"),
        ('source = "sim"', None, SKIP, "simulated"),
    ],
)
def test_camera_mode(camera: str, mode: str | None, verdict: Verdict, said: str) -> None:
    text = f"[camera]\n{camera}\n"
    if mode is not None:
        text += f'[calibration.camera]\ndate = 2026-01-01\nmethod = "x"\nresidual = "y"\nmode = "{mode}"\n'
    found = judge_mode(parse_car(text, "car.toml"))
    assert (found.verdict, said in found.what) == (verdict, True), found


def test_the_right_camera_s_mode_is_the_one_that_it_was_calibrated_for() -> None:
    text = '[camera]\nsource = "usb"\n[camera.right]\nflip = "vertical"\n[calibration.stereo]\ndate = 2026-01-01\n'
    text += 'method = "x"\nresidual = "y"\nmode = "usb 640x360, the driver\'s sensor mode'
    assert judge_mode(parse_car(f'{text}, flip vertical"\n', "car.toml")).verdict is OK
    found = judge_mode(parse_car(f'{text}"\n', "car.toml"))
    assert found.verdict is FAIL
    assert "flip vertical, and the right camera was calibrated for usb 640x360" in found.what
    assert "automodel calibrate stereo" in found.do
