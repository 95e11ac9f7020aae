"""Runs gathered for a report: what was recorded, and any pipelines on the same frames, in one pass over each source.

Beside them the results of benches, which are files of JSON.
"""

from __future__ import annotations

import contextlib
import csv
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from automodel import __version__
from automodel.assembly.bench_results import SUFFIX, bench_tables
from automodel.assembly.parts import car_of, make_loop, open_source, with_pipeline
from automodel.assembly.replay import AnyFrame, check_frame_size, frames_between
from automodel.config import CarConfig, ConfigError, parse_car
from automodel.config.changes import keys_of
from automodel.console.progress import progress
from automodel.geometry import GroundCamera
from automodel.output_files import output_text
from automodel.recording.export import image_of, latency_ms
from automodel.recording.reader import RecordingSource, Step
from automodel.runtime.loop import Loop
from automodel.signals import Command, Event, LaneEstimate, LaneStatus, Motion, MotionSource
from automodel.sources.files import read_motion_csv
from automodel.types import FloatArray, Image
from automodel.viewer.overlay import draw
from automodel.viewer.report_page import page
from automodel.viewer.run_trace import DrivenPath, Moment, ReportedRun, RunTrace, TraceRecorder, dead_reckoned

RECORDED = "recorded"  # the name of the estimates that the car drove by
MOMENTS = 6  # of a run
APART_S = 1.0  # between two moments, at least
BLIND = {LaneStatus.LOST: 3.0, LaneStatus.COASTING: 1.0}  # what a status counts beside lanes of bound and disagreement
HELD = frozenset({"stop", "hold"})  # kinds of events that make a frame worth looking at


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportOptions:
    """What a report is asked for.

    Of `sources` files of JSON are results of benches, all others runs. `truth_file` is the truth.csv of the one run,
    `motion_file` its motion.csv; `from_s` and `to_s` count from the first frame of each.
    """

    sources: tuple[Path, ...]
    html_file: Path
    car_file: Path | None = None
    motion_file: Path | None = None
    truth_file: Path | None = None
    pipelines: tuple[str, ...] = ()
    rate_hz: float | None = None
    from_s: float = 0.0
    to_s: float = math.inf


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Seen:
    """A pipeline's word on one frame."""

    estimate: LaneEstimate | None
    command: Command | None
    time_ms: float | None


def report(options: ReportOptions) -> list[ReportedRun]:
    """Read all sources, write the page; raises ConfigError and SourceError for what is wrong, with nothing written."""
    results = [table for source in options.sources if is_bench(source) for table in bench_tables(source)]
    runs = [_gather(options, source) for source in options.sources if not is_bench(source)]
    with output_text(options.html_file) as file:
        # half of a surrogate pair, in JSON or in the name of a file, is no text
        file.write(page(runs, __version__, results).encode("utf-8", "replace").decode())
    return runs


def is_bench(source: Path) -> bool:
    """Whether a source of a report is what a bench printed."""
    return source.suffix.lower() == SUFFIX


class Eye:
    """One pipeline over the frames of a run; without a loop, what was recorded."""

    def __init__(self, name: str, car: CarConfig, loop: Loop | None) -> None:
        self.name, self.loop, self.car = name, loop, car
        self.recorder = TraceRecorder(name)
        self._camera = GroundCamera.from_config(car.camera)

    def see(self, frame: AnyFrame, motion: Motion, step: Step | None) -> Seen:
        """What is said about the frame."""
        if self.loop is None:
            assert step is not None
            command = step.commands[0] if step.commands else None
            return Seen(estimate=step.estimate, command=command, time_ms=latency_ms(step))
        start = time.perf_counter()
        tick = self.loop.tick(frame, motion, None if step is None else step.state, frame.t_ns)
        return Seen(estimate=tick.estimate, command=tick.command, time_ms=1e3 * (time.perf_counter() - start))

    def picture(self, image: Image, seen: Seen, note: str) -> Image:
        """The frame with the overlay."""
        vehicle = self.car.vehicle
        return draw(image, seen.estimate, self._camera, seen.command, vehicle.reference_x_m, note, vehicle.wheelbase_m)


def _gather(options: ReportOptions, path: Path) -> ReportedRun:
    car = car_of_run(options.car_file, path)
    source = open_source(path, car, options.rate_hz)
    eyes = eyes_of(options.pipelines, car, isinstance(source, RecordingSource))
    motion = read_motion_csv(options.motion_file) if options.motion_file is not None else None
    worst, events, motions = _Worst(car.lane.width_m), [], []
    with contextlib.closing(source), progress(f"report {path.name}", getattr(source, "frame_count", None)) as bar:
        for t_s, frame, moved, _ in frames_between(source, motion, options.from_s, options.to_s):
            bar()
            check_frame_size(path, frame, car, options.car_file)
            step = source.step if isinstance(source, RecordingSource) else None
            happened = () if step is None else step.events
            seen = {eye: eye.see(frame, moved, step) for eye in eyes}
            for eye, word in seen.items():
                eye.recorder.add(t_s, frame.index, word.estimate, word.time_ms)
            motions.append(moved)
            events += [(t_s + (event.t_ns - frame.t_ns) * 1e-9, event) for event in happened]
            worst.look(t_s, frame, seen, happened)
    if not motions:
        raise ConfigError(f"{path}: no frames between --from {options.from_s:g} and --to {options.to_s:g} s")
    traces = tuple(eye.recorder.trace() for eye in eyes)
    truth_m, path_driven = _truth(options.truth_file, traces[0])
    if path_driven is None and any(one.source is not MotionSource.NONE for one in motions):
        path_driven = dead_reckoned(traces[0].t_s, motions)
    return ReportedRun(
        name=path.name,
        origin=_origin(path, source, traces[0]),
        traces=traces,
        path=path_driven,
        truth_m=truth_m,
        events=tuple(events),
        moments=worst.moments(),
        settings=dict(keys_of(car)),
    )


def car_of_run(car_file: Path | None, path: Path) -> CarConfig:
    """The car of a source: of the file that is given, else a recording's own, else the simulated one."""
    if car_file is None and path.suffix.lower() == ".mcap":
        return parse_car(RecordingSource(path).recording.car_text, f"{path} (car.toml)")
    return car_of(car_file)


def eyes_of(pipelines: Sequence[str], car: CarConfig, recorded: bool) -> list[Eye]:
    """What was recorded, and the pipelines that are asked for; of a source without estimates that of car.toml."""
    eyes = [Eye(RECORDED, car, None)] if recorded else []
    names = pipelines or (() if recorded else (car.pipeline.name,))
    for name in dict.fromkeys(names):
        other = with_pipeline(car, name)
        eyes.append(Eye(name, other, make_loop(other)))
    return eyes


class _Worst:
    """The frames of a run that are most worth looking at, `APART_S` apart, with their pictures."""

    def __init__(self, width_m: float) -> None:
        self._width_m = width_m
        self._kept: list[tuple[float, Moment]] = []

    def look(self, t_s: float, frame: AnyFrame, seen: Mapping[Eye, Seen], events: tuple[Event, ...]) -> None:
        """Keep the frame if it is among the worst so far."""
        score, why = self._judge(seen, events)
        near = [kept for kept in self._kept if t_s - kept[1].t_s < APART_S]
        rival = min(near or self._kept, key=lambda kept: kept[0], default=None)
        if near or len(self._kept) == MOMENTS:
            if rival is None or score <= rival[0]:
                return
            self._kept.remove(rival)
        note = f"{t_s:.2f} s  frame {frame.index}"
        pictures = {eye.name: eye.picture(image_of(frame), word, note) for eye, word in seen.items()}
        self._kept.append((score, Moment(t_s=t_s, frame=frame.index, why=why, pictures=pictures)))

    def moments(self) -> tuple[Moment, ...]:
        """In the order of their times."""
        return tuple(sorted((moment for _, moment in self._kept), key=lambda moment: moment.t_s))

    def _judge(self, seen: Mapping[Eye, Seen], events: tuple[Event, ...]) -> tuple[float, str]:
        """How bad the frame is, in lane widths, and in which respect most of all."""
        words = {eye.name: word.estimate for eye, word in seen.items()}
        parts: list[tuple[float, str]] = [(0.0, "as good as any")]
        for name, estimate in words.items():
            status = LaneStatus.LOST if estimate is None else estimate.status
            parts.append((BLIND.get(status, 0.0), f"{name} {status.value}"))
            bound = math.inf if estimate is None or estimate.pose is None else estimate.pose.offset_bound_m
            if math.isfinite(bound):
                parts.append((bound / self._width_m, f"{name}: the offset may be wrong by {bound:.2f} m"))
        offsets = {n: e.pose.offset_m for n, e in words.items() if e is not None and e.pose is not None}
        if len(offsets) > 1:
            low, high = min(offsets, key=offsets.__getitem__), max(offsets, key=offsets.__getitem__)
            apart_m = offsets[high] - offsets[low]
            parts.append((4.0 * apart_m / self._width_m, f"{low} and {high} are {apart_m:.2f} m apart"))
        parts += [(4.0, f"{event.kind}: {event.text}") for event in events if event.kind in HELD]
        return sum(part[0] for part in parts), max(parts, key=lambda part: part[0])[1]


def _truth(path: Path | None, trace: RunTrace) -> tuple[FloatArray | None, DrivenPath | None]:
    """The true offset (n,) of each frame of the trace and the true path; None without a truth.csv.

    Raises ConfigError with file and line.
    """
    if path is None:
        return None, None
    wanted = ("offset_m", "x_m", "y_m", "t_s")
    rows: dict[int, list[float]] = {}
    try:
        with open(path, encoding="utf-8-sig", newline="") as file:
            for line, row in enumerate(csv.DictReader(file), 2):
                try:
                    rows[int(row["frame"])] = [float(row[name]) for name in wanted]
                except (KeyError, ValueError, TypeError):
                    raise ConfigError(
                        f"{path}:{line}: expected numbers in frame,{','.join(wanted)}, as run --truth writes"
                    ) from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text file in UTF-8"
        raise ConfigError(f"{path}: cannot be read: {reason}") from None
    values = np.array([rows.get(frame, [math.nan] * len(wanted)) for frame in trace.frames])
    if np.isnan(values[:, 0]).all():
        raise ConfigError(f"{path}: has none of the run's frames; is it the truth.csv of another run?")
    step_s = np.diff(trace.t_s)
    speed = np.hypot(*np.diff(values[:, 1:3], axis=0).T) / np.where(step_s > 0.0, step_s, math.nan)
    speed = np.append(speed, speed[-1:]) if len(speed) else np.full(len(values), math.nan)
    return values[:, 0], DrivenPath(xy_m=values[:, 1:3], speed_mps=speed, true=True)


def _origin(path: Path, source: object, trace: RunTrace) -> str:
    """Where the run comes from, in a line."""
    length = f"{len(trace.frames)} frames, {trace.t_s[-1] - trace.t_s[0]:.1f} s"
    if isinstance(source, RecordingSource):
        origin = source.recording.origin
        told = ", ".join(f"{name} {value}" for name, value in sorted(origin.items()) if len(value) < 60)
        return f"{path.name}: {length}. {told}"
    return f"{path.name}: {length}"
