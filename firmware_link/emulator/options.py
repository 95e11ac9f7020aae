"""How an emulated board differs from the usual one, and what it counts."""

from __future__ import annotations

from dataclasses import dataclass

from firmware_link import messages


@dataclass(frozen=True, slots=True, kw_only=True)
class BoardOptions:
    """How the board differs from the usual one. `table_hash` is that of its program's message table."""

    boot_ns: int = 300_000_000  # bootloader: deaf and dumb
    watchdog_ns: int = 60_000_000  # a program that hangs is restarted after so long
    boot_id: int = 1  # of the first start
    table_hash: int = messages.TABLE_HASH

    def __post_init__(self) -> None:
        if self.boot_ns < 0 or self.watchdog_ns <= 0:
            raise ValueError("boot_ns, watchdog_ns: a time >= 0 and one > 0 are wanted")


@dataclass(slots=True, kw_only=True)
class BoardCounters:
    """What went wrong on the board's side since power came on."""

    rx_in_boot: int = 0  # bytes that came while the bootloader ran
    rx_lost: int = 0  # bytes that found the ring buffer full
    tx_skipped: int = 0  # frames that did not fit into the ring buffer
    starts: int = 0
