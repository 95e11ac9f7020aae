"""When what happens in one run, by its seed."""

from __future__ import annotations

from dataclasses import dataclass
from random import Random

from automodel.bench.faults.fault import Fault, Must

PICTURES_NS = 1_500_000_000  # from here on there are pictures, and a pipeline that looks at them
DRIVEN_BY_NS = 1_800_000_000  # and from here on the car is driven by that
BEGIN_NS = (1_900_000_000, 2_300_000_000)  # the fault begins between these; the car drives steadily
REARM_S = 0.5
_QUIET_S = 0.25  # watched beyond the healthy time that arming would take


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """One run; times on the run's own clock.

    `press_ns` is when a person asks to arm, None for never; `drives_again` whether the car must then drive. The run
    ends at `until_ns`. `place` (0 .. 1) is where on the lane it starts, `offset_m` beside its middle; `look` chooses
    light and floor.
    """

    seed: str
    begin_ns: int
    end_ns: int
    until_ns: int
    press_ns: int | None
    drives_again: bool
    place: float
    offset_m: float
    speed_mps: float
    look: int

    def hooks_random(self) -> Random:
        """The generator for what is random in the fault itself."""
        return Random(f"{self.seed}/hooks")


def draw_plan(fault: Fault, seed: int, index: int, looks: int) -> Plan:
    """The plan of the fault's run number `index`; the same arguments give the same plan."""
    name = f"{seed}/{fault.name}/{index}"
    random = Random(name)
    begin_ns = random.randint(*BEGIN_NS)
    end_ns = begin_ns + round(random.uniform(*fault.lasting_s) * 1e9)
    press_ns, drives_again, until_ns = _afterwards(fault, random, begin_ns, end_ns)
    return Plan(
        seed=name,
        begin_ns=begin_ns,
        end_ns=end_ns,
        until_ns=until_ns,
        press_ns=press_ns,
        drives_again=drives_again,
        place=random.random(),
        offset_m=random.uniform(-0.02, 0.02),
        speed_mps=random.uniform(0.7, 1.3),
        look=random.randrange(looks),
    )


def _afterwards(fault: Fault, random: Random, begin_ns: int, end_ns: int) -> tuple[int | None, bool, int]:
    """When somebody asks to arm, whether the car must then drive, and when the run ends.

    After a stop either nobody touches the car; or somebody asks too early, which must be refused and forgotten; or in
    time, which must work.
    """
    healthy_ns = end_ns + round((fault.recovery_s + REARM_S) * 1e9)
    quiet_ns = healthy_ns + round(_QUIET_S * 1e9)
    how = random.choice(("nobody", "early", "in time") if fault.heard else ("nobody", "in time"))
    early_ns = round(random.uniform(begin_ns + 0.2e9, end_ns + (REARM_S - 0.05) * 1e9))
    if fault.must is not Must.STOP:
        return None, False, end_ns + round(0.35e9)
    if not fault.ends:
        return (None if fault.when_shown else early_ns), False, max(begin_ns + round(1.2e9), end_ns)
    if how == "nobody":
        return None, False, quiet_ns
    if how == "early":
        return early_ns, False, quiet_ns
    press_ns = healthy_ns + round(0.05e9)
    return press_ns, True, press_ns + round(0.35e9)
