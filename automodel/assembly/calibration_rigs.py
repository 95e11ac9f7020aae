"""Cars to be calibrated: the one at the serial port, or a simulated one that hides what it is."""

from __future__ import annotations

import contextlib
import dataclasses
from dataclasses import dataclass
from pathlib import Path

from automodel.assembly.parts import car_of, make_camera
from automodel.config import CarConfig, ConfigError
from automodel.geometry import GroundCamera
from automodel.runtime.clocks import MonotonicClock, VirtualClock
from automodel.sim.appearance import Appearance
from automodel.sim.plant import Plant, PlantConfig
from automodel.sim.renderer import Renderer
from automodel.sources.cameras import CaptureThread
from automodel.types import Image
from calibration.calibration_drive import Rig, Ticks
from calibration.calibration_output import check_before
from firmware_link.arduino import ArduinoLink
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.transport import LoggedTransport, MemoryTransport, SerialTransport

_HALL_M = 50.0  # half the side of the simulated floor: no drive leaves it


@dataclass(frozen=True, slots=True, kw_only=True)
class LoggedRig:
    """A rig, what its board says, and the plant behind it where it is simulated."""

    rig: Rig
    board: LoggedTransport
    plant: Plant | None


def car_to_calibrate(
    car_file: Path | None, simulated: bool, dry_run: bool, *, by_board: bool = True
) -> tuple[CarConfig, bool]:
    """The car of the command line and whether it is simulated; raises ConfigError where none is named.

    A car.toml that could not be written afterwards is refused before anything moves, and so is, `by_board`, a car whose
    board does not say which pulses and ticks there are.
    """
    if car_file is None:
        if not simulated:
            raise ConfigError("--car: which car? Name its car.toml, or give --sim for a simulated one")
        return car_of(None), True
    check_before(car_file, dry_run)
    car = car_of(car_file)
    if by_board and car.link.kind != "arduino":
        raise ConfigError(
            f'{car_file}: [link] kind = "{car.link.kind}": only the board with kind = "arduino" says which pulses and '
            "ticks there were; see --manual and --ticks"
        )
    if simulated:
        link = dataclasses.replace(car.link, port="sim")
        car = dataclasses.replace(car, link=link, camera=dataclasses.replace(car.camera, source="sim"))
    return car, car.link.port == "sim"


def plant_of(car: CarConfig, seed: int, gyro: bool = True) -> PlantConfig:
    """What the simulated car truly is."""
    vehicle = car.vehicle
    return PlantConfig(wheelbase_m=vehicle.wheelbase_m, ticks_per_m=vehicle.ticks_per_m, seed=seed, gyro=gyro)


def simulated_rig(car: CarConfig, plant_config: PlantConfig, seed: int, camera: bool) -> LoggedRig:
    """A car on an empty floor, in virtual time; with `camera` it sees a tiled floor."""
    plant = Plant(plant_config)
    board = EmulatedArduino(plant, car.link.baud)

    def advance(t_ns: int) -> None:
        board.advance(t_ns)
        plant.advance(t_ns)

    clock = VirtualClock(0, advance)
    logged = LoggedTransport(MemoryTransport(board, clock), clock)
    rig = Rig(
        source=Ticks(clock, TiledFloor(car, plant, seed), 1.0 / car.camera.rate_hz) if camera else Ticks(clock),
        link=ArduinoLink(logged, car.link, car.vehicle),
        clock=clock,
        auto_arm=True,
    )
    return LoggedRig(rig=rig, board=logged, plant=plant)


class TiledFloor:
    """What the car's camera sees of a matt, tiled floor without end."""

    def __init__(self, car: CarConfig, plant: Plant, seed: int) -> None:
        look = dataclasses.replace(
            Appearance.random(seed, style="competition"),
            floor_texture="tiles",
            floor_contrast=1.0,
            floor_grey=90.0,
            lamps=(),
            shine=0.0,
        )
        floor = (-_HALL_M, -_HALL_M, _HALL_M, _HALL_M)
        self._renderer = Renderer((), floor, (), GroundCamera.from_config(car.camera), look)
        self._plant, self._index = plant, 0

    def __call__(self, t_ns: int) -> Image:
        """The picture at `t_ns`."""
        self._index += 1
        car = self._plant.predicted(t_ns)
        return self._renderer.render(car.x_m, car.y_m, car.yaw_rad, car.speed_mps, car.yaw_rate_radps, self._index)


def real_rig(car: CarConfig, camera: bool, auto_arm: bool, leaving: contextlib.ExitStack) -> LoggedRig:
    """The car at the serial port of car.toml, and its camera where that is wanted."""
    clock = MonotonicClock()
    logged = LoggedTransport(SerialTransport(car.link.port, car.link.baud), clock)
    source: Ticks | CaptureThread = Ticks(clock)
    if camera:
        source = CaptureThread(make_camera(car))
        leaving.callback(source.close)
    link = ArduinoLink(logged, car.link, car.vehicle)
    return LoggedRig(rig=Rig(source=source, link=link, clock=clock, auto_arm=auto_arm), board=logged, plant=None)
