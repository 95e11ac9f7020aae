"""`calibrate servo` without a drive: centre and ends found with keys, or a table from circles measured on the floor."""

from __future__ import annotations

import contextlib
import math
import os
import select
import sys
import types
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from automodel.config import CarConfig, ConfigError, ServoConfig, load_car
from automodel.console.keys import has_terminal
from automodel.console.messages import say
from automodel.console.tables import show
from automodel.runtime.clocks import NS_PER_S
from automodel.runtime.run_types import TickRecord
from automodel.runtime.safety import SafetyMode
from automodel.signals import Command, LaneEstimate, Motion, VehicleState
from calibration.car_file import check_car_file, write_values
from calibration.drive import DriveEnded, Rig, RigMaker, StopWatch, run_chain
from calibration.servo_circles import parse_circle, read_circles, rear_middle_diameter_m, table_of_circles
from firmware_link.errors import LinkError
from firmware_link.pulses import PulseTable

STEPS_US = {"left": -5.0, "right": 5.0, ",": -1.0, ".": 1.0, "[": -25.0, "]": 25.0}
HELP = (
    "arrows -/+5 us   , . -/+1   [ ] -/+25   c: straight ahead is here   l: the left end is here   r: the right end   "
    "g: go to straight   Enter: done   q: give up"
)
LEAST_SIDE_US = 50.0  # from straight to an end; less is a key pressed by mistake


class DialogError(ValueError):
    """The pulses found do not make a servo; the text says why and what to do."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Dialog:
    """The pulse to set, the pulses found so far, and whether the person is done; `said` is a message to them."""

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
        """The dialog after a key: one of `STEPS_US`, or c l r g, "enter", q; other keys change nothing."""
        now = replace(self, said="")
        if key in STEPS_US:
            pulse = min(max(self.pulse_us + STEPS_US[key], self.low_us), self.high_us)
            return replace(now, pulse_us=pulse, said="" if pulse != self.pulse_us else "limit reached; see --span-us")
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
        """The pulse now and the pulses found, on one line."""
        found = [f"{name} {'-' if us is None else f'{us:.0f}'}" for name, us in self._found()]
        return f"{self.pulse_us:6.0f} us   {'   '.join(found)}   {self.said}".rstrip()

    def _found(self) -> tuple[tuple[str, float | None], ...]:
        return ("left", self.left_us), ("straight", self.centre_us), ("right", self.right_us)


@dataclass(frozen=True, slots=True, kw_only=True)
class Ends:
    """A servo's pulses [us] at the left end, straight ahead and at the right end."""

    left_us: float
    centre_us: float
    right_us: float

    def table(self, left_rad: float, right_rad: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """(pulse_us, steering_rad) for `ServoConfig`, from the sizes of the angles at the ends."""
        rows = sorted(((self.left_us, abs(left_rad)), (self.centre_us, 0.0), (self.right_us, -abs(right_rad))))
        return tuple(us for us, _ in rows), tuple(rad for _, rad in rows)


def ends_of(dialog: Dialog) -> Ends:
    """The servo found; raises DialogError where a pulse is missing or straight does not lie between the ends."""
    left, centre, right = dialog.left_us, dialog.centre_us, dialog.right_us
    if left is None or centre is None or right is None:
        missing = [f"{name} ({key})" for (name, us), key in zip(dialog._found(), "lcr", strict=True) if us is None]
        raise DialogError(f"still to be found: {', '.join(missing)}")
    if not min(left, right) < centre < max(left, right):
        raise DialogError(f"straight at {centre:.0f} us does not lie between the ends {left:.0f} and {right:.0f} us")
    shorter = min(abs(left - centre), abs(right - centre))
    if shorter < LEAST_SIDE_US:
        raise DialogError(f"one end is only {shorter:.0f} us from straight; expected at least {LEAST_SIDE_US:.0f} us")
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
    """The angles [rad] at the left and right end: as given [deg], or those of the table `steering_rad`."""
    left = max(steering_rad) if ends_deg[0] is None else math.radians(ends_deg[0])
    right = -min(steering_rad) if ends_deg[1] is None else math.radians(ends_deg[1])
    return left, right


NO_TERMINAL = "no terminal: the servo is moved by keys; run it in one (ssh -t), or see --manual and --auto"
MIDDLE_US = 1500.0
RAD_PER_US = 1e-3  # pulses travel as angles, so that the limit of the steering rate applies to them, too
_CONFIRM_S = 8.0  # a board restarts when its port is opened, and its bootloader runs first


class Terminal:
    """Reads single keys from a terminal without waiting; the context sets the terminal up and restores it.

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
        """Restore the terminal."""
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
    """Implements `Controller`: the servo at the dialog's pulse, the motor in neutral."""

    def __init__(self, dialog: Dialog, validity_s: float) -> None:
        self.dialog = dialog
        self._validity_ns = round(validity_s * NS_PER_S)

    def step(self, estimate: LaneEstimate, motion: Motion, state: VehicleState | None, t_ns: int) -> Command:
        """The pulse, as an angle."""
        steering = (MIDDLE_US - self.dialog.pulse_us) * RAD_PER_US
        return Command(t_ns=t_ns, steering_rad=steering, speed_mps=0.0, valid_until_ns=t_ns + self._validity_ns)

    def reset(self) -> None:
        """Keeps the dialog."""


def calibrate_by_hand(
    car: CarConfig,
    car_file: Path | None,
    open_rig: RigMaker,
    *,
    span_us: float,
    ends_deg: tuple[float | None, float | None],
    dry_run: bool,
) -> int:
    """Let a person find the servo, set the board's limits and write it; raises DriveEnded, ConfigError, OSError."""
    with Terminal() as terminal, open_rig(_by_pulses(car, span_us)) as rig:
        ends = _find(rig, terminal, _straight_us(car, span_us))
    left, right = side_angles(car.link.servo.steering_rad, ends_deg)
    pulse_us, steering_rad = ends.table(left, right)
    servo = ServoConfig(pulse_us=pulse_us, steering_rad=steering_rad)
    with open_rig(replace(car, link=replace(car.link, servo=servo))) as rig:
        _set_limits(rig)
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


def _by_pulses(car: CarConfig, span_us: float) -> CarConfig:
    """The car with a table that turns pulses within `span_us` of 1500 us into angles and back."""
    span_rad = span_us * RAD_PER_US
    servo = ServoConfig(
        pulse_us=(MIDDLE_US - span_us, MIDDLE_US, MIDDLE_US + span_us), steering_rad=(span_rad, 0.0, -span_rad)
    )
    return replace(car, link=replace(car.link, servo=servo), safety=replace(car.safety, steering_max_rad=span_rad))


def _straight_us(car: CarConfig, span_us: float) -> float:
    """The pulse for straight ahead by car.toml: where the search starts."""
    believed = PulseTable(car.link.servo.pulse_us, car.link.servo.steering_rad).zero_us
    return min(max(believed, MIDDLE_US - span_us), MIDDLE_US + span_us)


def _find(rig: Rig, terminal: Terminal, start_us: float) -> Ends:
    """Run the car with the person at the keys until they are done; raises DriveEnded where they give up."""
    servo = rig.car.link.servo
    dialog = Dialog(low_us=servo.pulse_us[0], high_us=servo.pulse_us[-1], pulse_us=start_us)
    nudger = Nudger(dialog, rig.car.safety.command_validity_s)
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

    say(f"the motor stays in neutral; lift the front wheels. Enter arms, then: {HELP}")
    run_chain(rig, nudger, arm=arm, stop=stop, watch=StopWatch(listen))
    if nudger.dialog.given_up:
        raise DriveEnded("given up")
    return ends_of(nudger.dialog)


def _set_limits(rig: Rig) -> None:
    """Send the limits of car.toml to the disarmed board, which keeps them; raises OSError where it does not."""
    rig.link.open()
    try:
        end_ns = rig.clock.now_ns() + round(_CONFIRM_S * NS_PER_S)
        while rig.link.poll(rig.clock.now_ns()) is None:
            if rig.clock.now_ns() > end_ns:
                raise LinkError(f"{rig.car.link.port}: the board did not accept the limits; nothing was written")
            rig.clock.sleep(0.01)
    finally:
        rig.link.close()


def calibrate_by_circles(
    car_file: Path | None,
    circles: Sequence[str],
    circles_file: Path | None,
    *,
    outer_front: bool,
    dry_run: bool,
    as_json: bool,
) -> int:
    """Read the circles, make the table and write it; on ConfigError and CircleError car.toml is unchanged."""
    if car_file is None:
        raise ConfigError("--car: which car? Name its car.toml")
    if not dry_run:
        check_car_file(car_file)
    vehicle = load_car(car_file).vehicle
    measured = [parse_circle(f"--circle {text}", text.split(",")) for text in circles]
    if circles_file is not None:
        measured += read_circles(circles_file)
    if outer_front:
        measured = [
            replace(c, diameter_m=rear_middle_diameter_m(c.diameter_m, vehicle.wheelbase_m, vehicle.width_m))
            if c.side != "straight"
            else c
            for c in measured
        ]
    table = table_of_circles(measured, vehicle.wheelbase_m)
    rms_deg = None if table.rms_rad is None else math.degrees(table.rms_rad)
    write_values(
        car_file,
        {"link.servo": {"pulse_us": table.pulse_us, "steering_rad": table.steering_rad}},
        residual="no circle was repeated" if rms_deg is None else f"repeats scatter {rms_deg:.2f} deg",
        method=f"{len(measured)} circles measured by hand",
        dry_run=dry_run,
    )
    row = {
        "centre_us": table.centre_us,
        "left_deg": math.degrees(max(table.steering_rad)),
        "right_deg": -math.degrees(min(table.steering_rad)),
        "rms_deg": rms_deg,
        "circles": len(measured),
    }
    show("calibrate servo", [row], as_json)
    return 0
