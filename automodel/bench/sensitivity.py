"""`bench sensitivity`: what each tuned number of the stages matters, by moving it and driving again.

The drives are short and unlike each other: random worlds, an intersection of the competition track, tight bends, and,
where they are there, clips of real highway images, whose truth is not known. Each frame is rendered once, and the
network's mask of it is computed once: pipelines replay them with every value of a number. What differs is measured
against the same replay with the number as it is.
"""

from __future__ import annotations

import functools
import hashlib
import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from automodel.assembly.parts import make_pipeline
from automodel.assembly.registry import find_part
from automodel.bench.accuracy import AccuracyMeter, Case, RenderedDrive, Row
from automodel.bench.random_worlds import RATE_HZ, build_world, views
from automodel.bench.tuned_numbers import TunedNumber, moved, pipelines_of, tuned_numbers
from automodel.bench.tusimple import LABELS, assumed_car, clip_of, read_labels
from automodel.config import PIPELINE_NAMES, CarConfig, ConfigError
from automodel.config.parts import PIPELINES
from automodel.console.workers import Sweep, Tick, spread
from automodel.interfaces import Pipeline
from automodel.perception.markings.unet import MarkingNetwork, UnetConfig
from automodel.pipelines.centerline import network_config
from automodel.signals import Frame, Motion, MotionSource
from automodel.sim.random_worlds import kind_of
from automodel.sim.track_files import load_track
from automodel.sim.trajectory import Odometer
from automodel.sim.truth import Truth
from automodel.sources.images import read_image
from automodel.types import Image

SCREENED, FINER = (-0.5, 0.5), (-0.2, 0.2)  # shares by which each number is moved; those that matter
FRAMES = 90  # of a drive: three seconds
CLIPS = 3  # of real images
CLIP_FRAMES = 5  # the last of each
TRACK, BENDS = "tmr", "chicane"  # with an intersection; with bends of a lane width's radius, where most is at its limit
METRICS = ("availability_pct", "misled_pct", "bound_exceeded_pct", "offset_mae_pct", "heading_mae_deg")
COLUMNS = (
    "number",
    "pipeline",
    "effect",
    "value",
    "minus_50",
    "minus_20",
    "plus_20",
    "plus_50",
    "changed_pct",
    "meaning",
)
SAME_LANES, SAME_RAD = 1e-3, 1e-3  # estimates closer than that are the same

View = tuple[Frame, Motion, Truth, bool]  # the last: a marking of the lane is in view
UNKNOWN = Truth(offset_m=math.nan, heading_rad=math.nan, curvature_per_m=math.nan, width_m=math.nan, s_m=0.0, lap=0)


@dataclass(frozen=True, slots=True, kw_only=True)
class SensitivityChoice:
    """Which numbers, pipelines (empty: all) and random worlds; `frames` of each drive."""

    only: tuple[str, ...] = ()
    pipelines: tuple[str, ...] = ()
    seeds: range = range(8)
    frames: int = FRAMES

    def cases(self) -> list[tuple[TunedNumber, str]]:
        """Each number with each of the pipelines that import it; raises ConfigError where there is none."""
        names = tuple(dict.fromkeys(self.pipelines)) or PIPELINE_NAMES
        cases = [
            (number, name) for number in tuned_numbers(self.only) for name in pipelines_of(number) if name in names
        ]
        if not cases:
            raise ConfigError(f"--only {' '.join(self.only)}: no tuned number of {', '.join(names)} has such a name")
        return cases


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedDrive:
    """Frames with their truth, and the car that a pipeline is told of; `marked`: the road has markings."""

    car: CarConfig
    views: tuple[View, ...]
    marked: bool = True


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Replayed:
    """What a pipeline made of all drives."""

    meter: AccuracyMeter

    def metrics(self) -> Row:
        """Those of `METRICS`; 0 where there is no frame with an estimate."""
        row = self.meter.row()
        return {name: row[name] or 0.0 for name in METRICS}

    def changed_pct(self, other: Replayed, unit_m: float) -> float:
        """The share of frames whose estimates differ."""
        one, two = (np.array(each.meter.estimated).reshape(-1, 2) for each in (self, other))
        same = np.abs(one - two) <= (SAME_LANES * unit_m, SAME_RAD)
        same |= np.isnan(one) & np.isnan(two)
        return 100.0 * float((~same.all(axis=1)).mean())


def listing(choice: SensitivityChoice) -> list[Row]:
    """A row for each number, in the order of the files."""
    names: dict[str, Row] = {}
    for number, pipeline in choice.cases():
        row = names.setdefault(
            number.path,
            {"number": number.path, "value": number.value, "pipelines": "", "meaning": number.meaning},
        )
        row["pipelines"] = f"{row['pipelines']} {pipeline}".strip()
    return list(names.values())


def measure(car: CarConfig, choice: SensitivityChoice, sweep: Sweep) -> list[Row]:
    """A row for each number and pipeline, those that matter most first."""
    work = functools.partial(measure_number, car, choice)
    rows = [row for _, row in spread("bench sensitivity", work, choice.cases(), sweep)]
    return sorted(rows, key=lambda row: (-row["effect"], -row["changed_pct"]))


def measure_number(car: CarConfig, choice: SensitivityChoice, case: tuple[TunedNumber, str], tick: Tick) -> Row:
    """The row of a number: changes of `METRICS` by each step, their sum, and the largest share of changed frames.

    `effect` is the largest sum of a step; an offset's error counts in percent of the lane's width, so that all of them
    are percents but the heading's, which counts in degrees. None where a whole number stays as it is.
    """
    number, name = case
    drives, before = _baseline(car, choice, name)
    row: Row = {"number": number.path, "pipeline": name, "value": number.value, "effect": 0.0, "changed_pct": 0.0}
    row |= {"meaning": number.meaning, "error": ""} | dict.fromkeys(_label(share) for share in sorted(SCREENED + FINER))
    detail: Row = {}
    for share in (*SCREENED, *FINER):
        if share in FINER and not row["changed_pct"]:
            break
        value = number.moved(share)
        if value is None:
            continue
        change, changed_pct, error = _change(drives, name, number, value, before)
        row[_label(share)] = sum(abs(one) for one in change.values())
        row["effect"] = max(row["effect"], row[_label(share)])
        row["changed_pct"] = max(row["changed_pct"], changed_pct)
        row["error"] = row["error"] or error
        detail |= {f"{_label(share)}_{metric}": one for metric, one in change.items()}
        tick(1.0 / len(SCREENED + FINER))
    names = [f"{_label(share)}_{metric}" for share in sorted(SCREENED + FINER) for metric in METRICS]
    return row | {name: detail.get(name) for name in names}


def _label(share: float) -> str:
    return f"{'plus' if share > 0.0 else 'minus'}_{round(100.0 * abs(share))}"


def _change(
    drives: Sequence[RecordedDrive], name: str, number: TunedNumber, value: float, before: Replayed
) -> tuple[Row, float, str]:
    """The metrics' changes, the share of changed frames, and what a number that cannot be so large or small raised."""
    with moved(number, value):
        try:
            after = replay(drives, name)
        except Exception as error:  # noqa: BLE001 - stages may raise anything where a number is not meant to be so
            nothing = Replayed(meter=AccuracyMeter())
            return _minus(nothing.metrics(), before.metrics()), 100.0, f"{type(error).__name__}: {error}"
    change = _minus(after.metrics(), before.metrics())
    return change, after.changed_pct(before, drives[0].car.lane.width_m), ""


def _minus(one: Row, other: Row) -> Row:
    return {name: one[name] - other[name] for name in METRICS}


@functools.cache
def _baseline(car: CarConfig, choice: SensitivityChoice, name: str) -> tuple[tuple[RecordedDrive, ...], Replayed]:
    """The drives, and what a pipeline makes of them as it is: once in a process."""
    drives = _drives(car, choice.seeds, choice.frames)
    return drives, replay(drives, name)


@functools.cache
def _drives(car: CarConfig, seeds: range, frames: int) -> tuple[RecordedDrive, ...]:
    """All drives, rendered once in a process."""
    recorded = [_random_world(car, seed, frames) for seed in seeds]
    bends = [
        _on_track(
            car, Case(pipeline="", track=BENDS, style="centred", seed=0, direction=way, speed_mps=2.0), 3 * frames
        )
        for way in ("forward", "reverse")
    ]
    return (*recorded, _intersection(car, frames), *bends, *_real_clips())


def _random_world(car: CarConfig, seed: int, frames: int) -> RecordedDrive:
    world = build_world(car, seed, kind_of(seed))
    seen = tuple((view.frame, view.motion, view.truth, view.visible) for view in views(world, frames))
    return RecordedDrive(car=world.believed, views=seen, marked=world.marked)


def _intersection(car: CarConfig, frames: int) -> RecordedDrive:
    """Along the competition track from three lane widths before its first intersection."""
    track = load_track(TRACK)
    at = track.crossings[0].s_first_m / track.road.length_m
    return _on_track(car, Case(pipeline="", track=TRACK, style="centred", seed=0), frames, at, 3.0 * car.lane.width_m)


def _on_track(car: CarConfig, case: Case, frames: int, at: float = 0.0, before_m: float = 0.0) -> RecordedDrive:
    """Along a track from `before_m` before the share `at` of its length."""
    car = replace(car, camera=replace(car.camera, rate_hz=RATE_HZ))
    drive = RenderedDrive(car, case)
    from_s = drive.drive.time_at(at * drive.lane.centerline.length_m - before_m) if at else 0.0
    t_s = [from_s + index / RATE_HZ for index in range(frames)]
    odometer, seen = Odometer(case.seed), []
    for frame, _, truth in drive.frames(t_s, lambda _: None):
        motion = odometer.motion(drive.drive.pose(t_s[frame.index] - 0.5 / RATE_HZ), frame.t_ns)
        seen.append((frame, motion, truth, True))
    return RecordedDrive(car=car, views=tuple(seen))


def _real_clips() -> Iterator[RecordedDrive]:
    """Real highway images of $AUTOMODEL_DATA/tusimple; none where there are none."""
    root = Path(os.environ.get("AUTOMODEL_DATA") or Path("..") / "shared" / "data") / "tusimple"
    if not (root / LABELS).is_file():
        return
    labels = read_labels(root)
    car = assumed_car(root, labels)
    for label in labels[:CLIPS]:
        seen = []
        for index, path in enumerate(clip_of(root / label.raw_file)[-CLIP_FRAMES:]):
            t_ns = round(index * 1e9 / RATE_HZ)
            motion = Motion(t_ns=t_ns, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)
            frame = Frame(t_ns=t_ns, index=index, image=read_image(path, car.camera.colour))
            seen.append((frame, motion, UNKNOWN, True))
        yield RecordedDrive(car=car, views=tuple(seen))


def replay(drives: Sequence[RecordedDrive], name: str) -> Replayed:
    """What a pipeline makes of all drives."""
    meter = AccuracyMeter()
    for drive in drives:
        pipeline = _made(drive.car, name)
        for frame, motion, truth, visible in drive.views:
            estimate = pipeline.step(frame, motion)
            meter.add(1e-9 * frame.t_ns, estimate, truth, visible=visible, marked=drive.marked)
    return Replayed(meter=meter)


def _made(car: CarConfig, name: str) -> Pipeline:
    """A pipeline; `centerline` with a network that knows what it made of a frame before."""
    if name != "centerline" or car.pipeline.centerline.markings != "unet":
        return make_pipeline(name, car)
    make: Callable[..., Pipeline] = find_part(PIPELINES, name)
    return make(car, markings=_network(replace(network_config(car), threads=1), car.lane.markings))


@functools.cache
def _network(config: UnetConfig, markings: str) -> MarkingNetwork:
    return RememberingNetwork(config, markings)


class RememberingNetwork(MarkingNetwork):
    """Computes the mask of an image once."""

    def __init__(self, config: UnetConfig, markings: str) -> None:
        super().__init__(config, markings)
        self._masks: dict[bytes, Image] = {}

    def step(self, grey: Image) -> Image:
        """The mask, as `MarkingNetwork.step`."""
        key = hashlib.blake2b(grey.tobytes(), digest_size=16).digest()
        if key not in self._masks:
            self._masks[key] = super().step(grey)
        return self._masks[key]
