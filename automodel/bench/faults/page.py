"""`python -m automodel.bench.faults.page`: writes README.md beside this file, the table of the faults."""

from __future__ import annotations

from pathlib import Path

from automodel.bench.faults.catalogue import CAN, FAULTS
from automodel.bench.faults.fault import BOUND_S, Fault, Must
from automodel.output_files import output_text

PAGE = Path(__file__).with_name("README.md")
_HEAD = f"""# The faults of `automodel bench faults`

Each is built into drives of the simulated car at a random time; the motor's pin and the lane are watched until the car
stands. What the car must do:

- **stop**: neutral throttle at the pin within the limit, straight wheels once it has rolled out; it stays so until a
  person arms it again, which must work as soon as the input has been well for 0.5 s, and not before;
- **hold**: neutral within the limit if the fault lasts that long; it drives on by itself when the fault is over, and
  never leaves its lane;
- **nothing**: it drives on as if there was no fault, and never leaves its lane.

The limit counts from the fault to the pin: {BOUND_S * 1e3:.0f} ms but where the text says why it is longer. A stop that
leaves the lane is no violation but a figure (`left_lane`, `left_max_m`). Only when asked for: `nominal`, a minute
without a fault.

Those of `can-` are built into drives of the full-size car on its CAN bus (`bench faults --link can`), by the true lane
at 5 to 15 m/s. Watched is whether the car is commanded, as its own controller sees it; neutral means disengaged. Every
command on the bus must be within the limits of acceleration and jerk. What the driver or the vehicle ends counts from
the first frame that says so to the host's command that lets go.

"""


def text() -> str:
    """The page."""
    rows = ["| fault | kind | must | limit [ms] | what |", "|---|---|---|---|---|", *map(_row, (*FAULTS, *CAN))]
    return _HEAD + "\n".join(rows) + "\n"


def _row(fault: Fault) -> str:
    limited = fault.must is not Must.NOTHING and fault.within_s < 1e3
    limit = f"{fault.within_s * 1e3:.0f}" if limited else "-"
    return f"| `{fault.name}` | {fault.kind.value} | {fault.must.value} | {limit} | {fault.text} |"


if __name__ == "__main__":
    with output_text(PAGE) as file:
        file.write(text())
