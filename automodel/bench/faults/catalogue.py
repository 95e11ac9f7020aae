"""All faults, by name."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from automodel.bench.faults.car_faults import BOARD, LOOP, RECORDING
from automodel.bench.faults.fault import Fault, Kind, Must
from automodel.bench.faults.hooks import Hooks
from automodel.bench.faults.perception_faults import CAMERA, PERCEPTION
from automodel.bench.faults.wire_faults import SERIAL

NOMINAL = Fault(
    name="nominal",
    kind=Kind.NONE,
    must=Must.NOTHING,
    lasting_s=(60.0, 60.0),
    text="nothing goes wrong for a minute (only when asked for)",
    hooks=lambda random, end_ns: Hooks(),
)
FAULTS = (*CAMERA, *PERCEPTION, *LOOP, *SERIAL, *BOARD, *RECORDING)


def chosen(names: Iterable[str]) -> tuple[Fault, ...]:
    """The faults of these names in the catalogue's order, all but `nominal` where there are no names.

    Raises ValueError for a name that is none, with those that are near.
    """
    known = {fault.name: fault for fault in (*FAULTS, NOMINAL)}
    wanted = set(names)
    for name in sorted(wanted - set(known)):
        close = difflib.get_close_matches(name, known, 3, 0.5) or [k for k in known if name in k][:3]
        raise ValueError(f"{name!r}: no such fault; " + (f"near: {', '.join(close)}" if close else "see --list"))
    return tuple(fault for fault in known.values() if fault.name in wanted) if wanted else FAULTS
