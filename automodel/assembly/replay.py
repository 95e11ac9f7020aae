"""Something recorded through the loop that drives, with recorded time and motion: lane poses, a CSV, a video.

No vehicle link is imported, let alone opened. The same frames give the same estimates to the bit.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from automodel.assembly.guess import DOUBTFUL, EvenSample, trustworthy, why_lost
from automodel.assembly.parts import car_of, make_loop, open_pair, open_source, with_pipeline
from automodel.config import CarConfig, ConfigError, parse_car
from automodel.console.messages import say
from automodel.console.progress import progress
from automodel.console.workers import Sweep, spread
from automodel.geometry import GroundCamera
from automodel.interfaces import Source
from automodel.recording.export import PosesCsv, image_of
from automodel.recording.reader import RecordingSource
from automodel.runtime.loop import Loop, Tick
from automodel.signals import Frame, LaneStatus, Motion, MotionSource, StereoFrame, VehicleState
from automodel.sources.errors import EndOfSource, SourceError
from automodel.sources.files import MotionTable, natural_key, read_motion_csv
from automodel.sources.images import check_size
from automodel.sources.pairs import PairSource
from automodel.viewer.overlay import draw
from automodel.viewer.stage_tiles import draw_stages
from automodel.viewer.video import film_writer

AnyFrame = Frame | StereoFrame
Row = dict[str, object]
Advance = Callable[[float], None]
SUFFIXES = frozenset({".mcap", ".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v"})  # of what is taken from folders
SELDOM = 0.05  # share of frames with a line: where fewer have one, the replay says why
COLUMNS = (
    "pipeline", "frames", "tracking", "one_line", "coasting", "lost", "availability_pct", "p50_ms", "p99_ms", "source",
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayOptions:
    """What a replay is asked for; `rate_hz` is that of frames that carry no time.

    With `right` the sources are the left and the right camera of a pair. `from_s` and `to_s` count from the first
    frame. With `guessed` the car file was guessed from the same source, and is
    judged by what is seen with it. With `stages` the video shows what each stage of the pipeline found.
    """

    source: Path
    right: Path | None = None
    car_file: Path | None = None
    motion_file: Path | None = None
    pipelines: tuple[str, ...] = ()
    csv_file: Path | None = None
    video_file: Path | None = None
    rate_hz: float | None = None
    guessed: bool = False
    stages: bool = False
    from_s: float = 0.0
    to_s: float = math.inf


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayCase:
    """One of several sources; `stamps` are size and time of what is read, so that a changed file is another case."""

    options: ReplayOptions
    stamps: tuple[tuple[int, int] | None, ...]


def sources_in(paths: Sequence[Path]) -> list[Path]:
    """The recordings and videos of each folder that holds any, in natural order; other paths as they are."""
    found: list[Path] = []
    for path in paths:
        within = [] if not path.is_dir() else [one for one in path.iterdir() if one.suffix.lower() in SUFFIXES]
        found += sorted(within, key=lambda one: natural_key(one.name)) or [path]
    return list(dict.fromkeys(found))


def replay_all(sources: Sequence[Path], options: ReplayOptions, sweep: Sweep) -> tuple[list[Row], int]:
    """The rows of all sources, and how many of these could not be read, each of which is reported on stderr.

    `options` are those of all; CSV and video are named after the source as well. Raises ConfigError where two sources
    have one name and files are to be written.
    """
    stems = Counter(source.stem for source in sources)
    if (options.csv_file or options.video_file) and len(stems) < len(sources):
        twice = next(stem for stem, count in stems.items() if count > 1)
        raise ConfigError(f"--csv, --video: several sources are called {twice!r}; replay them one after the other")
    cases = []
    for source in sources:
        csv_file, video_file = (path and _named(path, source.stem) for path in (options.csv_file, options.video_file))
        if video_file is not None and video_file.resolve() in map(Path.resolve, sources):
            raise ConfigError(f"--video {video_file}: is one of the sources; choose another name")
        one = dataclasses.replace(options, source=source, csv_file=csv_file, video_file=video_file)
        cases.append(ReplayCase(options=one, stamps=tuple(map(_stamp, (source, one.car_file, one.motion_file)))))
    rows: list[Row] = []
    failed = 0
    for _, (found, error) in spread("replay", _replay_case, cases, sweep):
        rows += found
        if error:
            say(error)
            failed += 1
    return rows, failed


def _stamp(path: Path | None) -> tuple[int, int] | None:
    if path is None or not path.exists():
        return None
    status = path.stat()
    return status.st_size, status.st_mtime_ns


def _replay_case(case: ReplayCase, advance: Advance) -> tuple[list[Row], str]:
    done = 0.0

    def tick(share: float) -> None:
        nonlocal done
        done += share
        advance(share)

    try:
        return replay(case.options, tick), ""
    except (ConfigError, SourceError) as error:
        return [], str(error)
    finally:
        advance(1.0 - done)


def replay(options: ReplayOptions, advance: Advance | None = None) -> list[Row]:
    """A row of metrics for each pipeline; CSV and video are written meanwhile, one for each pipeline.

    `advance` takes the share that was done since its last call; without it there is a progress bar for each pipeline.
    Raises ConfigError and SourceError for a file that is wrong, before or while it is read.
    """
    motion = read_motion_csv(options.motion_file) if options.motion_file is not None else None
    car_text = None
    if options.car_file is None and options.source.suffix.lower() == ".mcap":
        car_text = RecordingSource(options.source).recording.car_text
    rows = []
    for name in options.pipelines or (None,):
        base = car_of(options.car_file) if car_text is None else parse_car(car_text, f"{options.source} (car.toml)")
        car = with_pipeline(base, name)
        several = len(options.pipelines) > 1
        csv_file, video_file = (
            _named(path, car.pipeline.name) if several and path else path
            for path in (options.csv_file, options.video_file)
        )
        rows.append(_replay(options, car, motion, csv_file, video_file, advance))
    return rows


def frames_of(source: Source, motion: MotionTable | None) -> Iterator[tuple[AnyFrame, Motion, VehicleState | None]]:
    """What the loop is given: each frame, the motion that belongs to it, and the vehicle's state where recorded."""
    with contextlib.suppress(EndOfSource):
        while True:
            frame = source.read(1.0)
            if frame is None:
                continue
            if motion is not None:
                yield frame, motion.at(frame.t_ns), None
            elif isinstance(source, RecordingSource):
                assert source.step is not None
                yield frame, source.step.motion, source.step.state
            else:
                unknown = Motion(t_ns=frame.t_ns, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)
                yield frame, unknown, None


def frames_between(
    source: Source, motion: MotionTable | None, from_s: float, to_s: float
) -> Iterator[tuple[float, AnyFrame, Motion, VehicleState | None]]:
    """Those of `frames_of` from `from_s` to `to_s` after the first, each after its own time since then [s]."""
    first_ns = None
    for frame, moved, state in frames_of(source, motion):
        first_ns = frame.t_ns if first_ns is None else first_ns
        t_s = (frame.t_ns - first_ns) * 1e-9
        if t_s > to_s:
            return
        if t_s >= from_s:
            yield t_s, frame, moved, state


def _named(path: Path, pipeline: str) -> Path:
    return path.with_name(f"{path.stem}.{pipeline.replace(':', '.')}{path.suffix}")


def _replay(
    options: ReplayOptions,
    car: CarConfig,
    motion: MotionTable | None,
    csv_file: Path | None,
    video_file: Path | None,
    advance: Advance | None,
) -> Row:
    path = options.source
    if options.right is None:
        source = open_source(path, car, options.rate_hz)
    else:
        source = open_pair(path, options.right, car, options.rate_hz)
    rate_hz = options.rate_hz or getattr(source, "rate_hz", 0.0) or car.camera.rate_hz
    loop = make_loop(car)
    if options.stages and loop.stage_views is None:
        source.close()
        raise ConfigError(f"--stages: the pipeline {car.pipeline.name} does not show its stages; stereo does")
    statuses: Counter[LaneStatus] = Counter()
    times_ms: list[float] = []
    sample, widths_m = EvenSample(), []
    with contextlib.ExitStack() as files:
        files.callback(source.close)
        csv = files.enter_context(PosesCsv(csv_file)) if csv_file else None
        paint = _painter(files, video_file, car, rate_hz, loop if options.stages else None)
        count = getattr(source, "frame_count", None)
        if advance is None:
            bar = files.enter_context(progress(f"replay {car.pipeline.name}", count))
        else:
            share = 1.0 / (count * max(len(options.pipelines), 1)) if count else 0.0
            bar = functools.partial(advance, share)
        for _, frame, moved, state in frames_between(source, motion, options.from_s, options.to_s):
            check_frame_size(path, frame, car, options.car_file)
            if isinstance(frame, Frame):
                sample.add(frame.image)
            start = time.perf_counter()
            tick = loop.tick(frame, moved, state, frame.t_ns)
            times_ms.append(1e3 * (time.perf_counter() - start))
            statuses[tick.estimate.status] += 1
            if tick.estimate.status is LaneStatus.TRACKING and tick.estimate.pose is not None:
                widths_m.append(tick.estimate.pose.width_m)
            if csv is not None:
                csv.row(frame, tick.estimate, tick.command, times_ms[-1])
            paint(frame, tick)
            bar()
    if isinstance(source, PairSource) and source.unpaired:
        apart_ms = 1e3 * source.tolerance_s
        say(f"{path}, {options.right}: {source.unpaired} frames have no partner within {apart_ms:.3g} ms")
    if loop.warning:
        say(loop.warning)
    seen, frames = statuses[LaneStatus.TRACKING] + statuses[LaneStatus.ONE_LINE], sum(statuses.values())
    if sample.images and seen <= SELDOM * frames:
        say(f"{path}: a line was followed in {seen} of {frames} frames: {why_lost(sample.images, car)}")
    if options.guessed and not trustworthy(widths_m, frames, car):
        say(DOUBTFUL)
    return _row(path, car, statuses, times_ms, source.unpaired if isinstance(source, PairSource) else None)


def check_frame_size(path: Path, frame: AnyFrame, car: CarConfig, car_file: Path | None) -> None:
    """Raise SourceError, with what to do, unless the frame has the size of the car's camera."""
    try:
        check_size(frame, car.camera)
    except SourceError as error:
        if car_file is None and path.suffix.lower() != ".mcap":
            height, width = image_of(frame).shape[:2]
            raise SourceError(
                f"{path}: frame {frame.index} has {width}x{height} pixels, and without --car the camera is the "
                f"simulated car's of {car.camera.width_px}x{car.camera.height_px}; give a car.toml with --car, or "
                f"let one be guessed: automodel replay {path} --guess"
            ) from None
        raise SourceError(f"{path}: {error}, and give it with --car") from None


def _painter(
    files: contextlib.ExitStack, path: Path | None, car: CarConfig, rate_hz: float, stages_of: Loop | None
) -> Callable[[AnyFrame, Tick], None]:
    """Draws frames into a video, with the stages of a loop's pipeline where it is given."""
    if path is None:
        return lambda frame, tick: None
    video = film_writer(path, rate_hz)
    files.enter_context(video)
    camera = GroundCamera.from_config(car.camera)

    def paint(frame: AnyFrame, tick: Tick) -> None:
        note, vehicle = f"{frame.t_ns * 1e-9:.2f} s  frame {frame.index}", car.vehicle
        if stages_of is not None:
            views = stages_of.stage_views or ()
            video.write(draw_stages(frame, views, stages_of.cameras, tick.estimate, tick.command, note))
            return
        video.write(
            draw(image_of(frame), tick.estimate, camera, tick.command, vehicle.reference_x_m, note, vehicle.wheelbase_m)
        )

    return paint


def _row(path: Path, car: CarConfig, statuses: Counter[LaneStatus], times_ms: list[float], unpaired: int | None) -> Row:
    """`unpaired` counts the frames of two sources without a partner, None where there is one source."""
    frames = sum(statuses.values())
    if frames == 0:
        say(f"{path}: no frames")
    row: Row = {"pipeline": car.pipeline.name, "source": str(path), "frames": frames}
    row.update({status.value.lower(): statuses[status] for status in LaneStatus})
    valid = frames - statuses[LaneStatus.LOST]
    row["availability_pct"] = 100.0 * valid / frames if frames else 0.0
    row["p50_ms"] = float(np.median(times_ms)) if times_ms else None
    row["p99_ms"] = float(np.quantile(times_ms, 0.99)) if times_ms else None
    row["unpaired"] = unpaired
    return row
