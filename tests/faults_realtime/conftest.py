"""Driving programs to be disturbed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from fake_cars import car_toml, road
from realtime_rig import Bench, Car, MakeBoard

HERE = Path(__file__).parent


@pytest.fixture(scope="session")
def picture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the camera shows."""
    path = tmp_path_factory.mktemp("picture") / "road.npy"
    np.save(path, road())
    return path


@pytest.fixture(scope="module")
def make_car(picture: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., Car]]:
    """Driving programs; all end with the module's tests."""
    cars: list[Car] = []

    def make(make_board: MakeBoard, on_signal: str = "stall") -> Car:
        folder = tmp_path_factory.mktemp("car")
        bench = Bench(make_board, folder)
        car_file = car_toml(folder, bench.pty.path)
        car_file.write_text(car_file.read_text() + 'image = "jpeg"\n')
        run = ["run", "--car", str(car_file), "--pipeline", "windows"]
        cars.append(Car(bench, [str(HERE / "driving_child.py"), str(picture), str(bench.clock_file), on_signal, *run]))
        return cars[-1]

    yield make
    for car in cars:
        car.close()
        car.bench.close()


@pytest.fixture
def killed_host(tmp_path: Path) -> Iterator[Callable[[MakeBoard], Car]]:
    """The simplest host, which starts sooner."""
    cars: list[Car] = []

    def make(make_board: MakeBoard) -> Car:
        bench = Bench(make_board, tmp_path)
        cars.append(Car(bench, [str(HERE / "link_child.py"), bench.pty.path, str(bench.clock_file)]))
        return cars[-1]

    yield make
    for car in cars:
        car.close()
        car.bench.close()
