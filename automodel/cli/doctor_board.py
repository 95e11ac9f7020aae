"""Talks to the car's board: port, hello, and what its sensors say."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

from automodel.cli.doctor_bounds import bounded
from automodel.clocks import SleepingClock
from automodel.config import CarConfig
from automodel.doctor.board_health import (
    Listened,
    judge_battery,
    judge_faults,
    judge_motion,
    judge_ranges,
    judge_reset,
    judge_wire,
)
from automodel.doctor.findings import Finding, okay, skip, warn
from automodel.signals import VehicleState
from firmware_link.arduino import ArduinoLink
from firmware_link.autonomos import AutonomosLink
from firmware_link.errors import HandshakeError
from firmware_link.messages import Hello, ResetCause
from firmware_link.transport import likely_ports

Board = ArduinoLink | AutonomosLink

LISTENING_S = 1.0
POLL_S = 0.005
_HELLO_S = 7.0  # the link itself gives up after 5
_OPENING_S = 5.0
_CAN = "280"  # the kernel's type of a network interface that is one (ARPHRD_CAN)


def board_findings(car: CarConfig, link: Board, clock: SleepingClock) -> Generator[Finding, None, bool]:
    """Port, hello, sensors; gives back whether the board answers. The link is left open."""
    place = f"{car.link.port} at {car.link.baud} baud"
    opened = bounded("serial port", link.open, _OPENING_S, "try another cable and plug, then run again")
    if isinstance(opened, Finding):
        yield opened
        yield skip("board", "not looked at: there is no port")
        return False
    yield okay("serial port", f"{place} opens")
    do = f"flash it: firmware_link/firmware/README.md; {likely_ports()}"
    heard = bounded("board", lambda: _listen(link, clock), _HELLO_S + 2.0 * LISTENING_S, do)
    if isinstance(heard, Finding):
        yield heard
        return False
    hello, listened = heard
    if hello is None:
        what = "an AutoNOMOS car: it tells no version, and drives on when this program is killed or cut off"
        yield warn(
            "board", what, "flash this project's firmware, which stops by itself: firmware_link/firmware/README.md"
        )
    else:
        table = f"message table {hello.table_hash:#06x} version {hello.version}, as this program's"
        yield okay("board", f"{table}; boot id {hello.boot_id}")
        yield judge_reset(_cause(hello))
    yield judge_wire(listened)
    yield judge_faults(listened)
    yield judge_battery(listened, car)
    yield judge_ranges(listened, car)
    yield judge_motion(listened)
    return True


def can_finding(networks: Path = Path("/sys/class/net")) -> Finding:
    """The CAN interfaces of this machine; no link of this version drives over them."""
    there = []
    for kind in sorted(networks.glob("*/type")):
        try:
            if kind.read_text(encoding="ascii").strip() == _CAN:
                state = (kind.parent / "operstate").read_text(encoding="ascii").strip()
                there.append(f"{kind.parent.name} {state}")
        except OSError:  # it went away meanwhile
            continue
    here = f"here are: {', '.join(there)}" if there else "this machine has no CAN interface"
    return skip("can", f"car.toml knows no link over CAN yet; {here}")


def _listen(link: Board, clock: SleepingClock) -> tuple[Hello | None, Listened]:
    """The board's hello (None of one that says none), and a second of its states; raises LinkError."""
    begin_ns = clock.now_ns()
    states: list[VehicleState] = []
    first_ns = begin_ns
    while True:
        now_ns = clock.now_ns()
        state = link.poll(now_ns)
        if state is not None:
            first_ns = first_ns if states else now_ns
            states.append(state)
        elif (now_ns - begin_ns) * 1e-9 > _HELLO_S:
            raise HandshakeError("the board says hello, but neither takes the limits of car.toml nor tells its state")
        if states and (now_ns - first_ns) * 1e-9 >= LISTENING_S:
            break
        clock.sleep(POLL_S)
    hello = link.hello if isinstance(link, ArduinoLink) else None
    if hello is None and isinstance(link, ArduinoLink):
        raise HandshakeError("the board restarted and said no hello again")
    span_s = (now_ns - first_ns) * 1e-9
    return hello, Listened(states=tuple(states), span_s=span_s, damaged=link.errors.total)


def _cause(hello: Hello) -> str:
    try:
        return ResetCause(hello.reset_cause).name.lower()
    except ValueError:
        return f"cause {hello.reset_cause}, which this program does not know"
