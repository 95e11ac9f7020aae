"""Driving programs to be disturbed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.support.fake_cars import car_toml, road
from tests.support.realtime_rig import BOARDS, Bench, Car, MakeBoard

CHILDREN = Path(__file__).resolve().parents[2] / "support"


@pytest.fixture(scope="session")
def picture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the camera shows."""
    path = tmp_path_factory.mktemp("picture") / "road.npy"
    np.save(path, road())
    return path


@pytest.fixture(scope="session")
def start_car(picture: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Car]:
    """Starts `automodel run`; whoever asks for one closes it."""

    def start(make_board: MakeBoard, on_signal: str = "stall") -> Car:
        folder = tmp_path_factory.mktemp("car")
        bench = Bench(make_board, folder)
        car_file = car_toml(folder, bench.pty.path)
        car_file.write_text(car_file.read_text() + 'image = "jpeg"\n')
        run = ["run", "--car", str(car_file), "--pipeline", "windows"]
        child = [str(CHILDREN / "driving_child.py"), str(picture), str(bench.clock_file), on_signal]
        return Car(bench, folder, [*child, *run])

    return start


@pytest.fixture
def make_car(start_car: Callable[..., Car]) -> Iterator[Callable[..., Car]]:
    """Programs that end with the test."""
    cars: list[Car] = []

    def make(make_board: MakeBoard, on_signal: str = "stall") -> Car:
        cars.append(start_car(make_board, on_signal))
        return cars[-1]

    yield make
    for car in cars:
        car.close()


@pytest.fixture(scope="session", params=BOARDS)
def survivors(request: pytest.FixtureRequest, start_car: Callable[..., Car]) -> Iterator[Callable[[], Car]]:
    """The program that lives through what is done to it: one serves many tests, and another where it died."""
    cars: list[Car] = []

    def living() -> Car:
        if not cars or not cars[-1].alive:
            cars.append(start_car(request.param))
        return cars[-1]

    yield living
    for car in cars:
        car.close()


@pytest.fixture
def car(survivors: Callable[[], Car]) -> Iterator[Car]:
    """A program that drives, or will; what a test leaves unplugged is put in again. No car drives off by itself."""
    car = survivors()
    since_ns = car.bench.clock.now_ns
    yield car
    car.bench.pty.replug()
    car.bench.check_asked_for(since_ns)


@pytest.fixture
def killed_host(tmp_path: Path) -> Iterator[Callable[[MakeBoard], Car]]:
    """The simplest host, which starts sooner."""
    cars: list[Car] = []

    def make(make_board: MakeBoard) -> Car:
        bench = Bench(make_board, tmp_path)
        cars.append(Car(bench, tmp_path, [str(CHILDREN / "link_child.py"), bench.pty.path, str(bench.clock_file)]))
        return cars[-1]

    yield make
    for car in cars:
        car.close()
