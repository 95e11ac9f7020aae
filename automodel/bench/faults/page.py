"""`python -m automodel.bench.faults.page`: writes README.md beside this file, the table of the faults."""

from __future__ import annotations

import math
from pathlib import Path

from automodel.bench.faults.catalogue import CAN, FAULTS
from automodel.bench.faults.fault import BOUND_S, Fault, Must
from automodel.bench.faults.judge import STAY_S
from automodel.bench.faults.real_catalogue import REAL_FAULTS, RealFault
from automodel.output_files import output_text

PAGE = Path(__file__).with_name("README.md")
_HEAD = f"""# The faults of `automodel bench faults`

Each is built into drives of the simulated car at a random time; the motor's pin and the lane are watched until the car
stands. What the car must do:

- **stop**: neutral throttle at the pin within the limit, straight wheels once it has rolled out; it stays so until a
  person arms it again, which must work as soon as the input has been well for 0.5 s, and not before;
- **hold**: neutral within the limit if the fault lasts that long; it drives on by itself when the fault is over, and
  never leaves its lane;
- **nothing**: it drives on as if there was no fault, and never leaves its lane;
- **refuse**: it is wrong before the car is armed: it is never armed, whoever asks;
- **stay**: it drives on, is held or stopped, but stays in its lane up to standstill, or while it drives on for
  {STAY_S:g} s after the fault, or leaves it by no more than the limit; without one it is no violation, but a figure.

Of two cameras the left one fails, but in the faults of `pair-`: those are of a pair, and only for a pipeline that
needs one (`--pipeline stereo`). The limit counts from the fault to the pin: {BOUND_S * 1e3:.0f} ms but where the text
says why it is longer. A stop that leaves the lane is no violation but a figure (`left_lane`, `left_max_m`). Only when
asked for: `nominal`, a minute without a fault, on any of the tracks, with random light and floor. An hour of them is
`automodel bench faults --only nominal --runs 60`. Of a car that must drive on, the first hold and the first stop of a
run are reported with their cause, and with how wrong the offset was: a stop is false where it was not.

The car's owner has measured the lanes to 5 mm (`[lane] width_sigma_m`).

A car that was stopped may be refused to be armed where its lane cannot be found by a pipeline that is started there:
the judge tries that with one of its own.

Those of `can-` are built into drives of the full-size car on its CAN bus (`bench faults --link can`), by the true lane
at 5 to 15 m/s. Watched is whether the car is commanded, as its own controller sees it; neutral means disengaged. Every
command on the bus must be within the limits of acceleration and jerk. What the driver or the vehicle ends counts from
the first frame that says so to the host's command that lets go.

"""
_REAL_HEAD = """## In real time

`--real-time` starts `automodel run` as a process of its own, on a terminal of its own, with a board on a pseudo
terminal; the times are the machine's own clock. A violation in a run in which the machine held the board itself up for
more than 10 ms says nothing: the run is repeated, and counted (`disturbed`).
"""


def text() -> str:
    """The page."""
    head = ["| fault | kind | must | limit | what |", "|---|---|---|---|---|"]
    rows = map(_row, (*FAULTS, *CAN))
    return _HEAD + "\n".join([*head, *rows, "", _REAL_HEAD, *head, *map(_real_row, REAL_FAULTS)]) + "\n"


def _row(fault: Fault) -> str:
    limited = fault.must in (Must.STOP, Must.HOLD) and fault.within_s < 1e3
    limit = f"{fault.within_s * 1e3:.0f} ms" if limited else "-"
    if fault.must is Must.STAY:
        limit = f"{fault.outside_m:g} m" if math.isfinite(fault.outside_m) else "-"
    return f"| `{fault.name}` | {fault.kind.value} | {fault.must.value} | {limit} | {fault.text} |"


def _real_row(fault: RealFault) -> str:
    limit = "-" if fault.must is Must.NOTHING else f"{fault.within_s * 1e3:.0f} ms"
    return f"| `{fault.name}` | {fault.kind.value} | {fault.must.value} | {limit} | {fault.text} |"


if __name__ == "__main__":
    with output_text(PAGE) as file:
        file.write(text())
