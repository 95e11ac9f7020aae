"""Cars to be calibrated: the one at the serial port, or a simulated one with properties drawn at random."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path

from automodel.assembly.links import arduino_link
from automodel.assembly.parts import build_run, car_of, left_alone, make_camera
from automodel.assembly.simulated_car import has_our_firmware
from automodel.config import CarConfig, ConfigError
from automodel.geometry import GroundCamera
from automodel.interfaces import Source
from automodel.runtime.clocks import MonotonicClock, SleepingClock, VirtualClock
from automodel.sim.appearance import Appearance
from automodel.sim.plant import Plant, PlantConfig
from automodel.sim.randomised_plant import randomised_servo
from automodel.sim.renderer import Renderer
from automodel.sources.cameras import CaptureThread
from automodel.types import Image
from calibration.car_file import check_car_file
from calibration.drive import Rig, Ticks, plant_of
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.transport import LoggedTransport, MemoryTransport, SerialTransport, Transport

_HALL_M = 50.0  # half the side of the simulated floor: no drive leaves it


def car_to_calibrate(
    car_file: Path | None, simulated: bool, dry_run: bool, *, needs_board_log: bool = True
) -> CarConfig:
    """The car of the command line; its [link] port is "sim" where it is simulated.

    Raises ConfigError before anything moves: where no car is named, for a car.toml that could not be written
    afterwards, and with `needs_board_log` for a board that does not report pulses and ticks.
    """
    if car_file is None:
        if not simulated:
            raise ConfigError("--car: which car? Name its car.toml, or give --sim for a simulated one")
        return car_of(None)
    if not dry_run:
        check_car_file(car_file)
    car = car_of(car_file)
    if needs_board_log and not has_our_firmware(car):
        raise ConfigError(
            f'{car_file}: [link] kind = "{car.link.kind}": only the board with kind = "arduino" reports pulses and '
            "ticks; see --manual and --ticks"
        )
    if simulated:
        link = dataclasses.replace(car.link, port="sim")
        car = dataclasses.replace(car, link=link, camera=dataclasses.replace(car.camera, source="sim"))
    return car


@contextlib.contextmanager
def calibration_rig(
    car: CarConfig, *, plant: PlantConfig | None = None, camera: bool = False, auto_arm: bool = False
) -> Iterator[Rig]:
    """Implements `calibration.drive.RigMaker`."""
    with contextlib.ExitStack() as leaving:
        if plant is not None:
            yield simulated_rig(car, plant, camera)
        else:
            yield real_rig(car, camera, auto_arm, leaving)


def simulated_rig(car: CarConfig, config: PlantConfig, camera: bool) -> Rig:
    """A car on an empty floor, in virtual time; with `camera` it sees a tiled floor."""
    plant = Plant(config)
    board = EmulatedArduino(plant, car.link.baud)

    def advance(t_ns: int) -> None:
        board.advance(t_ns)
        plant.advance(t_ns)

    clock = VirtualClock(0, advance)
    source = Ticks(clock, TiledFloor(car, plant, config.seed), 1.0 / car.camera.rate_hz) if camera else Ticks(clock)
    return rig_on(car, MemoryTransport(board, clock), clock, source, auto_arm=True, plant=plant)


def real_rig(car: CarConfig, camera: bool, auto_arm: bool, leaving: contextlib.ExitStack) -> Rig:
    """The car at the serial port of car.toml, with its (left) camera if `camera`; at port "sim" an emulated board."""
    clock = MonotonicClock()
    transport: Transport = SerialTransport(car.link.port, car.link.baud)
    if car.link.port == "sim":
        transport = MemoryTransport(EmulatedArduino(Plant(randomised_servo(0, plant_of(car, 0))), car.link.baud), clock)
    source: Source = Ticks(clock)
    if camera:
        source = CaptureThread(make_camera(left_alone(car)))
        leaving.callback(source.close)
    return rig_on(car, transport, clock, source, auto_arm=auto_arm, plant=None)


def rig_on(
    car: CarConfig, transport: Transport, clock: SleepingClock, source: Source, *, auto_arm: bool, plant: Plant | None
) -> Rig:
    """The rig of a board on `transport`."""
    board = LoggedTransport(transport, clock)
    link = arduino_link(car, board)
    return Rig(
        car=car,
        link=link,
        clock=clock,
        auto_arm=auto_arm,
        board=board,
        plant=plant,
        run_parts=lambda loop: build_run(car, source=source, link=link, clock=clock, loop=loop, auto_arm=auto_arm),
    )


class TiledFloor:
    """What the car's camera sees of an endless matt, tiled floor."""

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
        """The image at `t_ns`."""
        self._index += 1
        car = self._plant.predicted(t_ns)
        return self._renderer.render(car.x_m, car.y_m, car.yaw_rad, car.speed_mps, car.yaw_rate_radps, self._index)
