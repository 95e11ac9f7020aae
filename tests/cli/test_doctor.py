"""`doctor` as a user runs it: with no hardware, with a board on a pseudo terminal, with cameras that are not well."""

from __future__ import annotations

import dataclasses
import io
import os
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from automodel.assembly.simulated_car import Simulation, build_world
from automodel.cli import doctor
from automodel.config import load_car
from automodel.doctor import board as doctor_board
from automodel.doctor import camera as doctor_camera
from automodel.doctor import examination
from automodel.signals import BoardSensors, Frame
from automodel.sources import csi, usb
from firmware_link import arduino
from firmware_link.emulator import logic
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.emulator.logic import BoardOptions
from firmware_link.emulator.pty import BenchPeripherals, PtyBoard
from tests.support.blinking import BlinkingCamera
from tests.support.command_line import Said
from tests.support.fake_cars import StillCamera, TriggeredCamera, road
from tests.support.fake_cars import car_toml as written
from tests.support.wide_limits import WIDE_LIMITS

COMPUTER = ["temperature", "power mode", "supply", "service"]
MACHINE = ["python", "scheduling", "packages", "opencv", "gstreamer", "network", "clock", *COMPUTER]
BOARD = ["serial port", "board", "board start", "wire", "board faults", "battery", "ranges", "odometry", "servo", "can"]
CAMERA = ["camera", "resolution", "time stamps", "frame rate", "exposure", "sharpness", "lane width"]
FILE = ["disk", "lens", "camera mode", "servo table"]
CALIBRATIONS = ["camera calibration", "ground calibration", "servo calibration", "odometry calibration"]


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Short looks, patience with a loaded machine, and a folder of its own for the disk's test."""
    monkeypatch.setattr(logic, "COMMAND_TIMEOUT_MS", 3000)
    monkeypatch.setattr(arduino, "_SILENT_NS", 3_000_000_000)
    monkeypatch.setattr(doctor_camera, "SETTLING_S", 0.05)
    monkeypatch.setattr(doctor_camera, "LOOKING_S", 0.3)
    monkeypatch.setattr(doctor_board, "LISTENING_S", 0.3)
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def bench() -> BenchPeripherals:
    peripherals = BenchPeripherals()
    peripherals.sensors = BoardSensors(ranges_m=(1.0, 2.0, 0.5), wheel_ticks=0, battery_v=7.4, yaw_rate_radps=0.01)
    return peripherals


@pytest.fixture
def port(bench: BenchPeripherals) -> Iterator[PtyBoard]:
    with PtyBoard(EmulatedArduino(bench, 115200, BoardOptions(boot_ns=50_000_000, limits=WIDE_LIMITS))) as board:
        yield board


def car_toml(folder: Path, port: str) -> Path:
    """With the pipeline that needs no network: those of the defaults are looked at without a car."""
    path = written(folder, port)
    path.write_text(f'{path.read_text()}[pipeline]\nname = "windows"\n')
    return path


class LiveCamera(StillCamera):
    """As a sensor sees: no two pictures are the same."""

    def read(self, timeout_s: float) -> Frame:
        frame = super().read(timeout_s)
        noise = np.random.default_rng(frame.index).integers(-2, 3, frame.image.shape)
        return Frame(t_ns=frame.t_ns, index=frame.index, image=np.clip(frame.image + noise, 0, 255).astype(np.uint8))


class Terminal(io.StringIO):
    """A person sits there."""

    def isatty(self) -> bool:
        return True


def show(monkeypatch: pytest.MonkeyPatch, image: np.ndarray, **how: int) -> None:
    monkeypatch.setattr(examination, "make_camera", lambda car, any_mode: LiveCamera(image, **how))


def by_name(said: Said) -> dict[str, dict[str, object]]:
    rows = {str(row["check"]): row for row in said.rows}
    assert len(rows) == len(said.rows)
    assert all(row["do"] for row in rows.values() if row["verdict"] in ("WARN", "FAIL"))
    return rows


def of(said: Said, *names: str) -> list[object]:
    rows = by_name(said)
    return [rows[name]["verdict"] for name in names]


def test_without_a_car_all_is_well_with_the_simulated_one(cli, tmp_path: Path) -> None:
    said = cli("doctor", "--json")
    assert said.err == "without --car: this machine, and the simulated car\n"
    rows = by_name(said)
    assert list(rows) == [*MACHINE[:5], "providers", *MACHINE[5:], *BOARD, *CAMERA, *FILE, "calibration"]
    not_well = {name for name, row in rows.items() if row["verdict"] not in ("OK", "SKIP")}
    assert not_well <= {"network", "disk", *COMPUTER}  # of a machine that is slow or full
    assert of(said, *CAMERA) == ["OK"] * len(CAMERA)
    assert "0.40 m in car.toml" in str(rows["lane width"]["what"]).replace("0.400", "0.40")
    assert list(tmp_path.iterdir()) == []


def test_the_report_is_plain_and_fits_80_columns(cli, tmp_path: Path) -> None:
    (tmp_path / "car.toml").write_text('[pipeline]\nname = "windows"\n')
    said = cli("doctor", "--car", "car.toml", "--move")
    assert all(len(line) <= 80 for line in said.out.splitlines() if str(tmp_path) not in line)
    *lines, last = (line for line in said.out.splitlines() if not line.startswith(" "))
    assert last.startswith(f"{len(lines)} checks: ")
    assert {line.split()[0] for line in lines} <= {"OK", "WARN", "FAIL", "SKIP"}
    assert "\x1b" not in said.out
    (servo,) = (line for line in lines if "servo  " in line)
    assert servo.startswith("OK")  # nobody need agree to what is only simulated
    assert said.code == int(any(line.startswith("FAIL") for line in lines))


@pytest.mark.realtime
def test_a_whole_car(cli, port: PtyBoard, bench: BenchPeripherals, tmp_path: Path, monkeypatch) -> None:
    show(monkeypatch, road())
    said = cli("doctor", "--car", car_toml(tmp_path, port.path), "--json")
    rows = by_name(said)
    assert list(rows) == [*MACHINE, *BOARD, *CAMERA, *FILE, *CALIBRATIONS]
    well = [*BOARD[:-2], "camera", "resolution", "time stamps", "exposure", "sharpness", "lane width"]
    assert {name: rows[name]["verdict"] for name in well} == dict.fromkeys(well, "OK")
    assert of(said, "servo", "lens", *CALIBRATIONS) == ["SKIP", *["WARN"] * 5]
    assert {pulses[1:] for pulses in bench.pulses} == {(1500.0, 1500.0)}  # nothing moved
    assert not (tmp_path / "recordings").exists()


PAIR = """
[camera.extrinsics]
y_m = 0.125
[camera.right]
device = 1
[camera.right.intrinsics]
fx_px = 480.1
[camera.right.extrinsics]
y_m = -0.125
"""


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("late_ms", "swapped", "repeats", "verdicts"),
    [
        (3, False, False, ["OK", "OK", "OK"]),
        (3, True, False, ["OK", "FAIL", "OK"]),
        (25, False, False, ["FAIL", None, None]),  # they take turns
        (3, False, True, ["FAIL", None, None]),
    ],
)
def test_two_cameras(
    late_ms: int, swapped: bool, repeats: bool, verdicts: list[str | None],
    cli, port: PtyBoard, tmp_path: Path, monkeypatch
) -> None:  # fmt: skip
    path = car_toml(tmp_path, port.path)
    path.write_text(path.read_text().replace('source = "usb"', 'source = "usb"\nrate_hz = 20') + PAIR)
    images = build_world(load_car(path), Simulation(track="chicane", style="clean")).capture(0, 0)[0]
    images = images[::-1] if swapped else images

    class Camera(TriggeredCamera):
        def read(self, timeout_s: float) -> Frame:
            frame = super().read(timeout_s)
            return dataclasses.replace(frame, image=self._image) if repeats and self._late_ns else frame

    monkeypatch.setattr(
        usb, "UsbSource", lambda camera: Camera(images[camera.device], 20.0, late_ms * 1_000_000 * camera.device)
    )
    monkeypatch.setattr(doctor_camera, "FIRST_S", 2.0)
    said = cli("doctor", "--car", path, "--json")
    rows = by_name(said)
    found = [
        rows[name]["verdict"] if name in rows else None for name in ("camera pair", "camera order", "pair calibration")
    ]
    assert found == verdicts
    assert said.code == int("FAIL" in verdicts)
    if verdicts[1] is not None:
        assert rows["camera"]["what"].startswith("/dev/video0 and /dev/video1 open, first frame")  # type: ignore[attr-defined]
        assert rows["right lens"]["verdict"] == "OK"


@pytest.mark.realtime
def test_the_servo_moves_on_consent_and_the_motor_never(
    cli, port: PtyBoard, bench: BenchPeripherals, tmp_path: Path, monkeypatch
) -> None:
    show(monkeypatch, road())
    said = cli("doctor", "--car", car_toml(tmp_path, port.path), "--move", "--yes", "--json")
    assert of(said, "servo") == ["OK"]
    servo = [pulses[1] for pulses in bench.pulses]
    assert (min(servo), max(servo), servo[-1]) == (1275.0, 1725.0, 1500.0)  # half of 0.45 rad each way
    assert servo.index(1275.0) < servo.index(1725.0)  # left first
    assert {pulses[2] for pulses in bench.pulses} == {1500.0}
    assert isinstance(port.board, EmulatedArduino)
    assert not port.board.armed


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("answers", "verdict", "moved"),
    [([False], "SKIP", False), ([True, True], "OK", True), ([True, False], "FAIL", True), (None, "SKIP", False)],
)
def test_who_is_asked_decides(
    answers, verdict: str, moved: bool, cli, port: PtyBoard, bench: BenchPeripherals, tmp_path: Path, monkeypatch
) -> None:
    show(monkeypatch, road())
    given = iter(answers or [])
    monkeypatch.setattr(doctor, "_ask", lambda question: next(given))
    monkeypatch.setattr("sys.stdin", None if answers is None else Terminal())
    said = cli("doctor", "--car", car_toml(tmp_path, port.path), "--move", "--json")
    assert of(said, "servo") == [verdict]
    assert next(given, None) is None
    assert (max(pulses[1] for pulses in bench.pulses) > 1500.0) is moved


@pytest.mark.realtime
def test_a_board_that_vanishes_while_the_servo_moves(
    cli, port: PtyBoard, bench: BenchPeripherals, tmp_path: Path, monkeypatch
) -> None:
    show(monkeypatch, road())

    def pull() -> None:
        while not any(pulses[1] < 1400.0 for pulses in list(bench.pulses)):
            time.sleep(0.01)
        port.unplug()

    person = threading.Thread(target=pull, daemon=True)
    person.start()
    said = cli("doctor", "--car", car_toml(tmp_path, port.path), "--move", "--yes", "--json")
    person.join()
    assert said.code == 1
    rows = by_name(said)
    assert rows["servo"]["verdict"] == "FAIL"
    assert "disappeared" in str(rows["servo"]["what"])
    assert rows["camera"]["verdict"] == "OK"  # the others were looked at all the same


@pytest.mark.realtime
def test_a_black_picture_fails(cli, port: PtyBoard, tmp_path: Path, monkeypatch) -> None:
    show(monkeypatch, np.zeros((360, 640), np.uint8))
    said = cli("doctor", "--car", car_toml(tmp_path, port.path), "--json")
    assert said.code == 1
    assert of(said, "camera", "exposure", "sharpness", "lane width") == ["OK", "FAIL", "SKIP", "SKIP"]


@pytest.mark.realtime
def test_no_device_at_all(cli, tmp_path: Path) -> None:
    said = cli("doctor", "--car", car_toml(tmp_path, "/dev/ttyMISSING"), "--move", "--yes", "--json")
    assert said.code == 1
    rows = by_name(said)
    assert rows["serial port"]["what"] == "/dev/ttyMISSING: no such port"
    assert "[link] port" in str(rows["serial port"]["do"])
    assert "/dev/video0: cannot be opened" in str(rows["camera"]["what"])
    assert "here are: " in str(rows["camera"]["do"])
    assert of(said, "serial port", "camera") == ["FAIL", "FAIL"]
    assert of(said, "board", "servo", "images") == ["SKIP"] * 3


@pytest.mark.realtime
def test_a_camera_that_dies_and_a_board_that_is_silent(cli, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(arduino, "_HELLO_TIMEOUT_NS", 100_000_000)
    show(monkeypatch, road(), dies_at=10)
    master, slave = os.openpty()
    try:
        said = cli("doctor", "--car", car_toml(tmp_path, os.ttyname(slave)), "--json")
    finally:
        os.close(master)
        os.close(slave)
    rows = by_name(said)
    assert of(said, "board", "camera") == ["FAIL", "FAIL"]
    assert "no Hello" in str(rows["board"]["what"])
    assert "flash it" in str(rows["board"]["do"])
    assert "no more frames" in str(rows["camera"]["what"])


@pytest.mark.realtime
def test_a_board_with_other_messages(cli, tmp_path: Path, monkeypatch) -> None:
    show(monkeypatch, road())
    options = BoardOptions(table_hash=0x1234, boot_ns=50_000_000)
    with PtyBoard(EmulatedArduino(BenchPeripherals(), 115200, options)) as board:
        said = cli("doctor", "--car", car_toml(tmp_path, board.path), "--json")
    board_row = by_name(said)["board"]
    assert board_row["verdict"] == "FAIL"
    assert "message table 0x1234" in str(board_row["what"])
    assert "flash the matching firmware" in str(board_row["do"])


def test_an_autonomos_car_is_warned_of(cli, tmp_path: Path) -> None:
    (tmp_path / "car.toml").write_text('[link]\nkind = "autonomos"\n[pipeline]\nname = "windows"\n')
    said = cli("doctor", "--car", "car.toml", "--move", "--json")
    assert of(said, "board", "servo") == ["WARN", "OK"]
    assert "drives on" in str(by_name(said)["board"]["what"])


def test_pictures_in_a_folder_are_looked_at(cli, tmp_path: Path) -> None:
    (tmp_path / "seen").mkdir()
    for number in range(12):
        cv2.imwrite(f"{tmp_path}/seen/{number}.png", cv2.GaussianBlur(road(), (0, 0), 2.3) + np.uint8(number % 2))
    (tmp_path / "car.toml").write_text(
        '[camera]\nsource = "seen"\nrate_hz = 20\n[link]\nport = "none"\n[pipeline]\nname = "windows"\n'
    )
    said = cli("doctor", "--car", "car.toml", "--json")
    assert of(said, "car.toml", "resolution", "frame rate", "exposure", "sharpness") == [
        "WARN",
        "OK",
        "OK",
        "OK",
        "WARN",
    ]


@pytest.mark.realtime
@pytest.mark.skipif(shutil.which("gst-launch-1.0") is None, reason="needs GStreamer")
def test_a_csi_camera_by_gstreamers_test_picture(cli, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(csi, "jetson_elements", csi.synthetic_elements)
    text = '[camera]\nsource = "csi"\nrate_hz = 30\n[link]\nport = "none"\n[pipeline]\nname = "windows"\n'
    (tmp_path / "car.toml").write_text(text)
    said = cli("doctor", "--car", "car.toml", "--json")
    assert of(said, "camera", "resolution") == ["OK", "OK"]
    assert by_name(said)["gstreamer"]["what"] == "gst-launch-1.0 yes, nvarguscamerasrc no"


@pytest.mark.realtime
def test_the_latency_of_a_camera_that_sees_an_led(cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The stand-in looks at the LED's file, and delivers what it saw 40 ms later."""
    folder = tmp_path / "led"
    folder.mkdir()
    for name, text in (("trigger", "none [mmc0] timer"), ("brightness", "3"), ("max_brightness", "255\n")):
        (folder / name).write_text(text)
    monkeypatch.setattr(examination, "make_camera", lambda car, any_mode: BlinkingCamera(folder / "brightness", 0.04))
    (tmp_path / "car.toml").write_text(
        '[camera]\nsource = "usb"\nwidth_px = 160\nheight_px = 90\n[link]\nport = "none"\n'
        '[pipeline]\nname = "windows"\n'
    )
    row = by_name(cli("doctor", "--car", "car.toml", "--latency", folder, "--json"))["camera latency"]
    assert row["verdict"] == "WARN"
    assert "set [camera] latency_s = 0.0" in str(row["do"])
    assert 0.03 < float(str(row["do"]).split("=")[1].split()[0]) < 0.1  # of a machine that is busy
    assert [(folder / name).read_text() for name in ("trigger", "brightness")] == ["mmc0", "3"]
    row = by_name(cli("doctor", "--car", "car.toml", "--latency", "nowhere", "--json"))["camera latency"]
    assert (row["verdict"], "nowhere" in str(row["what"])) == ("FAIL", True)
    row = by_name(cli("doctor", "--car", "car.toml", "--latency", "screen", "--json"))["camera latency"]
    assert (row["verdict"], row["what"]) == ("FAIL", "this is no terminal")


def test_a_folder_that_cannot_be_written(cli, tmp_path: Path) -> None:
    (tmp_path / "car.toml").write_text('[pipeline]\nname = "contour"\n[recording]\ndirectory = "/proc/recordings"\n')
    said = cli("doctor", "--car", "car.toml", "--json")
    assert of(said, "disk", "network") == ["FAIL", "SKIP"]
    assert "[recording] directory" in str(by_name(said)["disk"]["do"])


@pytest.mark.parametrize(
    ("arguments", "said_so"),
    [
        ("--yes", "automodel doctor: --yes: is for --move (see automodel doctor --help)"),
        (
            "--latency screen",
            "automodel doctor: --latency: needs --car, whose camera is looked at (see automodel doctor --help)",
        ),
        ("--car missing.toml", "automodel: missing.toml: no such file"),
    ],
)
def test_wrong_arguments(arguments: str, said_so: str, cli) -> None:
    said = cli("doctor", *arguments.split())
    assert (said.code, said.out, said.line()) == (2, "", said_so)
