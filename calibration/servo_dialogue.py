"""Finding a servo's centre and ends with keys: what each key does, as a value; the terminal is elsewhere.

`calibrate servo` by hand: keys move the servo, the board takes the ends for its limits.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
import select
import sys
import types
from dataclasses import dataclass, replace
from pathlib import Path

from automodel.assembly.calibration_rigs import car_to_calibrate, plant_of
from automodel.config import CarConfig, ConfigError, LinkConfig, ServoConfig
from automodel.console.keys import has_terminal
from automodel.console.messages import say
from automodel.runtime.clocks import NS_PER_S, MonotonicClock
from automodel.runtime.run_types import TickRecord
from automodel.runtime.safety import SafetyMode
from automodel.signals import Command, LaneEstimate, Motion, VehicleState
from automodel.sim.plant import Plant
from automodel.sim.randomised_plant import randomised_servo
from calibration.calibration_drive import DriveEnded, Rig, Ticks, Watch, run_chain
from calibration.calibration_output import write_values
from firmware_link.arduino import ArduinoLink
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.errors import LinkError
from firmware_link.pulses import PulseTable
from firmware_link.transport import MemoryTransport, SerialTransport, Transport

STEPS_US = {"left": -5.0, "right": 5.0, ",": -1.0, ".": 1.0, "[": -25.0, "]": 25.0}
HELP = (
    "arrows -/+5 us   , . -/+1   [ ] -/+25   c: straight ahead is here   l: the left end is here   r: the right end   "
    "g: go to straight   Enter: done   q: give up"
)
LEAST_SIDE_US = 50.0  # a side shorter than this is a slip of the finger


class DialogError(ValueError):
    """What was found is no servo; the text says why and what to do."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Dialog:
    """The pulse wanted now, what was found so far, and whether the person is done; `said` is one line for them."""

    low_us: float
    high_us: float
    pulse_us: float
    centre_us: float | None = None
    left_us: float | None = None
    right_us: float | None = None
    done: bool = False
    given_up: bool = False
    said: str = ""

    def key(self, key: str) -> Dialog:
        """The dialog after a key: one of `STEPS_US`, or c l r g, "enter", q; others change nothing."""
        now = replace(self, said="")
        if key in STEPS_US:
            pulse = min(max(self.pulse_us + STEPS_US[key], self.low_us), self.high_us)
            return replace(now, pulse_us=pulse, said="" if pulse != self.pulse_us else "no further: --span-us")
        if key == "c":
            return replace(now, centre_us=self.pulse_us)
        if key == "l":
            return replace(now, left_us=self.pulse_us)
        if key == "r":
            return replace(now, right_us=self.pulse_us)
        if key == "g" and self.centre_us is not None:
            return replace(now, pulse_us=self.centre_us)
        if key == "q":
            return replace(now, given_up=True)
        if key == "enter":
            try:
                ends_of(self)
            except DialogError as error:
                return replace(now, said=str(error))
            return replace(now, done=True)
        return now

    def line(self) -> str:
        """Where the servo is and what was found."""
        found = [f"{name} {'-' if us is None else f'{us:.0f}'}" for name, us in self._found()]
        return f"{self.pulse_us:6.0f} us   {'   '.join(found)}   {self.said}".rstrip()

    def _found(self) -> tuple[tuple[str, float | None], ...]:
        return ("left", self.left_us), ("straight", self.centre_us), ("right", self.right_us)


@dataclass(frozen=True, slots=True, kw_only=True)
class Ends:
    """A servo as it was found: pulses [us] of the left end, straight ahead, and the right end."""

    left_us: float
    centre_us: float
    right_us: float

    def table(self, left_rad: float, right_rad: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """(pulse_us, steering_rad) as `ServoConfig` has them, for the angles at the ends, both taken positive."""
        rows = sorted(((self.left_us, abs(left_rad)), (self.centre_us, 0.0), (self.right_us, -abs(right_rad))))
        return tuple(us for us, _ in rows), tuple(rad for _, rad in rows)


def ends_of(dialog: Dialog) -> Ends:
    """What was found; raises DialogError where something is missing or straight does not lie between the ends."""
    left, centre, right = dialog.left_us, dialog.centre_us, dialog.right_us
    if left is None or centre is None or right is None:
        missing = [f"{name} ({key})" for (name, us), key in zip(dialog._found(), "lcr", strict=True) if us is None]
        raise DialogError(f"still to be found: {', '.join(missing)}")
    if not min(left, right) < centre < max(left, right):
        raise DialogError(f"straight at {centre:.0f} us does not lie between the ends {left:.0f} and {right:.0f} us")
    shorter = min(abs(left - centre), abs(right - centre))
    if shorter < LEAST_SIDE_US:
        raise DialogError(f"one end is only {shorter:.0f} us from straight; {LEAST_SIDE_US:.0f} us at least are wanted")
    return Ends(left_us=left, centre_us=centre, right_us=right)


def keys_of(text: str) -> list[str]:
    """The keys in what a terminal sent: single characters, "enter", and the arrows "left" and "right"."""
    keys, i = [], 0
    while i < len(text):
        if text.startswith(("\x1b[", "\x1bO"), i):
            keys.append({"C": "right", "D": "left"}.get(text[i + 2 : i + 3], "other"))
            i += 3
            continue
        keys.append("enter" if text[i] in "\r\n" else text[i])
        i += 1
    return keys


def side_angles(steering_rad: tuple[float, ...], ends_deg: tuple[float | None, float | None]) -> tuple[float, float]:
    """The angles [rad] at the left and right end: as given [deg], or those that the table had so far."""
    left = max(steering_rad) if ends_deg[0] is None else math.radians(ends_deg[0])
    right = -min(steering_rad) if ends_deg[1] is None else math.radians(ends_deg[1])
    return left, right


NO_TERMINAL = "no terminal: the servo is moved by keys; run it in one (ssh -t), or see --manual and --auto"
MIDDLE_US = 1500.0
RAD_PER_US = 1e-3  # by hand an angle is a pulse in disguise, so that a limit of the steering's rate still holds
_CONFIRM_S = 8.0  # a board that was just opened starts anew, and says hello after its bootloader


class Terminal:
    """The keys of a terminal, one by one and without waiting; as a context it takes it over and gives it back.

    Raises ConfigError where there is no terminal. Ctrl-C stays a signal.
    """

    def __enter__(self) -> Terminal:
        if not has_terminal():
            raise ConfigError(NO_TERMINAL)
        import termios
        import tty

        self._number = sys.stdin.fileno()
        self._before = termios.tcgetattr(self._number)
        tty.setcbreak(self._number)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: types.TracebackType | None
    ) -> None:
        """Give the terminal back as it was."""
        import termios

        with contextlib.suppress(termios.error, OSError):  # it is gone
            termios.tcsetattr(self._number, termios.TCSADRAIN, self._before)

    def pressed(self) -> list[str]:
        """The keys since the last call; "q" where the terminal is gone."""
        try:
            if not select.select([self._number], [], [], 0)[0]:
                return []
            data = os.read(self._number, 256)
        except OSError:
            return ["q"]
        return keys_of(data.decode("utf-8", "replace")) if data else ["q"]


class Nudger:
    """Implements `Controller`: the servo where the dialog wants it, the motor in neutral."""

    def __init__(self, dialog: Dialog, validity_s: float) -> None:
        self.dialog = dialog
        self._validity_ns = round(validity_s * NS_PER_S)

    def step(self, estimate: LaneEstimate, motion: Motion, state: VehicleState | None, t_ns: int) -> Command:
        """The pulse in disguise."""
        steering = (MIDDLE_US - self.dialog.pulse_us) * RAD_PER_US
        return Command(t_ns=t_ns, steering_rad=steering, speed_mps=0.0, valid_until_ns=t_ns + self._validity_ns)

    def reset(self) -> None:
        """Nothing: the dialog goes on."""


def calibrate_by_hand(
    car_file: Path | None,
    *,
    simulated: bool,
    span_us: float,
    ends_deg: tuple[float | None, float | None],
    dry_run: bool,
) -> int:
    """Let a person find the servo, tell the board and write it; raises DriveEnded, ConfigError, OSError."""
    with Terminal() as terminal:
        car, simulated = car_to_calibrate(car_file, simulated, dry_run)
        transport = _transport(car, simulated)
        ends = _found(_disguised(car, span_us), transport, terminal, _straight_us(car, span_us))
    left, right = side_angles(car.link.servo.steering_rad, ends_deg)
    pulse_us, steering_rad = ends.table(left, right)
    servo = ServoConfig(pulse_us=pulse_us, steering_rad=steering_rad)
    _tell_board(dataclasses.replace(car.link, servo=servo), car, transport)
    say(f"the board keeps to {pulse_us[0]:.0f} .. {pulse_us[-1]:.0f} us now, straight at {ends.centre_us:.0f} us")
    if car_file is not None:
        known = " and ".join(
            f"the {side} angle is {'given' if deg is not None else 'that of before'}"
            for side, deg in zip(("left", "right"), ends_deg, strict=True)
        )
        write_values(
            car_file,
            {"link.servo": {"pulse_us": pulse_us, "steering_rad": steering_rad}},
            residual=f"{known}; see --manual or --auto",
            method="centre and ends found by eye",
            dry_run=dry_run,
        )
    return 0


def _disguised(car: CarConfig, span_us: float) -> CarConfig:
    """The car with a table that turns pulses into angles and back, within `span_us` of 1500 us."""
    span_rad = span_us * RAD_PER_US
    servo = ServoConfig(
        pulse_us=(MIDDLE_US - span_us, MIDDLE_US, MIDDLE_US + span_us), steering_rad=(span_rad, 0.0, -span_rad)
    )
    return dataclasses.replace(
        car,
        link=dataclasses.replace(car.link, servo=servo),
        safety=dataclasses.replace(car.safety, steering_max_rad=span_rad),
    )


def _straight_us(car: CarConfig, span_us: float) -> float:
    """Where car.toml believes straight ahead to be: the place to begin."""
    believed = PulseTable(car.link.servo.pulse_us, car.link.servo.steering_rad).zero_us
    return min(max(believed, MIDDLE_US - span_us), MIDDLE_US + span_us)


def _transport(car: CarConfig, simulated: bool) -> Transport:
    if not simulated:
        return SerialTransport(car.link.port, car.link.baud)
    plant = Plant(randomised_servo(0, plant_of(car, 0)))
    return MemoryTransport(EmulatedArduino(plant, car.link.baud), MonotonicClock())


def _found(car: CarConfig, transport: Transport, terminal: Terminal, start_us: float) -> Ends:
    """Run the chain with the person at the keys until they are done; raises DriveEnded where they give up."""
    servo = car.link.servo
    nudger = Nudger(
        Dialog(low_us=servo.pulse_us[0], high_us=servo.pulse_us[-1], pulse_us=start_us), car.safety.command_validity_s
    )
    asked: list[bool] = []

    def listen(record: TickRecord) -> None:
        before = nudger.dialog
        for key in terminal.pressed():
            if key == "q":
                nudger.dialog = nudger.dialog.key(key)
            elif record.decision.mode is not SafetyMode.DRIVING:
                if key == "enter":
                    asked.append(True)
            elif not nudger.dialog.done:
                nudger.dialog = nudger.dialog.key(key)
        if nudger.dialog != before:
            say(nudger.dialog.line())

    def arm() -> bool:
        return bool(asked) and asked.pop()

    def stop() -> bool:
        return nudger.dialog.done or nudger.dialog.given_up

    clock = MonotonicClock()
    rig = Rig(source=Ticks(clock), link=ArduinoLink(transport, car.link, car.vehicle), clock=clock, auto_arm=False)
    say(f"the motor stays in neutral; lift the front wheels. Enter arms, then: {HELP}")
    run_chain(rig, car, nudger, arm=arm, stop=stop, watch=Watch(listen))
    if nudger.dialog.given_up:
        raise DriveEnded("given up")
    return ends_of(nudger.dialog)


def _tell_board(link_config: LinkConfig, car: CarConfig, transport: Transport) -> None:
    """Hand the limits over to the disarmed board, which keeps them; raises OSError where it does not take them."""
    clock = MonotonicClock()
    link = ArduinoLink(transport, link_config, car.vehicle)
    link.open()
    try:
        end_ns = clock.now_ns() + round(_CONFIRM_S * NS_PER_S)
        while link.poll(clock.now_ns()) is None:
            if clock.now_ns() > end_ns:
                raise LinkError(f"{link_config.port}: the board has not taken the limits over; nothing was written")
            clock.sleep(0.01)
    finally:
        link.close()
