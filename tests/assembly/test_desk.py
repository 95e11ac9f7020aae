"""A board that makes the pulses while the world is simulated: `run --link serial --sim-camera`."""

from __future__ import annotations

import csv
import dataclasses
import math
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from automodel.assembly.desk import SILENT_NS, DeskLink, DeskMemory, DeskPort, EchoMeter
from automodel.assembly.drive import RunOptions, drive_simulated
from automodel.assembly.simulated_car import Simulation, build_world
from automodel.config import parse_car
from automodel.runtime.run_types import TickRecord
from automodel.runtime.safety import SafetyMode
from automodel.signals import Command, DriverInput, Event
from firmware_link.emulator.avr import AvrBoard
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.emulator.pty import BenchPeripherals, PtyBoard
from firmware_link.messages import Fault, Status, StatusFlag
from tests.support.avr_board import built_avr
from tests.support.command_line import Cli, cli

__all__ = ["cli"]
MS = 1_000_000
CAR = """
[camera]
source = "usb"
width_px = 320
height_px = 180
rate_hz = 20
[camera.intrinsics]
fx_px = 240.0
fy_px = 240.0
cx_px = 159.5
cy_px = 89.5
[link]
port = "{port}"
[link.servo]  # another servo than the simulator's own: the world has to turn by this one
pulse_us = [1100, 1500, 1900]
steering_rad = [-0.45, 0.0, 0.45]
[safety]  # a loaded machine is slow; what is tested is the order of things
frame_timeout_s = 2.0
hold_s = 2.0
"""


def status(counter: int, servo_us: float, faults: int = 0, armed: bool = True, motor_us: float = 1500.0) -> Status:
    return Status(
        time_us=0,
        servo_us=servo_us,
        motor_us=motor_us,
        faults=faults,
        nonce=1,
        command_counter=counter,
        flags=int(StatusFlag.ARMED) if armed else 0,
    )


def test_an_echo_is_timed_once_and_the_pulse_compared_with_the_commands_that_it_may_be() -> None:
    meter = EchoMeter()
    for number, servo_us in enumerate((1500.0, 1510.0, 1520.0)):
        meter.sent(250 + number, servo_us, 1500.0, number * 16 * MS)
    meter.heard(status(251, 1500.0), 40 * MS)  # the pin is a servo frame behind
    meter.heard(status(251, 1510.0), 60 * MS)
    meter.heard(status(252, 1530.0), 70 * MS)
    row = meter.row()
    assert meter.echoes_ns == [24 * MS, 38 * MS]
    assert meter.errors_us == [0.0, 0.0, 10.0]
    assert row["pulse_error_max_us"] == 10.0
    assert row["deadlines_missed"] == 0


def test_a_deadline_counts_once_for_as_long_as_it_is_told() -> None:
    meter = EchoMeter()
    for faults in (0, Fault.COMMAND_LATE, Fault.COMMAND_LATE, 0, Fault.COMMAND_TIMEOUT, Fault.FRAME_ERRORS):
        meter.heard(status(0, 1500.0, int(faults)), 0)
    assert meter.missed == 2


def test_nothing_measured_is_nothing_told() -> None:
    meter = EchoMeter()
    meter.heard(status(3, 0.0, armed=False), 0)
    assert meter.row() == {
        "echo_p50_ms": None, "echo_p99_ms": None, "deadlines_missed": 0, "pulse_error_p99_us": None,
        "pulse_error_max_us": None,
    }  # fmt: skip


def test_the_world_moves_by_the_pulses_and_its_sensors_come_back() -> None:
    car = parse_car(CAR.format(port="/dev/ttyUSB7"), "car.toml")
    world, memory = build_world(car, Simulation(track="oval", style="clean", link="serial")), DeskMemory()
    memory.numbers[0:2] = (1900.0, 1700.0)
    port = DeskPort(world, memory, "")
    port.start()
    until = time.monotonic() + 60.0
    while memory.numbers[3] < 50 and time.monotonic() < until:  # wheel ticks
        world.settle(time.monotonic_ns())
        time.sleep(0.005)
    port.close()
    state = world.plant.predicted(time.monotonic_ns())
    assert memory.numbers[3] >= 50
    assert state.distance_m > 0
    assert state.steering_rad == pytest.approx(0.45, abs=0.1)  # left, by car.toml's own servo


def test_a_board_that_falls_silent_is_neutral_for_the_world(tmp_path: Path) -> None:
    memory = DeskMemory()
    with PtyBoard(EmulatedArduino(BenchPeripherals(), 115200)) as board:
        link = DeskLink(parse_car(CAR.format(port=board.path), "car.toml"), memory)
        link.open()
        until = time.monotonic() + 60.0
        state = None
        while state is None and time.monotonic() < until:
            state = link.poll(time.monotonic_ns())
            time.sleep(0.005)
        assert state is not None
        assert state.speed_mps is None  # the world has not said anything
        memory.numbers[0:2] = (1111.0, 1222.0)
    heard_ns = link._heard_ns
    with pytest.raises(OSError):  # the cable is out
        link.poll(heard_ns + SILENT_NS)
    assert memory.numbers[0:2].tolist() == [1500.0, 1500.0]
    link.close()


class Insistent:
    """Arms again and again: a loaded machine may stop the car. Enough is a drive of some decimetres."""

    def __init__(self) -> None:
        self.driven = 0  # cycles in which the simulated car drove

    def on_tick(self, record: TickRecord) -> None:
        speed_mps = record.state.speed_mps if record.state is not None else None
        self.driven += record.decision.mode is SafetyMode.DRIVING and (speed_mps or 0.0) > 0.2

    def on_event(self, event: Event) -> None:
        pass

    def arm_requested(self) -> bool:
        return True

    def stop_requested(self) -> str | None:
        return None

    def wanted_by_hand(self) -> DriverInput | None:
        return None


@pytest.mark.slow
@pytest.mark.realtime
def test_an_emulated_board_drives_the_simulated_world(tmp_path: Path) -> None:
    bench, person = BenchPeripherals(), Insistent()
    with PtyBoard(EmulatedArduino(bench, 115200)) as port:
        car = parse_car(CAR.format(port=port.path) + '[pipeline]\nname = "contour"\n', "car.toml")
        options = RunOptions(
            track="oval", style="clean", board="serial", realtime=True, duration_s=120.0, truth=tmp_path / "truth.csv"
        )
        report = drive_simulated(car, "", options, [person], over=lambda: person.driven > 100)
    assert person.driven > 100
    assert report.row["echo_p50_ms"] > 0
    assert report.row["pulse_error_max_us"] is not None
    with open(tmp_path / "truth.csv", newline="") as file:
        places = [(float(line["x_m"]), float(line["y_m"])) for line in csv.DictReader(file)]
    assert max(abs(x - places[0][0]) + abs(y - places[0][1]) for x, y in places) > 0.2
    assert len({servo_us for _, servo_us, _ in bench.pulses}) > 3  # it steered


@pytest.fixture(params=["emulated", "avr"])
def board(request: pytest.FixtureRequest) -> Iterator[tuple[EmulatedArduino | AvrBoard, BenchPeripherals]]:
    bench = BenchPeripherals()
    if request.param == "emulated":
        yield EmulatedArduino(bench, 115200), bench
        return
    chip = AvrBoard(built_avr(), bench, 115200, boot_ns=0)
    yield chip, bench
    chip.close()


def test_the_firmwares_echo_is_in_time_and_its_pulses_are_those_commanded(
    board: tuple[EmulatedArduino | AvrBoard, BenchPeripherals],
) -> None:
    """Over a pseudo terminal, in the board's time, so that a busy machine changes nothing."""
    chip, bench = board
    pty, memory, now_ns, armed = PtyBoard(chip), DeskMemory(), 0, 0
    link = DeskLink(parse_car(CAR.format(port=pty.path), "car.toml"), memory)
    try:
        link.open()
        for turn in range(200):
            for _ in range(16):
                now_ns += MS
                pty.step(now_ns)
                time.sleep(0.0002)  # the kernel passes a pseudo terminal's bytes on with a delay
            state = link.poll(now_ns)
            if state is not None and not state.armed:
                link.arm(now_ns)
            armed += state is not None and state.armed
            steering_rad = 0.1 * math.sin(0.1 * turn)  # slower than the board's slew
            wanted = Command(t_ns=now_ns, steering_rad=steering_rad, speed_mps=0.3, valid_until_ns=now_ns + 100 * MS)
            link.send(wanted, now_ns)
        assert armed > 100
        said = link._link.status
        assert said is not None
        assert memory.numbers[0:2].tolist() == [said.servo_us, said.motor_us]
        assert len({servo_us for _, servo_us, _ in bench.pulses}) > 20
        row = link.meter.row()
        assert row["deadlines_missed"] == 0
        assert 0 < row["echo_p50_ms"] <= row["echo_p99_ms"] <= 48.0  # three turns, of which a report takes up to 20 ms
        assert row["pulse_error_p99_us"] <= 1.0  # but for the slew of the throttle, once armed
        assert len(link.meter.errors_us) > 50
    finally:
        link.close()
        pty.close()


def test_the_board_is_not_armed_by_itself(tmp_path: Path, cli: Cli) -> None:
    car = tmp_path / "car.toml"
    with PtyBoard(EmulatedArduino(BenchPeripherals(), 115200)) as port:
        car.write_text(CAR.format(port=port.path))
        said = cli("run", "--car", car, "--sim-camera", "--track", "oval", "--duration", "4", "--pipeline", "contour")
    assert "driving" not in said.err
    assert "no terminal to arm from" in said.err


def test_the_desk_s_world_has_the_cars_own_servo() -> None:
    car = parse_car(CAR.format(port="/dev/ttyUSB7"), "car.toml")
    plants = [build_world(car, Simulation(track="oval", link=link)).plant.config for link in ("emulated", "serial")]
    assert plants[1].servo == car.link.servo
    assert dataclasses.replace(plants[1], servo=plants[0].servo, motor=plants[0].motor) == plants[0]
