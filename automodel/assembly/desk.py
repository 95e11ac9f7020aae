"""Hardware in the loop on a desk: the simulated world, driven by the pulses that a real board says it makes.

The board is at car.toml's serial port, with the link that the car drives with. What it reports as its pulses moves the
simulated car; the simulated wheel, gyro and ranges take the place of its own sensors, which stand still on a desk.
"""

from __future__ import annotations

import contextlib
import math
import multiprocessing
import threading
import time
from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np

from automodel.assembly.links import arduino_link
from automodel.config import CarConfig
from automodel.signals import Command, VehicleState
from automodel.sim.world import World
from automodel.types import FloatArray
from firmware_link.arduino import ArduinoLink
from firmware_link.messages import Fault, Status, StatusFlag
from firmware_link.timing import SpeedMeter

STEP_S = 0.002  # between two looks of the world at the pulses
SENSORS_S = 0.02  # between two readings, as the board's
SILENT_NS = 200_000_000  # a board that says nothing for so long is taken to be in neutral
PIPE_NS = 60_000_000  # a command may be at the pin so late: the servo's frame and the board's report take 20 ms each
_KEPT = 200  # commands whose echo is awaited; the counter has 256 values
_MISSED = Fault.COMMAND_TIMEOUT | Fault.COMMAND_LATE
_PULSES, _SENSORS = slice(0, 2), slice(2, 8)
_SLOTS = 8  # servo, motor [us] | time [ns], wheel ticks, yaw rate, ranges left, centre, right; NaN: none


class DeskMemory:
    """Pulses to the world's process and sensors from it. Each number is whole; two may be of different times."""

    def __init__(self) -> None:
        self._memory: Any = multiprocessing.get_context("spawn").RawArray("d", _SLOTS)

    @property
    def numbers(self) -> FloatArray:
        """All of them, shared."""
        return np.frombuffer(self._memory)


class DeskPort:
    """Implements `sim.sources.Port` in the world's process: moves the world by the pulses in `memory`."""

    def __init__(self, world: World, memory: DeskMemory, path: str) -> None:
        self.path = path
        self._world, self._numbers = world, memory.numbers
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="pulses", daemon=True)

    def start(self) -> None:
        """Serve in a thread."""
        self._thread.start()

    def close(self) -> None:
        """Stop."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def _serve(self) -> None:
        due_ns = 0
        while not self._stop.wait(STEP_S):
            now_ns = time.monotonic_ns()
            servo_us, motor_us = self._numbers[_PULSES].tolist()
            if servo_us > 0:
                self._world.set_pulses(now_ns, servo_us, motor_us)
            if now_ns >= due_ns:
                due_ns = now_ns + round(SENSORS_S * 1e9)
                read = self._world.read_sensors(now_ns)
                ranges = [math.nan if one is None else one for one in read.ranges_m]
                yaw_rate = math.nan if read.yaw_rate_radps is None else read.yaw_rate_radps
                self._numbers[_SENSORS] = (now_ns, read.wheel_ticks, yaw_rate, *ranges)


class EchoMeter:
    """Compares what was sent with what the board says it received and makes."""

    def __init__(self) -> None:
        self._awaited: dict[int, int] = {}  # counter -> when its command was sent [ns]
        self._commanded: deque[tuple[int, float, float]] = deque()
        self._faults = 0
        self.echoes_ns: list[int] = []
        self.errors_us: list[float] = []
        self.missed = 0

    def sent(self, counter: int, servo_us: float, motor_us: float, now_ns: int) -> None:
        """A command went out."""
        self._awaited[counter] = now_ns
        while len(self._awaited) > _KEPT:
            del self._awaited[next(iter(self._awaited))]
        self._commanded.append((now_ns, servo_us, motor_us))
        while self._commanded[0][0] < now_ns - PIPE_NS:
            self._commanded.popleft()

    def heard(self, status: Status, now_ns: int) -> None:
        """A new status of the board."""
        sent_ns = self._awaited.pop(status.command_counter, None)
        if sent_ns is not None:
            self.echoes_ns.append(now_ns - sent_ns)
            for counter in [counter for counter, at_ns in self._awaited.items() if at_ns < sent_ns]:
                del self._awaited[counter]  # two between two statuses: the board names the last one
        self.missed += (status.faults & ~self._faults & _MISSED).bit_count()
        self._faults = status.faults
        if status.flags & StatusFlag.ARMED and self._commanded:
            near = (max(abs(status.servo_us - a), abs(status.motor_us - b)) for _, a, b in self._commanded)
            self.errors_us.append(min(near))

    def row(self) -> dict[str, Any]:
        """Times from a command to the report that echoes it, deadlines missed, pulses against commands."""
        echoes = np.array(self.echoes_ns) * 1e-6
        p50_ms, p99_ms = np.percentile(echoes, (50, 99)).tolist() if len(echoes) else (None, None)
        errors = self.errors_us
        return {
            "echo_p50_ms": p50_ms,
            "echo_p99_ms": p99_ms,
            "deadlines_missed": self.missed,
            "pulse_error_p99_us": float(np.percentile(errors, 99)) if errors else None,
            "pulse_error_max_us": max(errors, default=None),
        }


class DeskLink:
    """The car's own link to the real board, with the simulated car's sensors in its states."""

    def __init__(self, car: CarConfig, memory: DeskMemory) -> None:
        self._link: ArduinoLink = arduino_link(car)
        self._neutral = self._link.neutral_us
        self._numbers = memory.numbers
        self._speed = SpeedMeter(car.vehicle.ticks_per_m)
        self._speed_mps: float | None = None
        self._read_ns = self._status_us = -1
        self._heard_ns = 0
        self.meter = EchoMeter()

    def open(self) -> None:
        """As the link's."""
        self._link.open()

    def poll(self, now_ns: int) -> VehicleState | None:
        """As the link's; the world gets the board's pulses, neutral where it says nothing."""
        pulses = (0.0, 0.0)
        try:
            state = self._link.poll(now_ns)
            status = self._link.status
            if status is not None and status.time_us != self._status_us:
                self._status_us, self._heard_ns = status.time_us, now_ns
                self.meter.heard(status, now_ns)
            if status is not None and now_ns - self._heard_ns < SILENT_NS:
                pulses = status.servo_us, status.motor_us
        finally:
            self._numbers[_PULSES] = pulses if pulses[0] > 0 else self._neutral
        return None if state is None else self._with_sensors(state)

    def send(self, command: Command, now_ns: int) -> None:
        """As the link's."""
        before = self._link.last_command
        self._link.send(command, now_ns)
        sent = self._link.last_command
        if sent is not None and sent is not before:
            self.meter.sent(sent[0], sent[1].servo_us, sent[1].motor_us, now_ns)

    def arm(self, now_ns: int) -> None:
        """As the link's."""
        self._link.arm(now_ns)

    def disarm(self, now_ns: int) -> None:
        """As the link's."""
        self._link.disarm(now_ns)

    def close(self) -> None:
        """As the link's."""
        with contextlib.suppress(ValueError):  # the memory is gone with its process
            self._numbers[_PULSES] = self._neutral
        self._link.close()

    def _with_sensors(self, state: VehicleState) -> VehicleState:
        t_ns, ticks, yaw_rate, *ranges = self._numbers[_SENSORS].tolist()
        if t_ns > 0 and int(t_ns) != self._read_ns:
            self._read_ns = int(t_ns)
            self._speed_mps = self._speed.step(self._read_ns, round(ticks))
        return replace(
            state,
            speed_mps=self._speed_mps,
            yaw_rate_radps=None if math.isnan(yaw_rate) else yaw_rate,
            ranges_m=tuple(None if math.isnan(one) else one for one in ranges),
        )
