"""`automodel run` with an AutoNOMOS car: simulated, and at a serial port."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from automodel.assembly import drive
from automodel.recording.reader import Recording
from automodel.signals import VehicleState
from firmware_link import autonomos
from firmware_link.emulator.autonomos import EmulatedAutonomos, EmulatedMotorController, EmulatedServoBoard, Pins
from firmware_link.emulator.pty import BenchPeripherals, PtyBoard
from tests.support.fake_cars import StillCamera, car_toml, road

RUN = ("run", "--track", "oval", "--pipeline", "windows")


@pytest.mark.slow
def test_a_lap_is_driven(cli) -> None:
    said = cli(*RUN, "--laps", "1", "--link", "autonomos", "--json")
    assert (said.code, said.err) == (0, "drove 1 lap and stayed in its lane\n")
    (row,) = said.rows
    assert (row["laps"], row["left_lane"], row["stops"]) == (1, 0, 0)
    assert row["mae_offset_m"] <= row["max_abs_offset_m"] <= 0.10


def test_the_kind_of_car_toml_chooses_the_board_and_what_it_says_is_recorded(cli, tmp_path: Path) -> None:
    car, recording = tmp_path / "car.toml", tmp_path / "run.mcap"
    car.write_text('[link]\nkind = "autonomos"\n')
    assert cli(*RUN, "--car", car, "--duration", "3", "--record", recording).code == 0
    states = [m.value for m in Recording(recording) if isinstance(m.value, VehicleState)]
    assert states[-1].armed
    assert states[-1].faults == ()
    assert states[-1].speed_mps == pytest.approx(1.0, abs=0.15)
    assert (states[-1].battery_v, states[-1].yaw_rate_radps) == (None, None)  # this car does not say


def test_the_same_seed_gives_the_same_run_to_the_last_bit(cli, tmp_path: Path) -> None:
    truths = []
    for name in ("one.csv", "two.csv"):
        arguments = ["--duration", "2", "--seed", "3", "--link", "autonomos"]
        assert cli(*RUN, *arguments, "--truth", tmp_path / name).code == 0
        truths.append((tmp_path / name).read_bytes())
    assert truths[0] == truths[1]


class Board2015:
    """Two boards, two ports."""

    def __init__(self) -> None:
        self.peripherals = BenchPeripherals()
        pins = Pins(self.peripherals)
        self.servo, self.motor = PtyBoard(EmulatedServoBoard(pins)), PtyBoard(EmulatedMotorController(pins))
        self.ports = (self.servo, self.motor)


class Board2017:
    """One board, one port."""

    def __init__(self) -> None:
        self.peripherals = BenchPeripherals()
        self.servo = PtyBoard(EmulatedAutonomos(self.peripherals))
        self.ports = (self.servo,)


@pytest.fixture(params=[Board2017, Board2015], ids=["2017", "2015"])
def boards(request: pytest.FixtureRequest) -> Iterator[Board2017 | Board2015]:
    boards = request.param()
    for port in boards.ports:
        port.start()
    yield boards
    for port in boards.ports:
        port.close()


def car_file(folder: Path, boards: Board2017 | Board2015) -> Path:
    path = car_toml(folder, boards.servo.path)
    motor = boards.ports[1].path if len(boards.ports) > 1 else ""
    text = path.read_text().replace("[safety]", f'kind = "autonomos"\nautonomos.motor_port = "{motor}"\n[safety]')
    path.write_text(text)
    return path


@pytest.mark.realtime
@pytest.mark.slow
def test_a_real_car_drives_and_is_stopped_at_the_end(
    boards: Board2017 | Board2015, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cli
) -> None:
    image = road()
    monkeypatch.setattr(drive, "make_camera", lambda car: StillCamera(image))
    peripherals = boards.peripherals
    for _ in range(3):  # a machine that does something else for a while stops the car, rightly
        arguments = ("--pipeline", "windows", "--arm", "--duration", "5", "--record", tmp_path / "run.mcap")
        (tmp_path / "run.mcap").unlink(missing_ok=True)
        said = cli("run", "--car", car_file(tmp_path, boards), *arguments, "--json")
        if any(motor_us > 1520.0 for _, _, motor_us in peripherals.pulses):
            break
    assert any(motor_us > 1520.0 for _, _, motor_us in peripherals.pulses), said.err
    for port in boards.ports:
        port.close()
    assert peripherals.at_pins == (0.0, 1500.0)  # di


def test_a_car_that_says_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cli) -> None:
    monkeypatch.setattr(autonomos, "_HELLO_TIMEOUT_NS", 100_000_000)
    monkeypatch.setattr(drive, "make_camera", lambda car: StillCamera(road()))
    boards = Board2017()
    try:
        said = cli("run", "--car", car_file(tmp_path, boards))
    finally:
        boards.servo.close()
    assert (said.code, said.out) == (2, "")
    line = said.err.splitlines()[-1]
    assert "the car sends nothing; check ports, baud rate and [link] kind; " in line
    assert line.endswith("set [link] port in car.toml")
