"""[link.can]: which signals of a CAN bus are the vehicle's state and which ones command it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from automodel.config.parts import CAN_CHECKSUMS, CAN_COUNTERS
from automodel.config.toml_reader import not_negative, one_of, positive

TIMEOUT_PERIODS = 3.0  # a message that stayed away for so many of its periods is missing
TIMEOUT_MAX_S = 0.1  # and at the latest after this: the budget from a fault to a stop is 150 ms

STATE_VALUES = (  # what signals may tell
    "speed_mps", "yaw_rate_radps", "steering_rad", "battery_v", "engaged",
    "driver_torque_nm", "brake", "accelerator", "gear", "boot_id",
)  # fmt: skip

COMMAND_VALUES = ("enable", "steering_rad", "torque_nm", "speed_mps", "accel_mps2")  # what a command may be told as


def _distinct(name: str, names: Iterable[str]) -> None:
    seen: set[str] = set()
    for one in names:
        if one in seen:
            raise ValueError(f"{name}: {one} is there twice")
        seen.add(one)


@dataclass(frozen=True, slots=True, kw_only=True)
class CanMessage:
    """A message of the bus and how it is protected; every name is one of the DBC file.

    `checksum` and `counter` name functions (empty: it has none). `checksum_signal` empty: the place that is usual for
    that checksum. `data_id` is that of AUTOSAR's profiles, -1: the frame's identifier. `quality_signal` must have the
    raw value `quality_ok`, otherwise what the message says is invalid. `reserved_zero`: bits that no signal of the DBC
    file has must be 0.
    """

    name: str
    period_s: float
    checksum: str = ""
    checksum_signal: str = ""
    data_id: int = -1
    counter: str = ""
    counter_signal: str = ""
    quality_signal: str = ""
    quality_ok: int = 1
    reserved_zero: bool = False

    def __post_init__(self) -> None:
        positive(self, "period_s")
        if self.checksum:
            CAN_CHECKSUMS.check("checksum", self.checksum)
        elif self.checksum_signal:
            raise ValueError(f"checksum: expected one of {', '.join(CAN_CHECKSUMS.names)}, got none")
        if self.counter:
            CAN_COUNTERS.check("counter", self.counter)
        if bool(self.counter) != bool(self.counter_signal):
            raise ValueError("counter: expected with counter_signal, both or neither")
        if not -1 <= self.data_id <= 0xFFFF:
            raise ValueError(f"data_id: expected 0 .. 65535, or -1 for the identifier, got {self.data_id}")

    @property
    def timeout_s(self) -> float:
        """How long [s] the message may stay away."""
        return min(TIMEOUT_PERIODS * self.period_s, TIMEOUT_MAX_S)


@dataclass(frozen=True, slots=True, kw_only=True)
class CanSignal:
    """One signal's part in a value: `factor` times the signal, plus `offset`, in the value's unit."""

    value: str
    message: str
    signal: str
    factor: float = 1.0
    offset: float = 0.0
    minimum: float = -1e9
    maximum: float = 1e9

    def __post_init__(self) -> None:
        if self.factor == 0:
            raise ValueError("factor: expected a number other than 0, got 0.0")
        if not self.minimum < self.maximum:
            raise ValueError(f"minimum: {self.minimum} is not below maximum")


@dataclass(frozen=True, slots=True, kw_only=True)
class CanValue(CanSignal):
    """A signal that tells a value of the vehicle.

    Several entries of the same `value` add up; they must be in one message. A frame whose value lies outside of
    `minimum` .. `maximum` is rejected, and one whose value is further from the last good one than `rate_max` [1/s]
    allows for the time since. (The ranges of DBC files are often wrong, and are not used.)
    """

    rate_max: float = 1e9

    def __post_init__(self) -> None:
        CanSignal.__post_init__(self)
        if not self.rate_max > 0:
            raise ValueError(f"rate_max: expected a number above 0, got {self.rate_max}")
        one_of("value", self.value, STATE_VALUES)


@dataclass(frozen=True, slots=True, kw_only=True)
class CanCommand(CanSignal):
    """A signal that carries a part of the command, clipped to `minimum` .. `maximum`.

    `enable` is 1 while the vehicle shall follow. `torque_nm` is the steering torque that brings the wheels to the
    wanted angle, `accel_mps2` what brings the car to the wanted speed.
    """

    def __post_init__(self) -> None:
        CanSignal.__post_init__(self)
        one_of("value", self.value, COMMAND_VALUES)


@dataclass(frozen=True, slots=True, kw_only=True)
class CanConfig:
    """The bus and the mapping. The default mapping is that of `firmware_link/dbc/automodel.dbc`.

    `interface` is one of python-can's; its channel is `[link] port`. `dbc` are files of message definitions, read
    together; empty: our own. `steering_ratio`: steering wheel's angle over road wheels' angle, where the bus carries
    the former; it divides `steering_rad` that is read and multiplies the one that is sent.
    """

    interface: str = "socketcan"
    bitrate: int = 500_000
    dbc: tuple[str, ...] = ()
    steering_ratio: float = 1.0
    override_torque_nm: float = 3.0  # of the driver's hands; below it they rest, above it they steer
    override_accelerator: float = 0.05  # share of the pedal's travel; its sensor's play is about 0.02
    gears: tuple[str, ...] = ("P", "R", "N", "D")  # names of the gear signal's raw values, from 0; drives in "D" only
    accel_gain_per_s: float = 0.8  # acceleration per speed that is missing; the vehicle's own lag is about 0.3 s
    accel_max_mps2: float = 2.0  # ISO 15622:2018: adaptive cruise control above 20 m/s
    decel_max_mps2: float = 3.5  # likewise
    # steering by torque at the steering column, left positive; the gains are those of the emulated vehicle
    torque_max_nm: float = 3.0  # what a driver's hand holds against
    torque_rate_max_nmps: float = 6.0  # from nothing to all in half a second
    torque_gain_nmprad: float = (
        40.0  # per error of the road wheels' angle: a quarter of what swings at 5 m/s (measured)
    )
    torque_integral_nmprads: float = 60.0
    torque_per_accel_nms2pm: float = 1.0  # what turns the wheels back, per m/s^2 sideways; measured in a steady bend
    receive: tuple[CanMessage, ...] = (
        CanMessage(
            name="AM_STATE",
            period_s=0.01,
            checksum="autosar_e2e_2",
            counter="autosar_e2e_2",
            counter_signal="STATE_COUNTER",
            reserved_zero=True,
            quality_signal="STATE_VALID",
        ),
        CanMessage(
            name="AM_DRIVER",
            period_s=0.02,
            checksum="autosar_e2e_2",
            counter="autosar_e2e_2",
            counter_signal="DRIVER_COUNTER",
            reserved_zero=True,
        ),
        CanMessage(
            name="AM_HEARTBEAT",
            period_s=0.02,
            checksum="autosar_e2e_2",
            counter="autosar_e2e_2",
            counter_signal="HEARTBEAT_COUNTER",
            reserved_zero=True,
        ),
    )
    send: tuple[CanMessage, ...] = (
        CanMessage(
            name="AM_COMMAND",
            period_s=0.02,
            checksum="autosar_e2e_2",
            counter="autosar_e2e_2",
            counter_signal="COMMAND_COUNTER",
            reserved_zero=True,
        ),
    )
    command: tuple[CanCommand, ...] = (
        CanCommand(value="enable", message="AM_COMMAND", signal="ENABLE"),
        CanCommand(value="steering_rad", message="AM_COMMAND", signal="STEERING_REQUEST"),
        CanCommand(value="speed_mps", message="AM_COMMAND", signal="SPEED_REQUEST"),
        CanCommand(value="accel_mps2", message="AM_COMMAND", signal="ACCELERATION_REQUEST"),
    )
    state: tuple[CanValue, ...] = (
        CanValue(value="speed_mps", message="AM_STATE", signal="SPEED", minimum=-10.0, maximum=90.0, rate_max=30.0),
        CanValue(
            value="yaw_rate_radps", message="AM_STATE", signal="YAW_RATE", minimum=-3.0, maximum=3.0, rate_max=20.0
        ),
        CanValue(value="steering_rad", message="AM_STATE", signal="STEERING", minimum=-1.0, maximum=1.0, rate_max=3.0),
        CanValue(value="engaged", message="AM_STATE", signal="ENGAGED"),
        CanValue(value="driver_torque_nm", message="AM_DRIVER", signal="DRIVER_TORQUE", minimum=-100.0, maximum=100.0),
        CanValue(value="brake", message="AM_DRIVER", signal="BRAKE_PRESSED"),
        CanValue(value="accelerator", message="AM_DRIVER", signal="ACCELERATOR", minimum=0.0, maximum=1.0),
        CanValue(value="gear", message="AM_DRIVER", signal="GEAR", minimum=0.0, maximum=3.0),
        CanValue(value="boot_id", message="AM_HEARTBEAT", signal="BOOT_ID"),
    )

    def __post_init__(self) -> None:
        positive(self, "steering_ratio", "bitrate", "override_torque_nm", "override_accelerator")
        positive(self, "accel_gain_per_s", "accel_max_mps2", "decel_max_mps2", "torque_max_nm", "torque_rate_max_nmps")
        positive(self, "torque_gain_nmprad")
        not_negative(self, "torque_integral_nmprads", "torque_per_accel_nms2pm")
        _distinct("receive", (message.name for message in self.receive))
        _distinct("send", (message.name for message in (*self.receive, *self.send)))
        supervised = {message.name for message in self.receive}
        place: dict[str, str] = {}
        for part in self.state:
            if part.message not in supervised:
                raise ValueError(f"state: {part.value} is from {part.message}, which is not in receive")
            if place.setdefault(part.value, part.message) != part.message:
                raise ValueError(f"state: {part.value} is from two messages, {place[part.value]} and {part.message}")
        sent = {message.name for message in self.send}
        for signal in self.command:
            if signal.message not in sent:
                raise ValueError(f"command: {signal.value} goes into {signal.message}, which is not in send")
