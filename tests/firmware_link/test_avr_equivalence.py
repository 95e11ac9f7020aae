"""The firmware on the simulated chip and the emulated board say and do the same."""

from __future__ import annotations

import dataclasses
import random
from typing import Any

import numpy as np
import pytest

from firmware_link import messages
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.emulator.logic import BoardOptions
from firmware_link.emulator.pty import BenchPeripherals
from firmware_link.messages import Arm, Command, Limits, ResetCause

MS = 1_000_000
US = 1_000
CLOCK_TO_PULSES_NS = 30 * US  # from the start of the clock to the first pulses in their registers
BYTE_NS = 10_000_000_000 / 115200
LIMITS = Limits(
    servo_min_us=1100.0,
    servo_straight_us=1520.0,
    servo_max_us=1900.0,
    motor_min_us=1400.0,
    motor_neutral_us=1510.0,
    motor_max_us=1600.0,
    servo_slew_us=40.0,
    motor_slew_us=20.0,
)


class Twins:
    """The firmware and the emulated board, fed the same frames at the same times of their programs."""

    def __init__(self, avr: Any, seed: int) -> None:
        self.rng = random.Random(seed)
        self.avr = avr
        began_ns = self._restart_with_limits()
        self.start_ns = avr.registers[-1].t_ns - CLOCK_TO_PULSES_NS
        options = BoardOptions(boot_ns=self.start_ns - began_ns, boot_id=2, limits=LIMITS)
        self.emulated = EmulatedArduino(BenchPeripherals(), options=options)
        self.emulated.reset(began_ns, ResetCause.BROWN_OUT)
        self.decoder = messages.decoder(on_board=False)
        self.said: list[messages.Message] = []
        self.t_ns = began_ns + 5 * MS
        self.counter = 0

    def _restart_with_limits(self) -> int:
        """Give the chip's EEPROM limits, and restart it; when that was."""
        self.avr.advance(0)
        self.avr.advance(5 * MS)
        self.avr.receive(messages.encode(LIMITS, 0), 5 * MS)
        self.avr.advance(150 * MS)
        self.avr.transmit(150 * MS)
        self.avr.brown_out(150 * MS)
        self.avr.said.clear()
        self.avr.pulses.clear()
        self.avr.advance(155 * MS)
        return 150 * MS

    def wait(self, ns: int) -> None:
        end_ns = self.t_ns + ns
        while self.t_ns < end_ns:
            self.t_ns = min(self.t_ns + 5 * MS, end_ns)
            for board in (self.avr, self.emulated):
                board.advance(self.t_ns)
            self.avr.transmit(self.t_ns)
            self.said += map(messages.decode, self.decoder.feed(self.emulated.transmit(self.t_ns)))

    def send(self, frame: bytes) -> None:
        """So that the last bit arrives in the middle of a millisecond of the board's."""
        into_ms = round(0.5 * MS - len(frame) * BYTE_NS) % MS
        self.wait((into_ms - (self.t_ns - self.start_ns)) % MS)
        for board in (self.avr, self.emulated):
            board.receive(frame, self.t_ns)

    def restart(self) -> None:
        self.wait(120 * MS)  # the limits are in the EEPROM
        for board in (self.avr, self.emulated):
            board.brown_out(self.t_ns)
        before_ns = self.t_ns
        self.wait(5 * MS)
        self.start_ns = self.emulated._start_ns
        began_ns = next(w.t_ns for w in self.avr.registers if w.t_ns > before_ns)
        assert abs(began_ns - CLOCK_TO_PULSES_NS - self.start_ns) < 100 * US

    def message(self) -> messages.ToBoard:
        rng, logic = self.rng, self.emulated._logic
        kind = rng.choices(["command", "arm", "disarm", "limits", "hello"], [60, 10, 2, 3, 1])[0]
        if kind == "command":
            t_ms = (self.t_ns - self.start_ns) // MS
            ahead_ms = rng.choice([-5, 50, 90, 90, 90, 90, 140, 170])
            flags = rng.choices([1, 0, 2], [90, 7, 3])[0]
            servo_us, motor_us = rng.uniform(900.0, 2100.0), rng.choice([1500.0, rng.uniform(900.0, 2100.0), 400.0])
            return Command(servo_us=servo_us, motor_us=motor_us, deadline_ms=t_ms + ahead_ms & 0xFFFF, flags=flags)
        if kind == "arm":
            return Arm(nonce=logic.arming.nonce + rng.choice([0, 0, 0, 1]) & 0xFFFF, boot_id=self.emulated.boot_id)
        if kind == "limits":
            return dataclasses.replace(
                LIMITS, servo_slew_us=rng.choice([0.0, 8.0, 80.0]), motor_max_us=rng.uniform(1400.0, 2000.0)
            )
        return messages.Disarm() if kind == "disarm" else messages.HelloRequest()


@pytest.mark.parametrize("seed", [1, 2])
def test_the_firmware_says_and_does_what_the_emulated_board_does(avr: Any, seed: int) -> None:
    avr._peripherals.sensors = dataclasses.replace(avr._peripherals.sensors, battery_v=0.0)
    twins = Twins(avr, seed)
    twins.emulated._peripherals.sensors = avr._peripherals.sensors  # type: ignore[attr-defined]
    for index in range(300):
        twins.counter = (twins.counter + twins.rng.choices([1, 0, 3], [90, 5, 5])[0]) & 0xFF
        frame = bytearray(messages.encode(twins.message(), twins.counter))
        if twins.rng.random() < 0.05:
            frame[twins.rng.randrange(len(frame))] ^= 1 << twins.rng.randrange(8)
        twins.send(bytes(frame))
        twins.wait(twins.rng.randrange(2, 25) * MS)
        if index % 100 == 60:
            twins.restart()
    twins.wait(200 * MS)
    statuses = [message for message in twins.said if isinstance(message, messages.Status)]
    assert np.bitwise_or.reduce([status.faults for status in statuses]) & 0b110011111 == 0b110011111
    assert {status.flags for status in statuses} == {0, 1}
    count = min(len(twins.said), len(avr.said))
    assert avr.said[:count] == twins.said[:count]
    assert count >= len(twins.said) - 3
    emulated = [(servo, motor) for _, servo, motor in twins.emulated._peripherals.pulses]  # type: ignore[attr-defined]
    measured = list(zip(*[[p.us for p in avr.pulses if p.motor is motor] for motor in (False, True)], strict=False))
    assert changes(measured) == changes(emulated)


def changes(pulses: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Without those that are as the one before: the board that starts has fewer of these."""
    return [pulse for before, pulse in zip([None, *pulses], pulses, strict=False) if pulse != before][:-1]
