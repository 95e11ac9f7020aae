"""From CAN frames to a vehicle's values, supervised per message. No bus and no clock: frames and time are arguments."""

from __future__ import annotations

import enum
import importlib.resources
import math
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from automodel.config import CanConfig, CanMessage, CanSignal, CanValue, ConfigError
from automodel.config.extras import need_extra
from automodel.config.toml_reader import MOST_TEXT_BYTES, check_file
from firmware_link.can_checks import ChecksumFunction, CounterFunction, usual_mask

WINDOW_FRAMES = 10  # a message is faulty with `BAD_MAX` bad frames among so many, until there is none among them
BAD_MAX = 3  # one or two are what a disturbed wire does; a stuck counter reaches 3 within 3 periods, as a timeout does


@dataclass(frozen=True, slots=True, kw_only=True)
class CanFrame:
    """A data frame as it was received at `t_ns`."""

    t_ns: int
    frame_id: int
    data: bytes
    extended: bool = False


class Verdict(enum.Enum):
    """What a frame of a supervised message is."""

    GOOD = "good"
    LENGTH = "length"
    CHECKSUM = "checksum"
    COUNTER = "counter"
    RANGE = "range"  # a value is outside of its range, or a reserved bit is not 0
    JUMP = "jump"  # a value is too far from the one before
    QUALITY = "quality"  # the sender itself says that its values are invalid


@dataclass(frozen=True, slots=True, kw_only=True)
class Functions:
    """The checksum and counter functions that a mapping names."""

    checksums: Mapping[str, ChecksumFunction]
    counters: Mapping[str, CounterFunction]


@dataclass(frozen=True, slots=True, kw_only=True)
class Snapshot:
    """The values that are valid now; `t_ns` is the age of the oldest message that gave one (None: there is none)."""

    t_ns: int | None
    values: Mapping[str, float]
    faults: tuple[str, ...]


@dataclass(slots=True)
class MessageCount:
    """What was received of one message."""

    frames: int = 0
    verdicts: Counter[Verdict] = field(default_factory=Counter)
    timeouts: int = 0
    alarms: int = 0  # how often the message became faulty, timeouts included
    longest_gap_ns: int = 0
    first_ns: int | None = None
    last_ns: int | None = None


def load_dbc(paths: Sequence[str | Path]) -> Any:
    """The cantools database of these files together (none: our own `automodel.dbc`); raises ConfigError."""
    need_extra("CAN", "cantools", "crccheck")
    import cantools
    from cantools.database.errors import UnsupportedDatabaseFormatError

    if not paths:
        own = importlib.resources.files("firmware_link") / "dbc" / "automodel.dbc"
        return cantools.database.load_string(own.read_text(encoding="utf-8"), "dbc")
    messages: list[Any] = []
    for path in paths:
        check_file(path, MOST_TEXT_BYTES)
        try:
            text = Path(path).read_bytes().decode("cp1252")
            read: Any = cantools.database.load_string(text, "dbc", strict=False)
            messages += read.messages
        except FileNotFoundError:
            raise ConfigError(f"{path}: no such file") from None
        except OSError as error:
            raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
        except (UnsupportedDatabaseFormatError, UnicodeDecodeError) as error:
            raise ConfigError(f"{path}: not a DBC file: {' '.join(str(error).split())[:160]}") from None
    return cantools.database.Database(messages=messages, strict=False)


class ProtectedMessage:
    """A message of the DBC with its checksum and counter; raises ConfigError where it has not the signals it needs."""

    def __init__(self, database: Any, message: CanMessage, signals: Sequence[str], functions: Functions) -> None:
        self._definition = _definition(database, message, signals)
        self._message = message
        self.frame_id: int = self._definition.frame_id
        self.extended: bool = self._definition.is_extended_frame
        self.length: int = self._definition.length
        self._data_id = self.frame_id & 0xFFFF if message.data_id < 0 else message.data_id
        self._checksum = functions.checksums[message.checksum] if message.checksum else None
        if self._checksum is not None:
            self._mask, self._shift = self._checksum_place()
        self._reserved = self._reserved_bits() if message.reserved_zero else 0
        self._count_on = functions.counters[message.counter] if message.counter else None
        if message.counter_signal:
            self._counter_bits: int = self._definition.get_signal_by_name(message.counter_signal).length

    def _reserved_bits(self) -> int:
        """The bits that no signal has, of the payload as a big-endian number."""
        if self._definition.is_multiplexed():
            raise ConfigError(f"[link.can] {self._message.name}: reserved_zero: not of a multiplexed message")
        ones = {s.name: -1 if s.is_signed else (1 << s.length) - 1 for s in self._definition.signals}
        used = int.from_bytes(self._definition.encode(ones, scaling=False, strict=False), "big")
        return used ^ ((1 << 8 * self.length) - 1)

    def checksum_in(self, data: bytes) -> int:
        """The checksum that a payload carries."""
        return (int.from_bytes(data, "big") & self._mask) >> self._shift

    def checksum_for(self, data: bytes) -> int:
        """The checksum that a payload must carry."""
        assert self._checksum is not None
        blank = (int.from_bytes(data, "big") & ~self._mask).to_bytes(len(data), "big")
        return self._checksum(self.frame_id, self._data_id, blank)

    def sealed(self, data: bytes) -> bytes:
        """The payload with the checksum that it must carry."""
        if self._checksum is None:
            return data
        blank = int.from_bytes(data, "big") & ~self._mask
        return (blank | self.checksum_for(data) << self._shift).to_bytes(len(data), "big")

    def counted_on(self, counter: int) -> int:
        """The counter after this one; the same where the message has none."""
        return counter if self._count_on is None else self._count_on(counter, self._counter_bits)

    def _checksum_place(self) -> tuple[int, int]:
        name = self._message.checksum_signal
        if not name:
            return usual_mask(self._message.checksum, self.length)
        signal = self._definition.get_signal_by_name(name)
        if signal.byte_order == "big_endian":
            last = 8 * (signal.start // 8) + 7 - signal.start % 8 + signal.length  # bits from the payload's first one
        else:
            last = 8 * (signal.start // 8) + 8 - signal.start % 8
            if signal.start % 8 + signal.length > 8:
                raise ConfigError(f"[link.can] checksum_signal {name}: crosses a byte in little-endian order")
        shift = 8 * self.length - last
        return ((1 << signal.length) - 1) << shift, shift


class MessageReader(ProtectedMessage):
    """Checks and decodes the payloads of one message; a payload in, verdict and values out."""

    def __init__(self, database: Any, message: CanMessage, values: Sequence[CanSignal], functions: Functions) -> None:
        super().__init__(database, message, [value.signal for value in values], functions)
        self._values = values

    def verdict(self, data: bytes) -> tuple[Verdict, dict[str, float], int | None]:
        """What the payload is but for its counter; its values (none unless it is good) and its counter."""
        if len(data) != self.length:
            return Verdict.LENGTH, {}, None
        if self._checksum is not None and self.checksum_in(data) != self.checksum_for(data):
            return Verdict.CHECKSUM, {}, None
        raw = self._definition.decode(data, decode_choices=False, scaling=False)
        if int.from_bytes(data, "big") & self._reserved:
            return Verdict.RANGE, {}, None
        counter = raw[self._message.counter_signal] if self._message.counter_signal else None
        quality = self._message.quality_signal
        if quality and raw[quality] != self._message.quality_ok:
            return Verdict.QUALITY, {}, counter
        physical = self._definition.decode(data, decode_choices=False)
        values: dict[str, float] = {}
        for part in self._values:
            if part.signal in physical:  # a multiplexed one is not in every frame
                told = part.factor * float(physical[part.signal]) + part.offset
                values[part.value] = values.get(part.value, 0.0) + told
        for part in self._values:
            if part.value in values and not part.minimum <= values[part.value] <= part.maximum:
                return Verdict.RANGE, {}, counter
        return Verdict.GOOD, values, counter


class MessageWriter(ProtectedMessage):
    """Encodes the payloads of one message: values in, a payload with counter and checksum out."""

    def __init__(self, database: Any, message: CanMessage, values: Sequence[CanSignal], functions: Functions) -> None:
        super().__init__(database, message, [value.signal for value in values], functions)
        self._values = values
        self._signals = {signal.name: signal for signal in self._definition.signals}
        self._counter, self._held = 0, False
        self.name = message.name
        self.period_ns = round(message.period_s * 1e9)

    def hold_counter(self) -> None:
        """Let the next payload have the counter of the last one."""
        self._held = True

    def payload(self, told: Mapping[str, float], valid: bool = True) -> bytes:
        """The next payload; a value that is not in `told` is 0, one that is no number too; `valid`: its quality."""
        raw = {name: int(signal.raw_initial or 0) for name, signal in self._signals.items()}
        for value in self._values:
            wanted = told.get(value.value, 0.0)
            wanted = min(max(wanted, value.minimum), value.maximum) if math.isfinite(wanted) else 0.0
            raw[value.signal] = self._raw(value.signal, (wanted - value.offset) / value.factor)
        if self._message.counter_signal:
            self._counter = self._counter if self._held else self.counted_on(self._counter)
            raw[self._message.counter_signal], self._held = self._counter, False
        if self._message.quality_signal:
            raw[self._message.quality_signal] = self._message.quality_ok ^ (not valid)
        return self.sealed(bytes(self._definition.encode(raw, scaling=False, strict=False)))

    def _raw(self, name: str, physical: float) -> int:
        signal = self._signals[name]
        raw = round((physical - float(signal.offset)) / float(signal.scale))
        bits = signal.length - signal.is_signed
        lowest = -(1 << bits) if signal.is_signed else 0
        return min(max(raw, lowest), (1 << bits) - 1)


class MessageWatch:
    """The supervision of one message: what its frames are worth over time."""

    def __init__(self, reader: MessageReader, message: CanMessage, values: Sequence[CanSignal] = ()) -> None:
        self._reader = reader
        self.name = message.name
        self._timeout_ns = round(message.timeout_s * 1e9)
        self._period_ns = round(message.period_s * 1e9)
        self._rates = {v.value: v.rate_max for v in values if isinstance(v, CanValue)}
        self.count = MessageCount()
        self.values: dict[str, float] = {}
        self.good_ns: int | None = None  # when the last good frame came
        self._since_ns: int | None = None  # from when on frames are waited for
        self._recent: deque[bool] = deque(maxlen=WINDOW_FRAMES)  # whether the last frames were bad
        self._fault = ""  # the verdict that made the message faulty
        self._counter: int | None = None
        self._unread = 0  # frames since, whose counter could not be trusted
        self._missing = False

    def take(self, data: bytes, t_ns: int) -> Verdict:
        """Judge a frame that came at `t_ns`; its values count from now on where it is good."""
        self.look(t_ns)
        count = self.count
        if count.last_ns is not None:
            count.longest_gap_ns = max(count.longest_gap_ns, t_ns - count.last_ns)
        count.first_ns = t_ns if count.first_ns is None else count.first_ns
        count.last_ns, count.frames = t_ns, count.frames + 1
        verdict, values, counter = self._reader.verdict(data)
        if counter is not None:
            if verdict is Verdict.GOOD and not self._counted(counter):
                verdict = Verdict.COUNTER
            elif verdict is Verdict.GOOD and self._jumps(values, t_ns):
                verdict = Verdict.JUMP
            self._counter, self._unread = counter, 0
        else:
            self._unread += 1
        count.verdicts[verdict] += 1
        if verdict is Verdict.GOOD:
            self.values = {**self.values, **values}
            self.good_ns, self._missing = t_ns, False
        self._judge(verdict)
        return verdict

    def look(self, now_ns: int) -> str | None:
        """Why the message is invalid at `now_ns`, None where it is valid; call it also while no frame comes."""
        if self._since_ns is None:
            self._since_ns = now_ns
        last_ns = self._since_ns if self.good_ns is None else self.good_ns
        if now_ns - last_ns > self._timeout_ns and not self._missing:
            self._missing = True
            self.count.timeouts += 1
            self.count.alarms += not self._fault
        if self._fault:
            return self._fault
        if self._missing:
            return "timeout"
        return "unseen" if self.good_ns is None else None

    def _counted(self, counter: int) -> bool:
        """Whether the counter follows the last one; frames that were damaged since may have counted, or been extra."""
        expected = self._counter
        for _ in range(1 + min(self._unread, BAD_MAX)):
            if expected is None or counter == (expected := self._reader.counted_on(expected)):
                return True
        return False

    def _jumps(self, values: Mapping[str, float], t_ns: int) -> bool:
        """Whether a value is further from the last good one than it may get; frames that come together are not late."""
        if self.good_ns is None:
            return False
        dt_s = max(t_ns - self.good_ns, self._period_ns) * 1e-9
        return any(
            abs(values[name] - self.values[name]) > rate * dt_s
            for name, rate in self._rates.items()
            if name in values and name in self.values
        )

    def _judge(self, verdict: Verdict) -> None:
        self._recent.append(verdict is not Verdict.GOOD)
        bad = sum(self._recent)
        if not self._fault and (verdict is Verdict.QUALITY or bad >= BAD_MAX):
            self._fault = verdict.value
            self.count.alarms += not self._missing
        elif self._fault and bad == 0 and len(self._recent) == WINDOW_FRAMES:
            self._fault = ""


class CanReceiver:
    """All supervised messages of a mapping.

    Raises ConfigError where the mapping does not fit the DBC's definitions.
    """

    def __init__(self, database: Any, config: CanConfig, functions: Functions) -> None:
        self._ratio = config.steering_ratio
        self.watches: dict[tuple[int, bool], MessageWatch] = {}
        for message in config.receive:
            values = [value for value in config.state if value.message == message.name]
            reader = MessageReader(database, message, values, functions)
            key = (reader.frame_id, reader.extended)
            if key in self.watches:
                raise ConfigError(f"[link.can] receive: {message.name} has the identifier of another message")
            self.watches[key] = MessageWatch(reader, message, values)

    def take(self, frame: CanFrame) -> Verdict | None:
        """Judge and decode a frame; None for one of another message."""
        watch = self.watches.get((frame.frame_id, frame.extended))
        return None if watch is None else watch.take(frame.data, frame.t_ns)

    def snapshot(self, now_ns: int) -> Snapshot:
        """The values of all messages that are valid at `now_ns`, and a fault for each of the others."""
        values: dict[str, float] = {}
        faults: list[str] = []
        oldest_ns: int | None = None
        for watch in self.watches.values():
            fault = watch.look(now_ns)
            if fault is not None:
                faults.append(f"can_{fault}:{watch.name}")
                continue
            values.update(watch.values)
            if watch.good_ns is not None:
                oldest_ns = watch.good_ns if oldest_ns is None else min(oldest_ns, watch.good_ns)
        if "steering_rad" in values:
            values["steering_rad"] /= self._ratio
        return Snapshot(t_ns=oldest_ns, values=values, faults=tuple(faults))


def _definition(database: Any, message: CanMessage, signals: Sequence[str]) -> Any:
    """The DBC's definition of a message, which must have all signals that the mapping names."""
    try:
        definition = database.get_message_by_name(message.name)
    except KeyError:
        raise ConfigError(
            f"[link.can] receive: there is no message {message.name} in the DBC files; see [link.can] dbc, or --dbc"
        ) from None
    known = {signal.name for signal in definition.signals}
    named = [message.checksum_signal, message.counter_signal, message.quality_signal, *signals]
    for signal in named:
        if signal and signal not in known:
            names = ", ".join(sorted(known))
            raise ConfigError(f"[link.can] {message.name}: there is no signal {signal} in the DBC files, only {names}")
    return definition
