"""`calibrate servo` by hand: keys move the servo, the board takes the ends for its limits."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import select
import sys
import types
from pathlib import Path

from automodel.cli.calibration_drive import DriveEnded, Rig, Ticks, Watch, run_chain
from automodel.cli.calibration_output import write_values
from automodel.cli.calibration_rigs import car_to_calibrate, plant_of
from automodel.cli.keys import has_terminal
from automodel.cli.telling import say
from automodel.clocks import NS_PER_S, MonotonicClock
from automodel.config import CarConfig, ConfigError, LinkConfig, ServoConfig
from automodel.run_values import TickRecord
from automodel.safety import SafetyMode
from automodel.signals import Command, LaneEstimate, Motion, VehicleState
from automodel.sim.hidden import hidden_servo
from automodel.sim.plant import Plant
from calibration.servo_dialog import HELP, Dialog, Ends, ends_of, keys_of, side_angles
from firmware_link.arduino import ArduinoLink
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.errors import LinkError
from firmware_link.pulses import PulseTable
from firmware_link.transport import MemoryTransport, SerialTransport, Transport

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
    plant = Plant(hidden_servo(0, plant_of(car, 0)))
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
