"""`bench lane-changes`: does `stereo` take each lane change once, and none where the car only weaves, with images.

Drives on the highway of `sim.highway` at the paper's speed, with the cameras of `bench stereo-paper`, by day or night,
level or pitching by up to a degree, one after the other of each kind:

- "changes": one change after the other from and to random lanes, each of 3 to 6 s.
- "weaving": from side to side by 45 to 60 % of half the lane, and no change: the neighbouring lane becomes the lane at
  75 % of it.

A change is taken where the pipeline says so once, to its side, while the car is between both lanes or within `LATE_S`
after that. All else that it says is false.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from automodel.assembly.simulated_car import renderers
from automodel.bench.accuracy import Row
from automodel.bench.stereo_paper import LIGHTS, RATE_HZ, SPEED_MPS, mirror_car
from automodel.console.workers import Sweep, Tick, spread
from automodel.pipelines.stereo import Stereo
from automodel.signals import LaneStatus, StereoFrame
from automodel.sim.highway import Highway, HighwayDrive, LaneChange
from automodel.sim.random_worlds import Nod
from automodel.sim.trajectory import Odometer
from automodel.sim.truth import TruthFollower

KINDS = ("changes", "weaving")
SECONDS = 25.0
RUN_IN_S = 1.5  # until the first change begins, at least: a lane must be found
LATE_S = 1.0
PITCH_DEG, PITCH_HZ = (0.0, 1.0), 1.5
COLUMNS = (
    "kind",
    "seed",
    "ride",
    "seconds",
    "changes",
    "taken",
    "missed",
    "false",
    "change_at_pct",
    "lost_frames",
    "events",
)
SUMMARY = ("kind", "drives", "minutes", "changes", "taken", "missed", "false", "change_at_pct", "lost_frames")


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneDrive:
    """One drive of a kind, all of it drawn from its seed."""

    kind: str
    seed: int
    seconds: float = SECONDS


def planned(case: LaneDrive, lanes: int) -> tuple[int, tuple[LaneChange, ...], float, float]:
    """The lane in which it starts (0: the rightmost), its changes, and how it weaves: amplitude [m], rate [Hz]."""
    rng = np.random.default_rng((case.seed, KINDS.index(case.kind)))
    first = lane = int(rng.integers(lanes))
    if case.kind == "weaving":
        return first, (), 0.5 * Highway().width_m * rng.uniform(0.45, 0.6), rng.uniform(0.1, 0.25)
    changes, t_s = [], RUN_IN_S + rng.uniform(0.0, 1.0)
    while t_s + (lasts_s := rng.uniform(3.0, 6.0)) + LATE_S < case.seconds:
        sides = [side for side in (-1, 1) if 0 <= lane + side < lanes]
        side = int(rng.choice(sides))
        changes.append(LaneChange(from_s=t_s, lasts_s=lasts_s, to=side))
        lane, t_s = lane + side, t_s + lasts_s + LATE_S + rng.uniform(0.0, 1.0)
    return first, tuple(changes), 0.15, 0.1


def measure_drive(case: LaneDrive, tick: Tick) -> Row:
    """The row of one drive."""
    rng, car, highway = np.random.default_rng((case.seed, 7)), mirror_car(), Highway()
    track, lanes = highway.build()
    first, changes, wander_m, wander_hz = planned(case, len(lanes))
    path = HighwayDrive(lanes[first], SPEED_MPS, changes, wander_m=wander_m, wander_hz=wander_hz)
    light, pitch_deg = str(rng.choice(sorted(LIGHTS))), float(rng.choice(PITCH_DEG))
    look = dataclasses.replace(LIGHTS[light], noise_seed=case.seed, floor_seed=case.seed, wear_seed=case.seed)
    nod = Nod(amplitude_rad=math.radians(pitch_deg), rate_hz=PITCH_HZ, phase_rad=rng.uniform(0.0, math.tau))
    eyes, odometer = renderers(track, car, look, nod.amplitude_rad), Odometer(case.seed)
    follower = TruthFollower(lanes[first], car.vehicle.reference_x_m)
    pipeline = Stereo(car)
    events: list[tuple[float, int, float]] = []  # time, side, offset from the first lane's middle in half lanes
    lost, count = 0, round(min(case.seconds, path.lasts_s) * RATE_HZ)
    for index in range(count):
        t_s = index / RATE_HZ
        pose, nod_rad = path.pose(t_s), nod.at(t_s)
        place = pose.x_m, pose.y_m, pose.yaw_rad
        left, right = (eye.render(*place, pose.speed_mps, pose.yaw_rate_radps, index, nod_rad=nod_rad) for eye in eyes)
        motion = odometer.motion(path.pose(max(t_s - 0.5 / RATE_HZ, 0.0)), round(t_s * 1e9))
        estimate = pipeline.step(StereoFrame(t_ns=motion.t_ns, index=index, left=left, right=right), motion)
        lost += estimate.status is LaneStatus.LOST and t_s > RUN_IN_S
        if estimate.lane_change:
            events.append((t_s, estimate.lane_change, 2.0 * follower.step(*place).offset_m / highway.width_m))
        tick(1.0 / count)
    return {
        "kind": case.kind,
        "seed": case.seed,
        "ride": f"{light}, pitch +-{pitch_deg:g} deg",
        "seconds": count / RATE_HZ,
        **judged(changes, events),
        "lost_frames": lost,
        "events": " ".join(f"{t_s:.2f}:{side:+d}" for t_s, side, _ in events),
    }


def judged(changes: Sequence[LaneChange], events: Sequence[tuple[float, int, float]]) -> Row:
    """How many changes were taken, and what was false; each event is time [s], side, and the offset in half lanes from
    the middle of the lane in which the drive started, to the left."""
    left_over, at, lane = list(events), [], 0
    for change in changes:
        until_s = change.from_s + change.lasts_s + LATE_S
        own = [event for event in left_over if change.from_s <= event[0] < until_s and event[1] == change.to]
        if own:
            left_over.remove(own[0])
            at.append(change.to * (own[0][2] - 2.0 * lane))
        lane += change.to
    return {
        "changes": len(changes),
        "taken": len(at),
        "missed": len(changes) - len(at),
        "false": len(left_over),
        "change_at_pct": 100.0 * float(np.mean(at)) if at else None,
    }


def measure(cases: Sequence[LaneDrive], sweep: Sweep) -> dict[str, list[Row]]:
    """The tables "drives", a row each, and "all", a row for each kind."""
    rows = [row for _, row in spread("bench lane-changes", measure_drive, cases, sweep)]
    return {"drives": rows, "all": [summary(kind, rows) for kind in KINDS if any(row["kind"] == kind for row in rows)]}


def summary(kind: str, rows: Sequence[Row]) -> Row:
    """All drives of one kind together."""
    own = [row for row in rows if row["kind"] == kind]
    total = {name: sum(row[name] for row in own) for name in ("changes", "taken", "missed", "false", "lost_frames")}
    at = [(row["change_at_pct"], row["taken"]) for row in own if row["taken"]]
    mean = sum(share * taken for share, taken in at) / sum(taken for _, taken in at) if at else None
    minutes = sum(row["seconds"] for row in own) / 60.0
    return {"kind": kind, "drives": len(own), "minutes": minutes, **total, "change_at_pct": mean}


def cases_of(changes: int, minutes: float, first_seed: int) -> list[LaneDrive]:
    """As many drives as make at least so many changes, and so many minutes of weaving, of whole drives each."""
    cases: list[LaneDrive] = []
    lanes, made, seed = Highway().lanes, 0, first_seed
    while made < changes:
        case = LaneDrive(kind="changes", seed=seed)
        made += len(planned(case, lanes)[1])
        cases.append(case)
        seed += 1
    weaving = math.ceil(60.0 * minutes / SECONDS)
    return cases + [LaneDrive(kind="weaving", seed=first_seed + k) for k in range(weaving)]
