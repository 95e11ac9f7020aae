"""The faults of `bench faults --real-time`, by name: what happens to program, machine, terminal and board."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Protocol

from automodel.bench.faults.fault import BOUND_S, Kind, Must
from automodel.output_files import output_text
from automodel.runtime.safety import STALL_S
from firmware_link.emulator.board import EmulatedArduino

STEP_CLOCK = signal.SIGUSR1  # the program's camera then sets the wall clock back
OVERLOAD_S = 1.5
BUSY = 2  # processes a core, each of which would take all of it
PAUSE_S = (STALL_S + 0.05, STALL_S + 0.15)  # after a shorter one a slow car goes on by itself
_SPIN = "import time\nend = time.monotonic() + {}\nwhile time.monotonic() < end: pass"


class DrivingCar(Protocol):
    """The program that drives, its terminal and its board."""

    @property
    def recording(self) -> Path:
        """The file that it writes."""
        ...

    @property
    def pid(self) -> int:
        """Its process."""
        ...

    @property
    def board(self) -> EmulatedArduino:
        """Its board."""
        ...

    def kill(self, number: int) -> None:
        """Send it a signal."""
        ...

    def unplug(self) -> None:
        """Unplug the board's cable."""
        ...

    def close_terminal(self) -> None:
        """Close its terminal."""
        ...

    def beside(self, process: subprocess.Popen[bytes]) -> None:
        """A process that ends with the run."""
        ...

    def later(self, seconds: float, what: Callable[[], None]) -> None:
        """Do it after so long."""
        ...


Strike = Callable[[DrivingCar, Random], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class RealFault:
    """`strike` makes it happen at once; `ended` is whether the program must end by itself, in order.

    `by_silence`: the car may drive on, or be held or stopped; but from the host's last fresh command that turns the
    motor to neutral no more than `within_s` may pass.
    """

    name: str
    kind: Kind
    must: Must
    text: str
    strike: Strike
    within_s: float = BOUND_S
    ended: bool = False
    by_silence: bool = False


def _signalled(*numbers: signal.Signals) -> Strike:
    return lambda car, random: car.kill(random.choice(numbers))


def _stopped(car: DrivingCar, random: Random) -> None:
    car.kill(signal.SIGSTOP)
    car.later(random.uniform(*PAUSE_S), lambda: car.kill(signal.SIGCONT))


def _overloaded(car: DrivingCar, random: Random) -> None:
    command = [sys.executable, "-c", _SPIN.format(OVERLOAD_S)]
    for _ in range(BUSY * (os.cpu_count() or 1)):
        car.beside(subprocess.Popen(command, stdin=subprocess.DEVNULL))


def _disk_full(car: DrivingCar, random: Random) -> None:
    """By the system's limit of a file's size: the same calls fail in the same place as on a full disk."""
    full_bytes = car.recording.stat().st_size + random.randrange(4096)
    resource.prlimit(car.pid, resource.RLIMIT_FSIZE, (full_bytes, full_bytes))


def _board(how: str) -> Strike:
    return lambda car, random: getattr(car.board, how)(time.monotonic_ns())


REAL_FAULTS = (
    RealFault(name="real-killed", kind=Kind.OFF, must=Must.STOP, text="the program is killed (SIGKILL)",
              strike=_signalled(signal.SIGKILL)),
    RealFault(name="real-stopped", kind=Kind.STUCK, must=Must.STOP,
              text=f"the program is stopped for {PAUSE_S[0]:g} to {PAUSE_S[1]:g} s (SIGSTOP), as by a machine that"
                   " swaps, and goes on",
              strike=_stopped),
    RealFault(name="real-signal", kind=Kind.OFF, must=Must.STOP, ended=True, text="SIGINT or SIGTERM: it ends in order",
              strike=_signalled(signal.SIGINT, signal.SIGTERM)),
    RealFault(name="real-terminal", kind=Kind.OFF, must=Must.STOP, ended=True,
              text="its terminal is closed: it ends in order", strike=lambda car, random: car.close_terminal()),
    RealFault(name="real-unplugged", kind=Kind.OFF, must=Must.STOP, text="the board's cable is unplugged",
              strike=lambda car, random: car.unplug()),
    RealFault(name="real-board-hang", kind=Kind.STUCK, must=Must.STOP,
              text="the board's program hangs until its watchdog restarts it", strike=_board("hang")),
    RealFault(name="real-board-restart", kind=Kind.INTERMITTENT, must=Must.STOP, text="the board's supply dips",
              strike=_board("brown_out")),
    RealFault(name="real-overload", kind=Kind.SLOW, must=Must.HOLD, by_silence=True,
              text=f"{BUSY} busy processes a core for {OVERLOAD_S} s: the limit counts from the last fresh command",
              strike=_overloaded),
    RealFault(name="real-disk-full", kind=Kind.OFF, must=Must.NOTHING, text="no space is left for the recording",
              strike=_disk_full),
    RealFault(name="real-clock", kind=Kind.WRONG, must=Must.NOTHING,
              text="the wall clock, as Python sees it, is set back by an hour", strike=_signalled(STEP_CLOCK)),
)  # fmt: skip

CAR_TOML = """[camera]
source = "{source}"
width_px = 320
height_px = 180
[camera.intrinsics]
fx_px = 240.0
fy_px = 240.0
cx_px = 159.5
cy_px = 89.5
[link]
port = "{port}"
[recording]
image = "jpeg"
[pipeline]
name = "{pipeline}"
"""


def car_file(folder: Path, source: str, port: str, pipeline: str) -> Path:
    """A car.toml in `folder` for that camera, port and pipeline."""
    path = folder / "car.toml"
    with output_text(path) as file:
        file.write(CAR_TOML.format(source=source, port=port, pipeline=pipeline))
    return path
