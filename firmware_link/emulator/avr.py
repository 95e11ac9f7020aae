"""The real firmware on a simulated ATmega328P, with the interface of the emulated board; and its build.

simavr runs in a separate process (it is under the GPL), `firmware/simavr/`, and is controlled over a pipe. It returns
the bytes sent, pulses at the pins, writes to the pulse registers and resets, each with its cycle. Commands: `A` advance
to a cycle with these sensor readings, `R` bytes from the host, `X` reset with these flags in MCUSR, `H` hang, `S`
statistics. The firmware is built by avr-gcc, the simulated board by gcc with simavr.
"""

from __future__ import annotations

import contextlib
import math
import shutil
import struct
import subprocess
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, NamedTuple

from automodel.signals import BoardSensors
from firmware_link.emulator.board import Peripherals
from firmware_link.emulator.uart import UartLine
from firmware_link.errors import LinkError
from firmware_link.messages import PULSE_STEP_US, ResetCause

FIRMWARE = Path(__file__).parents[1] / "firmware"
PACKAGES = "make gcc gcc-avr avr-libc libsimavr-dev libelf-dev"
_TIMEOUT_S = 120.0
_HEADERS = (("avr-g++", "avr/io.h"), ("gcc", "simavr/sim_avr.h"), ("gcc", "libelf.h"))


class AvrMissing(LinkError):
    """The simulated AVR cannot be built; the text names the missing packages."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AvrProgram:
    """The firmware for the chip, and the simulator of the board for this machine."""

    firmware: Path = field(repr=False)  # built anew by every run: the folder says nothing about the program
    simulator: Path = field(repr=False)


def build_avr(folder: Path, baud: int = 115200) -> AvrProgram:
    """Build both into `folder` (about 2 s); raises AvrMissing if a tool is missing or fails."""
    simulator = FIRMWARE / "simavr"
    if not simulator.is_dir():
        raise AvrMissing(
            f"{simulator}: no such folder; the simulated AVR is not part of the installed package, use a checkout"
        )
    missing = missing_tools()
    if missing:
        raise AvrMissing(f"{', '.join(missing)}: missing for the simulated AVR; apt-get install {PACKAGES}")
    _make(FIRMWARE, folder / "firmware.elf", f"BUILD={folder}", f"BAUD={baud}")
    _make(simulator, folder / "avr_board", f"BUILD={folder}")
    return AvrProgram(firmware=folder / "firmware.elf", simulator=folder / "avr_board")


def missing_tools() -> list[str]:
    """The programs and headers that are not installed."""
    missing = [tool for tool in ("make", "gcc", "avr-g++") if shutil.which(tool) is None]
    return missing + [name for tool, name in _HEADERS if tool not in missing and not _has_header(tool, name)]


def _has_header(compiler: str, name: str) -> bool:
    command = [compiler, "-E", "-x", "c", "-include", name, "/dev/null"]
    if compiler != "gcc":
        command.insert(1, "-mmcu=atmega328p")
    return subprocess.run(command, capture_output=True, timeout=_TIMEOUT_S, check=False).returncode == 0


def _make(source: Path, target: Path, *variables: str) -> None:
    command = ["make", "-s", "-C", str(source), *variables, str(target)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)
    if done.returncode != 0:
        errors = [line for line in done.stderr.splitlines() if "error" in line.lower()] or done.stderr.splitlines()
        raise AvrMissing(f"{target.name}: cannot be built: {errors[0] if errors else 'make failed'}")


CYCLES_PER_US = 16
SLICE_NS = 5_000_000  # interval of the sensor readings for the simulation, as the firmware reads its gyro
SILENT_NS = 30_000_000  # after this time without a pulse a servo has none
_NS, _CYCLES = 125, 2  # the same time in both units
_STEP_CYCLES = int(CYCLES_PER_US * PULSE_STEP_US)
_WIRE_BYTES = 4096  # queued on either side of the line, as in a tty's buffer
_LOG = 100_000

_ADVANCE = struct.Struct("<cQih3HHBBB")
_RECEIVE = struct.Struct("<cQH")
_EVENT = struct.Struct("<QII")
_COUNT = struct.Struct("<I")
_BYTE, _PULSE, _REGISTER, _RESET, _CRASH, _AWAKE, _STACK = range(1, 8)

_MCUSR = {
    ResetCause.POWER_ON: 1,
    ResetCause.EXTERNAL: 2,
    ResetCause.BROWN_OUT: 4,
    ResetCause.WATCHDOG: 8,
}
_GYRO_STEP_RADPS = math.radians(1 / 65.5)  # at +-500 deg/s
_BATTERY_DIVIDER = 11
_NO_RANGE = 0xFFFF


class Pulse(NamedTuple):
    """A pulse at a pin, measured by the chip's own clock; `t_ns` is its end."""

    t_ns: int
    motor: bool
    cycles: int

    @property
    def us(self) -> float:
        """Its width [us] on the grid of 0.5 us: simavr reports a pin up to three cycles late."""
        return round(self.cycles / _STEP_CYCLES) * PULSE_STEP_US


class RegisterWrite(NamedTuple):
    """A change of a pulse register; `us` is the resulting pulse."""

    t_ns: int
    motor: bool
    us: float


@dataclass(slots=True, kw_only=True)
class SensorFaults:
    """Faults of the sensors at the board, to be assigned. The bits are left, centre, right."""

    gyro: str = ""  # "gone": no answer on the bus; "asleep": its supply has dipped
    echoes_stuck: int = 0  # bits of sensors whose echo stays high
    sonars_gone: int = 0  # bits of sensors that do not answer


class AvrBoard:
    """The simulated board; a `Board` for `MemoryTransport` and `PtyBoard`. Time is an argument.

    The chip's crystal is exact. The sensors are read every 5 ms; wheel ticks are edges spread over the next 5 ms, and a
    yaw rate of None removes the gyro from its bus. Pulses are passed to `peripherals` at their end, and 0 for a channel
    without pulses for 30 ms, as while the bootloader runs (`boot_ns` after each reset).

    `pulses`, `registers` and `resets` have the newest 100,000 of each. Raises LinkError if the simulator dies.
    """

    def __init__(
        self, program: AvrProgram, peripherals: Peripherals, baud: int = 115200, boot_ns: int = 300_000_000
    ) -> None:
        self._peripherals = peripherals
        self._baud = baud
        boot_cycles = str(boot_ns * _CYCLES // _NS)
        self._process = subprocess.Popen(
            [str(program.simulator), str(program.firmware), boot_cycles, str(baud)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,  # simavr's remarks on its own timers; a crash comes over the pipe
            start_new_session=True,  # Ctrl-C must not reach it: it ends with its pipe
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._to: IO[bytes] = self._process.stdin
        self._from: IO[bytes] = self._process.stdout
        self._line = UartLine(baud, _WIRE_BYTES)
        self._sent: deque[tuple[int, int]] = deque()
        self._origin_ns: int | None = None
        self._now_ns = 0
        self._slice_due_ns = 0
        self._sensors: BoardSensors | None = None
        self._first_tick: int | None = None
        self._widths_us = [0.0, 0.0]
        self._ends_ns = [0, 0]
        self.faults = SensorFaults()
        self.pulses: deque[Pulse] = deque(maxlen=_LOG)
        self.registers: deque[RegisterWrite] = deque(maxlen=_LOG)
        self.resets: deque[tuple[int, int]] = deque(maxlen=_LOG)  # when the program started, MCUSR
        self.statistics: dict[str, int] = {}

    def reset(self, now_ns: int, cause: ResetCause = ResetCause.EXTERNAL) -> None:
        """Restart, as the reset line does when a host opens the port."""
        self._power(now_ns)
        self.advance(now_ns)
        while self._sent and self._sent[-1][0] > now_ns:
            self._sent.pop()
        self._command(b"X" + bytes((_MCUSR[cause],)))

    def hang(self, now_ns: int, *, deaf: bool = False) -> None:
        """Fault: the program is in an endless loop; if `deaf`, with interrupts disabled."""
        self.advance(now_ns)
        self._command(b"H" + bytes((deaf,)))

    def brown_out(self, now_ns: int) -> None:
        """Fault: the supply dips."""
        self.reset(now_ns, ResetCause.BROWN_OUT)

    def room(self, now_ns: int) -> int:
        """The number of bytes that `receive` accepts at `now_ns`."""
        return self._line.room(now_ns)

    def receive(self, data: bytes, now_ns: int) -> int:
        """Put the host's bytes on the line; gives the number of accepted ones, the others are lost."""
        self._power(now_ns)
        taken = data[: self._line.room(now_ns)]
        if taken:
            start_ns = self._line.put(taken, now_ns)
            self._line.take(now_ns)  # the simulator has them
            self._command(_RECEIVE.pack(b"R", self._cycle(start_ns), len(taken)) + taken)
        return len(taken)

    def transmit(self, now_ns: int) -> bytes:
        """The bytes sent by `now_ns` since the last call; at most 4096, the newest are lost."""
        sent = bytearray()
        while self._sent and self._sent[0][0] <= now_ns:
            sent.append(self._sent.popleft()[1])
        return bytes(sent)

    def advance(self, now_ns: int) -> None:
        """Run the chip up to `now_ns`; times never decrease. The first call switches the power on."""
        self._power(now_ns)
        while self._now_ns < now_ns:
            if self._now_ns >= self._slice_due_ns or self._sensors is None:
                self._sensors = self._peripherals.read_sensors(self._now_ns)
                self._slice_due_ns += SLICE_NS
                if self._first_tick is None:
                    self._first_tick = self._sensors.wheel_ticks
            self._run(min(now_ns, self._slice_due_ns), self._sensors)

    def measure(self) -> dict[str, int]:
        """The longest time without sleep since the last call [cycles], and the lowest stack pointer."""
        self._command(b"S")
        self._take_events()
        return dict(self.statistics)

    def close(self) -> None:
        """End the simulator; may be called twice."""
        with contextlib.suppress(OSError):
            self._to.close()
        try:
            self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._from.close()

    def _power(self, now_ns: int) -> None:
        if self._origin_ns is None:
            self._origin_ns = self._now_ns = self._slice_due_ns = now_ns

    def _cycle(self, t_ns: int) -> int:
        return (t_ns - (self._origin_ns or 0)) * _CYCLES // _NS

    def _time_ns(self, cycle: int) -> int:
        return (self._origin_ns or 0) + cycle * _NS // _CYCLES

    def _run(self, until_ns: int, sensors: BoardSensors) -> None:
        faults = self.faults
        gyro = 0 if sensors.yaw_rate_radps is None or faults.gyro == "gone" else 2 if faults.gyro == "asleep" else 1
        rate = round((sensors.yaw_rate_radps or 0.0) / _GYRO_STEP_RADPS)
        ranges = [_NO_RANGE if r is None else min(round(r * 1000), _NO_RANGE - 1) for r in sensors.ranges_m]
        self._command(
            _ADVANCE.pack(
                b"A",
                self._cycle(until_ns),
                sensors.wheel_ticks - (self._first_tick or 0),
                min(max(rate, -0x8000), 0x7FFF),
                *ranges,
                round(sensors.battery_v * 1000 / _BATTERY_DIVIDER),
                gyro,
                faults.echoes_stuck,
                faults.sonars_gone,
            )
        )
        self._now_ns = until_ns
        self._take_events()
        for channel in (0, 1):
            if self._widths_us[channel] and until_ns - self._ends_ns[channel] > SILENT_NS:
                self._at_pin(channel, until_ns, 0.0)

    def _take_events(self) -> None:
        (count,) = _COUNT.unpack(self._read(_COUNT.size))
        for cycle, value, kind in _EVENT.iter_unpack(self._read(count * _EVENT.size)):
            t_ns = self._time_ns(cycle)
            if kind == _BYTE:
                if len(self._sent) < _WIRE_BYTES:
                    self._sent.append((t_ns, value))
            elif kind == _PULSE:
                pulse = Pulse(t_ns, bool(value >> 31), value & 0x7FFFFFFF)
                self.pulses.append(pulse)
                self._at_pin(int(pulse.motor), t_ns, pulse.us)
            elif kind == _REGISTER:
                self.registers.append(RegisterWrite(t_ns, bool(value >> 16), ((value & 0xFFFF) + 1) * PULSE_STEP_US))
            elif kind == _RESET:
                self.resets.append((t_ns, value))
            elif kind == _CRASH:
                raise LinkError(f"the simulated AVR has crashed at {value:#06x}")
            elif kind in (_AWAKE, _STACK):
                self.statistics["longest_awake" if kind == _AWAKE else "lowest_stack"] = value

    def _at_pin(self, channel: int, t_ns: int, width_us: float) -> None:
        self._widths_us[channel], self._ends_ns[channel] = width_us, t_ns
        self._peripherals.set_pulses(t_ns, *self._widths_us)

    def _command(self, data: bytes) -> None:
        try:
            self._to.write(data)
            self._to.flush()
        except (OSError, ValueError):
            raise LinkError("the simulated AVR has ended") from None

    def _read(self, count: int) -> bytes:
        data = self._from.read(count)
        if len(data) < count:
            raise LinkError("the simulated AVR has ended")
        return data
