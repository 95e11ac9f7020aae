"""Logs of a CAN bus with our own messages."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from automodel.config import CanConfig
from firmware_link.can_checks import autosar_e2e_2
from firmware_link.can_receiver import load_dbc


def candump(path: Path, seconds: float, damage: Any = lambda name, index, data: data) -> Path:
    """A log of our own messages: 15 m/s, 0.1 rad/s; `damage` may change a payload or drop it (None)."""
    database: Any = load_dbc(())
    sent: list[tuple[float, str]] = []
    for message in CanConfig().receive:
        definition = database.get_message_by_name(message.name)
        for index in range(round(seconds / message.period_s)):
            values = dict.fromkeys((signal.name for signal in definition.signals), 0.0)
            values |= {
                "SPEED": 15.0,
                "YAW_RATE": 0.1,
                "ENGAGED": 1,
                "STATE_VALID": 1,
                message.counter_signal: index % 16,
            }
            data = definition.encode({name: values[name] for name in (s.name for s in definition.signals)})
            data = bytes((autosar_e2e_2(0, definition.frame_id, data), *data[1:]))
            data = damage(message.name, index, data)
            if data is not None:
                sent.append((index * message.period_s, f"{definition.frame_id:03X}#{data.hex().upper()}"))
    path.write_text("".join(f"({t_s:.6f}) can0 {frame}\n" for t_s, frame in sorted(sent)))
    return path
