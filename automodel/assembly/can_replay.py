"""A recorded CAN bus through the supervision that drives: what is wrong with it, and the car's motion as motion.csv."""

from __future__ import annotations

import csv
import dataclasses
import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from automodel.assembly.can_parts import can_functions
from automodel.config import CarConfig, ConfigError, load_car
from automodel.config.extras import need_extra
from automodel.console.messages import say
from automodel.console.progress import progress
from automodel.control.vehicle_model import yaw_rate_radps
from automodel.output_files import output_text
from automodel.sources.files import HEADER
from firmware_link.can_receiver import CanFrame, CanReceiver, MessageCount, Verdict, load_dbc

BUS_COLUMNS = ("frames", "supervised", "identifiers", "duration_s", "motion_rows", "alarms", "yaw_rate")
MESSAGE_COLUMNS = ("message", "frames", "rate_hz", "good", "alarms", "timeouts", "longest_gap_ms")


@dataclass(frozen=True, slots=True, kw_only=True)
class CanReplayOptions:
    """What is read: a bus's recording, the DBC files (none: those of the mapping) and the car.toml that maps them."""

    log: Path
    mapping: Path
    dbc: tuple[Path, ...] = ()
    motion_csv: Path = Path("motion.csv")


def replay_can(options: CanReplayOptions) -> dict[str, list[dict[str, object]]]:
    """Write motion.csv; gives a row on the `bus` and one for each of the `messages`.

    Raises ConfigError for a file that is wrong or a bus that tells no speed.
    """
    car = load_car(options.mapping)
    config = car.link.can
    if options.dbc:
        config = dataclasses.replace(config, dbc=tuple(map(str, options.dbc)))
    told = {part.value for part in config.state}
    if "speed_mps" not in told or not told & {"yaw_rate_radps", "steering_rad"}:
        raise ConfigError(
            f"{options.mapping}: [[link.can.state]]: a motion needs speed_mps and yaw_rate_radps or steering_rad"
        )
    receiver = CanReceiver(load_dbc(config.dbc), config, can_functions(config))
    bus = _Bus(receiver, car)
    with progress("replay CAN", None) as bar:
        for frame in read_log(options.log):
            bus.take(frame)
            bar()
    if not bus.motion:
        seen = sum(watch.count.frames for watch in receiver.watches.values())
        raise ConfigError(f"{options.log}: no motion in {bus.frames} frames, {seen} of them of mapped messages")
    _write_motion(options.motion_csv, bus.motion)
    say(f"{options.motion_csv}: {len(bus.motion)} rows")
    return {"bus": [bus.row(options.log)], "messages": bus.message_rows()}


def read_log(path: Path) -> Iterator[CanFrame]:
    """The data frames of a file of any kind that python-can reads, with the time [ns] since the first frame.

    A frame whose time lies before the last one's gets that one's. Raises ConfigError for a file that cannot be read.
    """
    need_extra("CAN", "can")
    import can

    if not path.is_file():
        raise ConfigError(f"{path}: " + ("is not a regular file" if path.exists() else "no such file"))
    logging.getLogger("can").setLevel(logging.CRITICAL)  # a line that it cannot read is left out, not printed
    start_s: float | None = None
    t_ns = number = 0
    try:
        with can.LogReader(path) as reader:
            for message in reader:
                number += 1
                start_s = message.timestamp if start_s is None else start_s
                t_ns = max(t_ns, round((message.timestamp - start_s) * 1e9))
                if not (message.is_error_frame or message.is_remote_frame):
                    extended, data = message.is_extended_id, bytes(message.data)
                    yield CanFrame(t_ns=t_ns, frame_id=message.arbitration_id, data=data, extended=extended)
    except NotImplementedError:
        raise ConfigError(f"{path}: python-can needs another package for it: pip install asammdf") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}") from None
    except Exception as error:  # noqa: BLE001 - a format's reader raises whatever its parsing and unpacking raise
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise ConfigError(
            f"{path}: frame {number + 1}: not a CAN log ({reason}); expected a candump .log, .blf, .asc, .trc or .mf4"
        ) from None


class _Bus:
    """What was found on the bus."""

    def __init__(self, receiver: CanReceiver, car: CarConfig) -> None:
        self._receiver = receiver
        self._wheelbase_m = car.vehicle.wheelbase_m
        speed = next(part.message for part in car.link.can.state if part.value == "speed_mps")
        self._key = next(key for key, watch in receiver.watches.items() if watch.name == speed)
        self.frames = 0
        self.last_ns = 0
        self.identifiers: set[tuple[int, bool]] = set()
        self.motion: list[tuple[float, float, float]] = []
        self.differences_radps: list[float] = []  # yaw rate measured less that of steering and speed
        self.measured = 0

    def take(self, frame: CanFrame) -> None:
        key = (frame.frame_id, frame.extended)
        self.frames, self.last_ns = self.frames + 1, frame.t_ns
        self.identifiers.add(key)
        verdict = self._receiver.take(frame)
        if verdict is not Verdict.GOOD or key != self._key:
            return
        values = self._receiver.snapshot(frame.t_ns).values
        speed_mps, yaw, steering = (values.get(name) for name in ("speed_mps", "yaw_rate_radps", "steering_rad"))
        if speed_mps is None:
            return
        model = None if steering is None else yaw_rate_radps(speed_mps, steering, self._wheelbase_m)
        if yaw is not None and model is not None:
            self.differences_radps.append(yaw - model)
        self.measured += yaw is not None
        rate = model if yaw is None else yaw
        t_s = frame.t_ns * 1e-9
        if rate is not None and math.isfinite(rate) and (not self.motion or t_s > self.motion[-1][0]):
            self.motion.append((t_s, speed_mps, rate))

    def row(self, log: Path) -> dict[str, object]:
        watches = list(self._receiver.watches.values())
        for watch in watches:
            watch.look(self.last_ns)
        measured = self.measured > 0
        return {
            "source": str(log),
            "frames": self.frames,
            "supervised": sum(watch.count.frames for watch in watches),
            "identifiers": len(self.identifiers),
            "duration_s": self.last_ns * 1e-9,
            "motion_rows": len(self.motion),
            "alarms": sum(watch.count.alarms for watch in watches),
            "yaw_rate": "measured" if measured else "from steering and speed",
            "yaw_rate_model_bias_radps": float(np.mean(self.differences_radps)) if self.differences_radps else None,
            "yaw_rate_model_std_radps": float(np.std(self.differences_radps)) if self.differences_radps else None,
        }

    def message_rows(self) -> list[dict[str, object]]:
        return [_message_row(watch.name, watch.count) for watch in self._receiver.watches.values()]


def _message_row(name: str, count: MessageCount) -> dict[str, object]:
    span_ns = 0 if count.first_ns is None or count.last_ns is None else count.last_ns - count.first_ns
    row: dict[str, object] = {
        "message": name,
        "frames": count.frames,
        "rate_hz": (count.frames - 1) * 1e9 / span_ns if span_ns else None,
        "alarms": count.alarms,
        "timeouts": count.timeouts,
        "longest_gap_ms": count.longest_gap_ns * 1e-6,
    }
    return {**row, **{verdict.value: count.verdicts[verdict] for verdict in Verdict}}


def _write_motion(path: Path, rows: list[tuple[float, float, float]]) -> None:
    with output_text(path) as file:
        writer: Any = csv.writer(file, lineterminator="\n")
        writer.writerow(HEADER)
        writer.writerows((f"{t_s:.6f}", f"{speed:.5f}", f"{yaw:.6f}") for t_s, speed, yaw in rows)
