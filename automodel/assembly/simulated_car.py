"""Puts the simulated world together, in lock-step or in a process of its own."""

from __future__ import annotations

import contextlib
import dataclasses
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from automodel.assembly.can_parts import can_functions
from automodel.assembly.desk import DeskLink, DeskMemory, DeskPort
from automodel.assembly.registry import make_part
from automodel.config import CarConfig, ConfigError
from automodel.config.parts import LINKS
from automodel.geometry import SE2, GroundCamera
from automodel.interfaces import Source, VehicleLink
from automodel.runtime.clocks import MonotonicClock, VirtualClock
from automodel.signals import Command
from automodel.sim.appearance import Appearance
from automodel.sim.full_size import FullSizeConfig, FullSizePlant
from automodel.sim.plant import CarState, Plant, PlantConfig
from automodel.sim.renderer import Renderer
from automodel.sim.sources import LockStepSource, RealTimeWorld, WorldFactory
from automodel.sim.track import Lane, Track
from automodel.sim.track_files import load_track
from automodel.sim.truth import TruthFollower
from automodel.sim.world import EyePair, FullSizeWorld, Scene, UltrasonicRanges, World
from firmware_link.can_port import PythonCanPort
from firmware_link.can_receiver import load_dbc
from firmware_link.emulator.autonomos import EmulatedAutonomos
from firmware_link.emulator.avr import AvrBoard, AvrProgram, build_avr
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.emulator.can_bus import ServedCanVehicle, own_group
from firmware_link.emulator.can_vehicle import EmulatedCanVehicle, MemoryCanPort
from firmware_link.emulator.pty import PtyBoard
from firmware_link.transport import MemoryTransport, SerialTransport, Transport

STYLES = ("clean", "competition", "varied")
# simulated board -> its [link] kind
BOARDS = {"emulated": "arduino", "avr": "arduino", "autonomos": "autonomos", "can": "can"}
BUS = "udp_multicast"  # of the full-size car in real time: it needs no CAN interface
LATENCY_NS = 3_000_000  # of the loop in lock-step: capture to the byte on the wire


@dataclass(frozen=True, slots=True, kw_only=True)
class Simulation:
    """What is simulated: the track (name or file), the driving direction, the seed and style of light and floor.

    `link` is the board: "emulated"; "avr", the firmware itself on a simulated microcontroller; "autonomos", that of an
    AutoNOMOS car; "can", a full-size vehicle on a CAN bus; "serial", a real board at car.toml's port (`assembly.desk`).
    """

    track: str = "tmr"
    direction: str = "forward"
    seed: int = 0
    style: str = "competition"
    link: str = "emulated"


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatedCar:
    """A source, a link and a clock that belong together, what closes them, and what they measured themselves."""

    source: Source
    link: VehicleLink
    clock: VirtualClock | MonotonicClock
    close: Callable[[], None]
    metrics: Callable[[], dict[str, object]] = dict


def board_of(car: CarConfig) -> str:
    """The simulated board for car.toml's [link] kind; raises ConfigError where there is none."""
    for board, kind in BOARDS.items():
        if kind == car.link.kind:
            return board
    raise ConfigError(f"[link] kind {car.link.kind!r}: there is no simulated board for it; give a real [link] port")


def has_our_firmware(car: CarConfig) -> bool:
    """Whether the board tells which pulses it makes and which wheel ticks it counts, as our firmware does."""
    return car.link.kind == "arduino"


def appearance(style: str, seed: int) -> Appearance:
    """The look of the world."""
    return Appearance() if style == "clean" else Appearance.random(seed, style=style)


def renderer(track: Track, car: CarConfig, look: Appearance, nod_max_rad: float = 0.0) -> Renderer:
    """The camera of `car` over `track`; `nod_max_rad` is the largest pitch by which it may nod."""
    eye, paint = GroundCamera.from_config(car.camera), track.paint()
    return Renderer(paint, track.floor, track.obstacles, eye, look, roadside=track.roadside, nod_max_rad=nod_max_rad)


def renderers(track: Track, car: CarConfig, look: Appearance, nod_max_rad: float = 0.0) -> list[Renderer]:
    """The camera of `car` over `track`, or both of a pair, left first, each with noise of its own."""
    cameras = (dataclasses.replace(car, camera=camera) for camera in car.camera.eyes)
    seeds = (dataclasses.replace(look, noise_seed=look.noise_seed + number) for number in range(2))
    return [renderer(track, one, own, nod_max_rad) for one, own in zip(cameras, seeds, strict=False)]


def eyes(track: Track, car: CarConfig, look: Appearance) -> Renderer | EyePair:
    """The camera of `car` over `track`, or both of a pair."""
    found = renderers(track, car, look)
    return EyePair(*found) if len(found) > 1 else found[0]


def build_world(car: CarConfig, simulation: Simulation) -> World:
    """The scale car at the start of its lane, standing."""
    vehicle = car.vehicle
    true = PlantConfig(wheelbase_m=vehicle.wheelbase_m, ticks_per_m=vehicle.ticks_per_m, seed=simulation.seed)
    if simulation.link == "serial":  # a real board makes the pulses of this very car
        true = dataclasses.replace(true, servo=car.link.servo, motor=car.link.motor)
    bumper_x_m = vehicle.wheelbase_m + vehicle.front_overhang_m
    track, start, follower, reach = _surroundings(car, simulation)
    ranges = UltrasonicRanges([obstacle.polygon_m for obstacle in track.obstacles], bumper_x_m)
    eye = eyes(track, car, appearance(simulation.style, simulation.seed))
    return World(Plant(true, start, ranges), eye, follower, reach)


def build_full_size_world(car: CarConfig, simulation: Simulation) -> FullSizeWorld:
    """The full-size car at the start of its lane, standing; its centre of mass where ours is by default."""
    true = FullSizeConfig(wheelbase_m=car.vehicle.wheelbase_m, cg_to_front_m=0.47 * car.vehicle.wheelbase_m)
    track, start, follower, reach = _surroundings(car, simulation)
    eye = eyes(track, car, appearance(simulation.style, simulation.seed))
    return FullSizeWorld(FullSizePlant(true, start), eye, follower, reach)


def _surroundings(
    car: CarConfig, simulation: Simulation
) -> tuple[Track, SE2, TruthFollower, Callable[[CarState], float]]:
    """The track, where the car starts on it, what follows its truth, and how far its body reaches to the side."""
    track = load_track(simulation.track)
    lane = track.lane(simulation.direction)
    start = track.start
    if simulation.direction != track.start_direction:
        start = lane.pose(_straight_place(lane, lane.centerline.project((start.x_m, start.y_m))[0]))
    follower = TruthFollower(lane, car.vehicle.reference_x_m)
    return track, start, follower, lambda state: follower.lateral_reach_m(state, car.vehicle)


def _straight_place(lane: Lane, from_s_m: float) -> float:
    """Arc length of the first place from `from_s_m` on with a straight road of four lane widths ahead, or the best."""
    line, width = lane.centerline, float(lane.width_m(0.0))
    starts = from_s_m + np.arange(0.0, line.length_m, 0.25 * width)
    bend = np.abs(line.curvature(starts[:, None] + np.linspace(-0.5, 4.0, 19) * width)).max(axis=1)
    straight = np.flatnonzero(bend * width < 0.02)
    return float(starts[straight[0] if len(straight) else int(np.argmin(bend))])


def lock_step(car: CarConfig, simulation: Simulation, on_scene: Callable[[Scene], None]) -> SimulatedCar:
    """Virtual time: the bytes go through memory, the board's timers run on the same clock."""
    if simulation.link == "can":
        return _full_size_lock_step(car, simulation, on_scene)
    with contextlib.ExitStack() as leaving:
        program = _program(car, simulation, leaving)
        world = build_world(car, simulation)
        board = _board(car, simulation, world, program)
        if isinstance(board, AvrBoard):
            leaving.callback(board.close)

        def advance(t_ns: int) -> None:
            board.advance(t_ns)
            world.settle(t_ns)

        clock = VirtualClock(0, advance)
        source = LockStepSource(world, clock, car.camera.rate_hz, LATENCY_NS, on_scene)
        leaving.callback(source.close)
        link = _link(car, simulation, MemoryTransport(board, clock))
        return SimulatedCar(source=source, link=link, clock=clock, close=leaving.pop_all().close)


def _full_size_lock_step(car: CarConfig, simulation: Simulation, on_scene: Callable[[Scene], None]) -> SimulatedCar:
    """The full-size car: CAN frames go through memory."""
    world, config = build_full_size_world(car, simulation), car.link.can
    vehicle = EmulatedCanVehicle(world, load_dbc(config.dbc), config, can_functions(config))

    def advance(t_ns: int) -> None:
        vehicle.advance(t_ns)
        world.settle(t_ns)

    clock = VirtualClock(0, advance)
    source = LockStepSource(world, clock, car.camera.rate_hz, LATENCY_NS, on_scene)
    link: VehicleLink = make_part(LINKS, "can", car, MemoryCanPort(vehicle, clock))
    return SimulatedCar(source=source, link=link, clock=clock, close=source.close)


def served_world(car: CarConfig, simulation: Simulation, program: AvrProgram | None = None) -> tuple[World, PtyBoard]:
    """World and board for a process of their own; the board answers on a pseudo terminal."""
    world = build_world(car, simulation)
    return world, PtyBoard(_board(car, simulation, world, program))


def served_full_size_world(
    car: CarConfig, simulation: Simulation, group: str
) -> tuple[FullSizeWorld, ServedCanVehicle]:
    """World and vehicle for a process of their own; the vehicle answers on a bus of UDP multicast."""
    world, config = build_full_size_world(car, simulation), car.link.can
    vehicle = EmulatedCanVehicle(world, load_dbc(config.dbc), config, can_functions(config))
    return world, ServedCanVehicle(vehicle, PythonCanPort(BUS, group, config.bitrate), group)


class PacedCanPort:
    """A port that notes how evenly its first message leaves, and how old the frame is that its command came from."""

    def __init__(self, port: PythonCanPort, period_s: float, validity_s: float) -> None:
        self.place, self.open, self.receive, self.close = port.place, port.open, port.receive, port.close
        self.carried: Callable[[], Command | None] = lambda: None  # the command in a message that is sent
        self._port, self._period_s, self._validity_s = port, period_s, validity_s
        self._frame_id: int | None = None
        self._times_ns: list[int] = []
        self._ages_ns: list[float] = []  # of each command's frame, as the first message with it left
        self._newest: Command | None = None

    def send(self, frame_id: int, data: bytes, extended: bool) -> None:
        """Send a frame."""
        self._port.send(frame_id, data, extended)
        if self._frame_id not in (None, frame_id):
            return
        now_ns, command = time.monotonic_ns(), self.carried()
        self._frame_id = frame_id
        self._times_ns.append(now_ns)
        if command is not None and command is not self._newest:
            captured_ns = command.valid_until_ns - self._validity_s * 1e9  # a command lives from its frame on
            if captured_ns < command.t_ns:  # a standstill comes from no frame
                self._ages_ns.append(now_ns - captured_ns)
        self._newest = command

    def metrics(self) -> dict[str, object]:
        """How far intervals are from the period, and the time from a frame's capture to the message with its command.

        Median and 99th percentile [ms]; None where there was nothing to measure.
        """
        off_ns = np.abs(np.diff(np.array(self._times_ns, dtype=np.float64)) - self._period_s * 1e9)
        return {
            f"{name}_p{share}_ms": float(np.percentile(times_ns, share)) * 1e-6 if len(times_ns) else None
            for name, times_ns in (("jitter", off_ns), ("frame_to_bus", self._ages_ns))
            for share in (50, 99)
        }


def real_time(car: CarConfig, simulation: Simulation, on_scene: Callable[[Scene], None]) -> SimulatedCar:
    """Real time: camera and board live in another process, behind shared memory and a serial port."""
    shape, pair = _image_shape(car), car.camera.right is not None
    with contextlib.ExitStack() as leaving:
        serve: WorldFactory = served_full_size_world
        arguments: tuple[object, ...] = (car, simulation, own_group())
        if simulation.link != "can":
            serve, arguments = served_world, (car, simulation, _program(car, simulation, leaving))
        source = RealTimeWorld(serve, arguments, shape, car.camera.rate_hz, on_scene, pair=pair)
        leaving.callback(source.close)
        if simulation.link == "can":
            bus, period_s = PythonCanPort(BUS, source.port, car.link.can.bitrate), car.link.can.send[0].period_s
            port = PacedCanPort(bus, period_s, car.safety.command_validity_s)
            link = make_part(LINKS, "can", car, port)
            port.carried = lambda: link.command
            return SimulatedCar(
                source=source,
                link=link,
                clock=MonotonicClock(),
                close=leaving.pop_all().close,
                metrics=port.metrics,
            )
        link = _link(car, simulation, SerialTransport(source.port, car.link.baud))
        return SimulatedCar(source=source, link=link, clock=MonotonicClock(), close=leaving.pop_all().close)


def desk_world(car: CarConfig, simulation: Simulation, memory: DeskMemory) -> tuple[World, DeskPort]:
    """World for a process of its own, which a board elsewhere moves by the pulses in `memory`."""
    world = build_world(car, simulation)
    return world, DeskPort(world, memory, car.link.port)


def on_desk(car: CarConfig, simulation: Simulation, on_scene: Callable[[Scene], None]) -> SimulatedCar:
    """Real time: the camera lives in another process, the board at the serial port of car.toml is a real one."""
    memory = DeskMemory()
    arguments, shape, pair = (car, simulation, memory), _image_shape(car), car.camera.right is not None
    source = RealTimeWorld(desk_world, arguments, shape, car.camera.rate_hz, on_scene, pair=pair)
    link = DeskLink(car, memory)
    return SimulatedCar(source=source, link=link, clock=MonotonicClock(), close=source.close, metrics=link.meter.row)


def _image_shape(car: CarConfig) -> tuple[int, ...]:
    """That of the camera's frame; of a pair (2, h, w)."""
    shape = (car.camera.height_px, car.camera.width_px) + ((3,) if car.camera.colour else ())
    return shape if car.camera.right is None else (2, *shape)


def _program(car: CarConfig, simulation: Simulation, leaving: contextlib.ExitStack) -> AvrProgram | None:
    """The firmware and its simulator, built into a folder that goes with `leaving`; None for the emulated board."""
    if simulation.link != "avr":
        return None
    folder = leaving.enter_context(tempfile.TemporaryDirectory(prefix="avr-"))
    return build_avr(Path(folder), car.link.baud)


def _board(
    car: CarConfig, simulation: Simulation, world: World, program: AvrProgram | None
) -> EmulatedArduino | EmulatedAutonomos | AvrBoard:
    if program is not None:
        return AvrBoard(program, world, car.link.baud)
    board = EmulatedAutonomos if simulation.link == "autonomos" else EmulatedArduino
    return board(world, car.link.baud)


def _link(car: CarConfig, simulation: Simulation, transport: Transport) -> VehicleLink:
    link: VehicleLink = make_part(LINKS, BOARDS[simulation.link], car, transport)
    return link
