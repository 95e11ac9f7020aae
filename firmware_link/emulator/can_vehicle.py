"""An emulated full-size vehicle on a CAN bus: checks what it is sent, can be overridden, and misbehaves on demand.

It speaks any mapping, as the other side of `CanLink`: what the link receives it sends. Time is an argument.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from automodel.config import CanConfig
from firmware_link.can_port import BusTrouble, Received
from firmware_link.can_receiver import CanFrame, Functions, MessageReader, MessageWatch, MessageWriter, Verdict
from firmware_link.errors import PortLost, PortNotFound
from firmware_link.transport import Clock

_MS = 1_000_000
COMMAND_TIMEOUT_NS = 100 * _MS
OVERRIDE_TORQUE_NM = 3.0
OUTBOX_FRAMES = 2000  # half a second of a full bus
FULL_LOAD_FRAMES = 4  # a millisecond of a bus of 500 kbit/s holds so many frames of 8 bytes
QUEUE_FRAMES = 10  # that wait for the bus; Linux's default for a CAN interface (txqueuelen)
_LOWEST_ID = 0x7F8  # of standard frames, and the seven above it


class BodyState(Protocol):
    """What the vehicle's sensors say."""

    @property
    def speed_mps(self) -> float:
        """Forward positive."""

    @property
    def yaw_rate_radps(self) -> float:
        """Anticlockwise positive."""

    @property
    def steering_rad(self) -> float:
        """Of the road wheels, left positive."""


class VehicleBody(Protocol):
    """The vehicle's dynamics."""

    def drive(self, t_ns: int, steering_rad: float | None, accel_mps2: float) -> None:
        """Steer to a road-wheel angle (None: nobody steers) and accelerate from `t_ns` on."""

    def measure(self, t_ns: int) -> BodyState:
        """The state at `t_ns`."""


@dataclass(slots=True)
class Driver:
    """What the person at the wheel does."""

    torque_nm: float = 0.0
    brake: bool = False
    accelerator: float = 0.0
    gear: str = "D"

    def overrides(self) -> bool:
        """Whether the vehicle lets go of our commands for it."""
        return abs(self.torque_nm) > OVERRIDE_TORQUE_NM or self.brake or self.accelerator > 0 or self.gear != "D"


@dataclass(slots=True)
class Misbehaviour:
    """What is wrong with the bus or the vehicle's messages; the sets hold names of messages."""

    missing: set[str] = field(default_factory=set)
    stuck_counter: set[str] = field(default_factory=set)
    jumping_counter: set[str] = field(default_factory=set)
    bad_checksum: set[str] = field(default_factory=set)
    invalid: set[str] = field(default_factory=set)  # the sender says so
    frozen: set[str] = field(default_factory=set)  # the same frame again and again
    longer_by: dict[str, int] = field(default_factory=dict)  # bytes; below 0: shorter
    offset: dict[str, float] = field(default_factory=dict)  # value: what is added to it
    second_sender: bool = False  # somebody else sends our command
    flooded: bool = False  # frames of the highest priority fill the bus: no others get through
    load_frames: int = 0  # frames of the lowest priority a millisecond, which all others overtake
    trouble: BusTrouble | None = None
    error_frames: int = 0  # between good ones, each time that the port is asked
    queue_full: bool = False
    ignores_driver: bool = False  # it does not let go by itself


@dataclass(slots=True)
class Column:
    """A steering column that is turned by torque, against damping and what the tyres turn it back with.

    b d(delta)/dt = T - (k + c v^2 / L) delta: the tyres' part is in proportion to the lateral acceleration.
    """

    damping_nmsprad: float = 10.0
    centring_nmprad: float = 5.0
    per_accel_nms2pm: float = 1.0
    wheelbase_m: float = 2.7

    def turned_rad(self, steering_rad: float, torque_nm: float, speed_mps: float, dt_s: float) -> float:
        """The road-wheel angle after `dt_s`; exact for a torque and a speed that stay."""
        stiffness = self.centring_nmprad + self.per_accel_nms2pm * speed_mps * speed_mps / self.wheelbase_m
        rest_rad = torque_nm / stiffness
        return rest_rad + (steering_rad - rest_rad) * math.exp(-dt_s * stiffness / self.damping_nmsprad)


class EmulatedCanVehicle:
    """The vehicle's side of the bus; `advance` sends what is due, `take` judges what came."""

    def __init__(
        self,
        body: VehicleBody,
        database: Any,
        config: CanConfig,
        functions: Functions,
        phases_ns: Mapping[str, int] | None = None,
    ) -> None:
        """`phases_ns`: how long after the start each message is sent first."""
        self._body, self._config, self._phases_ns = body, config, phases_ns or {}
        self.driver, self.wrong, self.column = Driver(), Misbehaviour(), Column()
        self._turned_rad: float | None = None  # by torque, since it was engaged
        self._turned_ns = 0
        self.boot_id = 1
        self.engaged = False
        self.engagements: list[tuple[int, bool]] = []  # each change of `engaged` with its time
        self.verdicts: Counter[Verdict] = Counter()
        self.accepted: list[tuple[int, dict[str, float]]] = []  # good commands with their time
        self._unknown = 0
        self._refused = False  # after an override or a timeout: until enable was 0, so that no stale command engages
        anything = [dataclasses.replace(value, minimum=-math.inf, maximum=math.inf) for value in config.state]
        self._writers = [
            MessageWriter(database, message, [v for v in anything if v.message == message.name], functions)
            for message in config.receive
        ]
        self._watches: dict[tuple[int, bool], MessageWatch] = {}
        for message in config.send:
            values = [v for v in config.command if v.message == message.name]
            reader = MessageReader(database, message, values, functions)
            self._watches[reader.frame_id, reader.extended] = MessageWatch(reader, message)
        self._next_ns: dict[str, int] = {}
        self._now_ns: int | None = None
        self._last: dict[str, bytes] = {}
        self._outbox: deque[CanFrame] = deque(maxlen=OUTBOX_FRAMES)

    @property
    def unknown(self) -> int:
        """Frames that no mapping lets anybody send."""
        return self._unknown

    def restart(self) -> None:
        """The vehicle's controller starts again."""
        self.boot_id += 1
        self.refuse()

    def refuse(self) -> None:
        """Let go at once, until enable was 0."""
        self._refused = True
        if self._now_ns is not None and self.engaged:
            self._engage(False, self._now_ns)

    def take(self, frame: CanFrame) -> None:
        """Judge a frame from the bus and follow it where it is a good command."""
        watch = self._watches.get((frame.frame_id, frame.extended))
        if watch is None:
            self._unknown += 1
            return
        verdict = watch.take(frame.data, frame.t_ns)
        self.verdicts[verdict] += 1
        if verdict is Verdict.GOOD:
            self.accepted.append((frame.t_ns, dict(watch.values)))
            self._follow(frame.t_ns)

    def advance(self, t_ns: int) -> None:
        """Let the vehicle act and send up to `t_ns`."""
        if self._now_ns is None:
            self._now_ns = t_ns
            self._next_ns = {writer.name: t_ns + self._phases_ns.get(writer.name, 0) for writer in self._writers}
        while self._now_ns < t_ns:
            due = [w.good_ns + COMMAND_TIMEOUT_NS for w in self._watches.values() if w.good_ns is not None]
            self._now_ns = min(self._now_ns + _MS, t_ns, *(ns for ns in due if ns > self._now_ns))
            self._follow(self._now_ns)
            self._send(self._now_ns)

    def collect(self) -> list[CanFrame]:
        """What the vehicle has sent since the last call, the newest `OUTBOX_FRAMES`."""
        sent = list(self._outbox)
        self._outbox.clear()
        return sent

    def _follow(self, t_ns: int) -> None:
        told: dict[str, float] = {}
        missing = False
        for watch in self._watches.values():
            missing |= watch.good_ns is None or t_ns - watch.good_ns >= COMMAND_TIMEOUT_NS
            told.update(watch.values)
        enable = told.get("enable", 0.0) != 0
        if (self.driver.overrides() and not self.wrong.ignores_driver) or missing:
            self._refused = True
        elif not enable:
            self._refused = False
        engaged = enable and not self._refused
        if engaged != self.engaged:
            self._engage(engaged, t_ns)
        if self.engaged:
            self._body.drive(t_ns, self._steering_rad(told, t_ns), told.get("accel_mps2", 0.0))
        else:
            self._turned_rad = None
            self._body.drive(t_ns, None, -self._config.decel_max_mps2)

    def _steering_rad(self, told: Mapping[str, float], t_ns: int) -> float:
        """The angle that was asked for, or that to which a torque has turned the column by now."""
        if "torque_nm" not in told:
            return told["steering_rad"] / self._config.steering_ratio
        state = self._body.measure(t_ns)
        if self._turned_rad is None:
            self._turned_rad, self._turned_ns = state.steering_rad, t_ns
        dt_s, self._turned_ns = max(t_ns - self._turned_ns, 0) * 1e-9, max(t_ns, self._turned_ns)
        self._turned_rad = self.column.turned_rad(self._turned_rad, told["torque_nm"], state.speed_mps, dt_s)
        return self._turned_rad

    def _engage(self, engaged: bool, t_ns: int) -> None:
        self.engaged = engaged
        self.engagements.append((t_ns, engaged))

    def _send(self, t_ns: int) -> None:
        wrong = self.wrong
        others = FULL_LOAD_FRAMES if wrong.flooded else wrong.load_frames
        for index in range(others):
            frame_id = index % 8 + (0 if wrong.flooded else _LOWEST_ID)
            self._outbox.append(CanFrame(t_ns=t_ns, frame_id=frame_id, data=bytes(8)))
        for writer in self._writers:
            if t_ns < self._next_ns[writer.name]:
                continue
            self._next_ns[writer.name] += writer.period_ns
            if writer.name not in wrong.missing and not wrong.flooded:
                data = self._payload(writer, self._values(t_ns))
                frame = CanFrame(t_ns=t_ns, frame_id=writer.frame_id, data=data, extended=writer.extended)
                self._outbox.append(frame)
        if wrong.second_sender and t_ns % (10 * _MS) < _MS:
            for frame_id, extended in self._watches:
                self._outbox.append(CanFrame(t_ns=t_ns, frame_id=frame_id, data=bytes(8), extended=extended))

    def _values(self, t_ns: int) -> Mapping[str, float]:
        state, driver = self._body.measure(t_ns), self.driver
        values = {
            "speed_mps": state.speed_mps,
            "yaw_rate_radps": state.yaw_rate_radps,
            "steering_rad": state.steering_rad * self._config.steering_ratio,
            "engaged": float(self.engaged),
            "driver_torque_nm": driver.torque_nm,
            "brake": float(driver.brake),
            "accelerator": driver.accelerator,
            "gear": float(self._config.gears.index(driver.gear)),
            "boot_id": float(self.boot_id),
            "battery_v": 12.6,
        }
        return {name: value + self.wrong.offset.get(name, 0.0) for name, value in values.items()}

    def _payload(self, writer: MessageWriter, values: Mapping[str, float]) -> bytes:
        wrong, name = self.wrong, writer.name
        if name in wrong.frozen and name in self._last:
            return self._last[name]
        if name in wrong.stuck_counter:
            writer.hold_counter()
        if name in wrong.jumping_counter:
            writer.payload(values)
        data = writer.payload(values, valid=name not in wrong.invalid)
        if name in wrong.bad_checksum:
            data = bytes((data[0] ^ 0xFF, *data[1:]))
        change = wrong.longer_by.get(name, 0)
        data = data[: len(data) + change] if change < 0 else data + bytes(change)
        self._last[name] = data
        return data


class MemoryCanPort:
    """A bus in the same process on any clock, with the emulated vehicle at its other end."""

    def __init__(self, vehicle: EmulatedCanVehicle, clock: Clock) -> None:
        self._vehicle, self._clock = vehicle, clock
        self._open = False
        self._waiting: list[CanFrame] = []  # while others fill the bus
        self.place = "emulated CAN bus"

    def open(self) -> None:
        """Join the bus; raises PortNotFound while the controller is off."""
        if self._vehicle.wrong.trouble is BusTrouble.OFF:
            raise PortNotFound(f"{self.place}: the CAN bus cannot be opened: bus-off")
        self._vehicle.advance(self._clock.now_ns())
        self._vehicle.collect()  # what was sent before is lost
        self._waiting.clear()
        self._open = True

    def receive(self, now_ns: int) -> Received:
        """What has come."""
        self._check()
        trouble = self._vehicle.wrong.trouble
        if not self._vehicle.wrong.flooded:
            self._pass_on()
        self._vehicle.advance(now_ns)
        frames = self._vehicle.collect()
        if trouble is not None:  # nothing gets through
            return Received(troubles=(trouble,) * (3 if trouble is BusTrouble.ERROR else 1))
        return Received(frames=tuple(frames), troubles=(BusTrouble.ERROR,) * self._vehicle.wrong.error_frames)

    def send(self, frame_id: int, data: bytes, extended: bool) -> None:
        """Send a frame, which arrives at once unless others fill the bus."""
        self._check()
        if self._vehicle.wrong.queue_full or len(self._waiting) >= QUEUE_FRAMES:
            raise PortLost(f"{self.place}: a frame cannot be sent, the queue is full or the bus down")
        if self._vehicle.wrong.trouble is None:
            self._waiting.append(CanFrame(t_ns=0, frame_id=frame_id, data=data, extended=extended))
            if not self._vehicle.wrong.flooded:
                self._pass_on()

    def close(self) -> None:
        """Leave the bus."""
        self._open = False

    def _pass_on(self) -> None:
        """Deliver what waits: it arrives now, however old it is."""
        t_ns = self._clock.now_ns()
        for frame in self._waiting:
            self._vehicle.take(dataclasses.replace(frame, t_ns=t_ns))
        self._waiting.clear()

    def _check(self) -> None:
        if not self._open:
            raise PortLost(f"{self.place}: not open")
