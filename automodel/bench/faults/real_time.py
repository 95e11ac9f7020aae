"""`bench faults --real-time`: `automodel run` as a process of its own, a board on a pseudo terminal, the real clock."""

from __future__ import annotations

import contextlib
import functools
import itertools
import os
import re
import select
import signal
import subprocess
import sys
import tempfile
import threading
import time
import tty
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random
from typing import Any

from automodel.bench.accuracy import Row
from automodel.bench.faults.catalogue import named
from automodel.bench.faults.fault import Must
from automodel.bench.faults.measure import Case, reaction_row
from automodel.bench.faults.real_car import SOURCE
from automodel.bench.faults.real_catalogue import OVERLOAD_S, REAL_FAULTS, RealFault, car_file
from automodel.console.messages import say
from automodel.console.workers import Sweep, Tick, spread
from firmware_link import messages
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.emulator.logic import BoardOptions
from firmware_link.emulator.pty import BenchPeripherals, PtyBoard
from firmware_link.messages import Command, CommandFlag

REAL_COLUMNS = ("fault", "runs", "violations", "reaction_p50_ms", "reaction_max_ms", "disturbed")
NEUTRAL_US = 1500.0
PATIENCE_S = 180.0  # until the program drives; nothing is judged by it
ENDS_S = 10.0  # a program that must end has ended by then, its recording closed
HELD_UP_NS = 10_000_000  # a step of the board's thread that comes so late makes a violation worth nothing
AFTER_S = 0.7  # the car is watched for so long: longer than one that is well takes to be armed again
DRIVES_S = (0.3, 0.8)  # before the fault
TRIES = 4  # of a run in which the machine held the board up
_NICE = -19  # of the board's thread, where it may: a board has a processor of its own


class _Heard:
    """A board that notes when fresh commands come that turn the motor."""

    def __init__(self, board: EmulatedArduino) -> None:
        self.board = board
        self.driven_ns: list[int] = []
        self.room, self.transmit, self.advance = board.room, board.transmit, board.advance
        self._decoder = messages.decoder(on_board=True)

    def reset(self, now_ns: int) -> None:
        self._decoder.reset()
        self.board.reset(now_ns)

    def receive(self, data: bytes, now_ns: int) -> int:
        for message in map(messages.decode, self._decoder.feed(data)):
            if isinstance(message, Command) and message.flags & CommandFlag.FRESH and message.motor_us != NEUTRAL_US:
                self.driven_ns.append(now_ns)
        return self.board.receive(data, now_ns)


class _Clock:
    """The monotonic clock, and the longest time between two steps of the board since `late_ns` was last set to 0."""

    def __init__(self) -> None:
        self._last_ns, self.late_ns, self._favoured = time.monotonic_ns(), 0, False

    def __call__(self) -> int:
        if not self._favoured:
            self._favoured = True
            with contextlib.suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
        now_ns = time.monotonic_ns()
        self.late_ns = max(self.late_ns, now_ns - self._last_ns)
        self._last_ns = now_ns
        return now_ns


class RealCar:
    """The program, its terminal and its board; a context. It arms itself once, as soon as all is well."""

    def __init__(self, folder: Path, pipeline: str) -> None:
        self._recording = folder / "run.mcap"
        self._said = bytearray()
        self._beside: list[subprocess.Popen[bytes]] = []
        self._timers: list[threading.Timer] = []
        self._peripherals = BenchPeripherals()
        self._peripherals.pulses = deque()
        self._clock = _Clock()
        self._line = _Heard(EmulatedArduino(self._peripherals, options=BoardOptions(boot_ns=50_000_000)))
        self._pty = PtyBoard(self._line, clock=self._clock)
        self._reading = threading.Lock()
        self._terminal, slave = os.openpty()
        tty.setraw(slave)
        car = car_file(folder, SOURCE, self._pty.path, pipeline)
        command = [sys.executable, "-m", "automodel.bench.faults.real_car", os.ttyname(slave), "run"]
        command += ["--car", str(car), "--record", str(self._recording), "--arm"]
        self._pty.start()
        self._child = subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)
        os.close(slave)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def __enter__(self) -> RealCar:
        return self

    def __exit__(self, *_: object) -> None:
        """End everything, however it stands."""
        for timer in self._timers:
            timer.cancel()
        for process in (*self._beside, self._child):
            if process.poll() is None:
                process.send_signal(signal.SIGKILL)
            process.wait()
        self.close_terminal()
        self._pty.close()

    @property
    def recording(self) -> Path:
        """The file that it writes."""
        return self._recording

    @property
    def pid(self) -> int:
        """The program's process."""
        return self._child.pid

    @property
    def board(self) -> EmulatedArduino:
        """The board."""
        return self._line.board

    @property
    def said(self) -> str:
        """The last line on the terminal, but for its progress."""
        lines = re.split(r"[\r\n]+", bytes(self._said).decode(errors="replace"))
        return next((line.strip() for line in reversed(lines) if line.strip() and "\x1b[" not in line), "nothing")

    @property
    def ended(self) -> bool:
        """Whether the program has ended."""
        return self._child.poll() is not None

    @property
    def wrong(self) -> str | None:
        """How the program that ended did so not in order; None where it ended well."""
        try:
            code = self._child.wait(ENDS_S)
        except subprocess.TimeoutExpired:
            return f"it had not ended after {ENDS_S:g} s"
        if b"Traceback" in self._said:
            return "it ended with a traceback"
        return None if code in (0, 1) else f"it ended with {code}"

    def kill(self, number: int) -> None:
        """Send a signal; nothing where it has ended."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, number)

    def unplug(self) -> None:
        """Unplug the board's cable."""
        self._pty.unplug()

    def close_terminal(self) -> None:
        """Close the terminal's other end, as a window or a remote connection does."""
        with self._reading:
            terminal, self._terminal = self._terminal, -1
            if terminal >= 0:
                os.close(terminal)

    def beside(self, process: subprocess.Popen[bytes]) -> None:
        """A process that ends with the run."""
        self._beside.append(process)

    def later(self, seconds: float, what: Callable[[], None]) -> None:
        """Do it after so long."""
        self._timers.append(threading.Timer(seconds, what))
        self._timers[-1].start()

    def drive(self) -> bool:
        """Wait until it drives, or has driven: it may have been stopped already. False where it never does."""
        given_up_s = time.monotonic() + PATIENCE_S
        driven = False
        while not driven and time.monotonic() < given_up_s and self._child.poll() is None:
            time.sleep(0.02)
            driven = any(drives for _, drives in self.watched()[0])
        return driven

    def struck(self, strike: Callable[[], None]) -> int | None:
        """Let it happen between two steps of the board; when, or None where the car did not drive."""
        at_ns: list[int] = []

        def happen() -> None:
            if self._drives:
                self._clock.late_ns = 0
                at_ns.append(time.monotonic_ns())
                strike()

        self._pty.call(happen)
        return at_ns[0] if at_ns else None

    def watched(self) -> tuple[list[tuple[int, bool]], list[int], int]:
        """When which servo frame began and whether the motor turned by it; when commands came; the board's delay."""
        noted: list[Any] = []
        self._pty.call(lambda: noted.extend((list(self._peripherals.pulses), list(self._line.driven_ns))))
        return [(t_ns, _turns(motor_us)) for t_ns, _, motor_us in noted[0]], noted[1], self._clock.late_ns

    @property
    def _drives(self) -> bool:
        return _turns(self._peripherals.at_pins[1])

    def _read(self) -> None:
        """Take what the program says, or it would wait; before it has opened the terminal there is only an error."""
        while True:
            with self._reading:
                if self._terminal < 0:
                    return
                with contextlib.suppress(OSError):
                    if select.select([self._terminal], [], [], 0.0)[0]:
                        self._said += os.read(self._terminal, 65536)
            time.sleep(0.005)


def _turns(motor_us: float) -> bool:
    return motor_us not in (0.0, NEUTRAL_US)


@dataclass(frozen=True, slots=True, kw_only=True)
class RealVerdict:
    """What went wrong in a run, the time to neutral [s], and how often the run was repeated."""

    violations: tuple[str, ...]
    reaction_s: float | None
    disturbed: int = 0


def judge_real(
    fault: RealFault, struck_ns: int, pulses: Sequence[tuple[int, bool]], commands: Sequence[int]
) -> RealVerdict:
    """The verdict on the servo frames since before the fault, and the times of the commands that turn the motor."""
    after = [(t_ns, turns) for t_ns, turns in pulses if t_ns > struck_ns]
    if fault.must is Must.NOTHING:
        rests = [t_ns for t_ns, turns in after if not turns]
        text = [f"neutral {(rests[0] - struck_ns) * 1e-9:.2f} s after the fault"] if rests else []
        return RealVerdict(violations=tuple(text), reaction_s=None)
    if fault.by_silence:
        reactions_ns = list(_silences(after, commands))
    else:
        driven = [t_ns for t_ns, turns in after if turns]
        last_ns = driven[-1] if driven else struck_ns
        neutral_ns = next((t_ns for t_ns, turns in after if t_ns > last_ns and not turns), None)
        if neutral_ns is None:
            return RealVerdict(violations=("the motor's pin never went neutral",), reaction_s=None)
        reactions_ns = [neutral_ns - struck_ns]
    reaction_s = max(reactions_ns) * 1e-9 if reactions_ns else None
    late = reaction_s is not None and reaction_s > fault.within_s
    text = [f"neutral after {reaction_s * 1e3:.0f} ms"] if reaction_s is not None and late else []
    return RealVerdict(violations=tuple(text), reaction_s=reaction_s)


def _silences(pulses: Sequence[tuple[int, bool]], commands: Sequence[int]) -> Iterator[int]:
    """From the last command that turned the motor to each neutral [ns]."""
    for (_, turned), (t_ns, turns) in itertools.pairwise(pulses):
        if turned and not turns:
            yield t_ns - max((command for command in commands if command < t_ns), default=t_ns)


def run_real(fault: RealFault, pipeline: str, seed: int, index: int) -> RealVerdict:
    """The verdict on the fault's run number `index`; a run in which the machine held the board up is repeated."""
    for attempt in range(TRIES):
        random = Random(f"{seed}/{fault.name}/{index}/{attempt}")
        with tempfile.TemporaryDirectory(prefix="faults-") as folder, RealCar(Path(folder), pipeline) as car:
            verdict = _observed(fault, car, random)
        if verdict is not None:
            return replace(verdict, disturbed=max(verdict.disturbed, attempt))
    return RealVerdict(violations=(), reaction_s=None, disturbed=TRIES)


def _observed(fault: RealFault, car: RealCar, random: Random) -> RealVerdict | None:
    """The verdict, None where the board was held up, or a busy machine had stopped the car before the fault was due.

    One of a car that was not armed in time, as on a machine that is too busy, says nothing.
    """
    if not car.drive():
        ended = (f"it ended before it drove: {car.said}",) if car.ended else ()
        return RealVerdict(violations=ended, reaction_s=None, disturbed=0 if ended else TRIES)
    time.sleep(random.uniform(*DRIVES_S))
    struck_ns = car.struck(lambda: fault.strike(car, random))
    if struck_ns is None:
        return None
    time.sleep(AFTER_S + (OVERLOAD_S if fault.by_silence else 0.0))
    pulses, commands, late_ns = car.watched()
    verdict = judge_real(fault, struck_ns, pulses, commands)
    if verdict.violations and late_ns > HELD_UP_NS:
        return None  # what a board gets late it obeys late: that makes a reaction longer, and never shorter
    if verdict.violations:
        verdict = replace(verdict, violations=(f"{verdict.violations[0]} ({car.said})",))
    wrong = car.wrong if fault.ended else None
    return verdict if wrong is None else replace(verdict, violations=(*verdict.violations, wrong))


def measure_real(names: Sequence[str], runs: int, seed: int, pipeline: str, sweep: Sweep) -> list[Row]:
    """A row a fault, `runs` in all shared out evenly, one after the other; violations are reported on stderr.

    Raises ConfigError for an unknown fault.
    """
    faults = named(names, REAL_FAULTS) if names else REAL_FAULTS
    cases = [Case(faults[number % len(faults)].name, number // len(faults)) for number in range(runs)]
    verdicts: dict[str, list[RealVerdict]] = {case.name: [] for case in cases}
    work = functools.partial(_verdict, pipeline, seed)
    for case, verdict in spread("bench faults", work, cases, replace(sweep, jobs=1)):
        verdicts[case.name].append(verdict)
        if verdict.violations:
            say(f"{case.name}, run {case.index} of seed {seed}: {'; '.join(verdict.violations)}")
    lost = sum(verdict.disturbed == TRIES for judged in verdicts.values() for verdict in judged)
    if lost:
        say(
            f"{lost} runs say nothing: the machine held the board up {TRIES} times, or did not arm the car in"
            f" {PATIENCE_S:g} s; is it busy with other work?"
        )
    return [_row(name, judged) for name, judged in verdicts.items() if judged]


def _verdict(pipeline: str, seed: int, case: Case, tick: Tick) -> RealVerdict:
    (fault,) = named((case.name,), REAL_FAULTS)
    verdict = run_real(fault, pipeline, seed, case.index)
    tick(1.0)
    return verdict


def _row(name: str, verdicts: Sequence[RealVerdict]) -> Row:
    judged = [verdict for verdict in verdicts if verdict.disturbed < TRIES]
    violations = sum(bool(verdict.violations) for verdict in judged)
    reactions_s = [verdict.reaction_s for verdict in judged]
    disturbed = sum(verdict.disturbed for verdict in verdicts)
    return {**reaction_row(name, len(judged), violations, reactions_s), "disturbed": disturbed}
