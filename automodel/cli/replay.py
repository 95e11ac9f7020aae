"""`automodel replay`: the lane in something that was recorded. No vehicle is ever opened here."""

from __future__ import annotations

import contextlib
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import click
import numpy as np

from automodel.assembly.parts import car_of, make_loop, open_source
from automodel.cli.options import FILE, check_outputs, finite
from automodel.config import PIPELINE_NAMES, CarConfig, parse_car
from automodel.console.progress import progress
from automodel.console.tables import show
from automodel.geometry import GroundCamera
from automodel.interfaces import Source
from automodel.recording.export import PosesCsv
from automodel.recording.reader import RecordingSource
from automodel.runtime.loop import Tick
from automodel.signals import Frame, LaneStatus, Motion, MotionSource, StereoFrame, VehicleState
from automodel.sources.errors import EndOfSource, SourceError
from automodel.sources.files import MotionTable, read_motion_csv
from automodel.sources.images import check_size
from automodel.types import Image
from automodel.viewer.overlay import draw
from automodel.viewer.video import VideoWriter

AnyFrame = Frame | StereoFrame


@click.command("replay")
@click.argument("source", type=FILE)
@click.option("--car", "car_file", type=FILE, help="car.toml (default: the recording's own).")
@click.option("--motion", "motion_file", type=FILE, help="motion.csv: t_s,speed_mps,yaw_rate_radps.")
@click.option(
    "--pipeline", "pipelines", multiple=True, type=click.Choice(PIPELINE_NAMES), help="May be given several times."
)
@click.option("--csv", "csv_file", type=FILE, help="Write poses.csv here (per pipeline).")
@click.option("--video", "video_file", type=FILE, help="Write an MP4 with the overlay here.")
@click.option(
    "--rate",
    "rate_hz",
    type=click.FloatRange(0, 1000, min_open=True),
    callback=finite,
    help="Frames a second, for sources that do not say.",
)
@click.option("--json", "as_json", is_flag=True, help="Figures as JSON on stdout.")
def command(
    source: Path,
    car_file: Path | None,
    motion_file: Path | None,
    pipelines: tuple[str, ...],
    csv_file: Path | None,
    video_file: Path | None,
    rate_hz: float | None,
    as_json: bool,
) -> int:
    """Lane poses of SOURCE: a recording (.mcap), a video, a folder of pictures or a donkeycar tub (v2)."""
    inputs = {"SOURCE": source, "--car": car_file, "--motion": motion_file}
    check_outputs({"--csv": csv_file, "--video": video_file}, inputs)
    base = _car(source, car_file)
    motion = read_motion_csv(motion_file) if motion_file is not None else None
    rows = []
    for name in pipelines or (base.pipeline.name,):
        car = car_of(car_file, name) if car_file is not None else _with_pipeline(base, name)
        several = len(pipelines) > 1
        outputs = [_named(path, name) if several and path else path for path in (csv_file, video_file)]
        rows.append(_replay(source, car, motion, rate_hz, (outputs[0], outputs[1])))
    show("replay", rows, as_json)
    return 0


def _car(source: Path, car_file: Path | None) -> CarConfig:
    if car_file is None and source.suffix.lower() == ".mcap":
        return parse_car(RecordingSource(source).recording.car_text, f"{source} (car.toml)")
    return car_of(car_file)


def _with_pipeline(car: CarConfig, name: str) -> CarConfig:
    import dataclasses

    return dataclasses.replace(car, pipeline=dataclasses.replace(car.pipeline, name=name))


def _named(path: Path, name: str) -> Path:
    return path.with_name(f"{path.stem}.{name}{path.suffix}")


def frames_of(source: Source, motion: MotionTable | None) -> Iterator[tuple[AnyFrame, Motion, VehicleState | None]]:
    """What a replay feeds the loop: frame, the motion that belongs to it, the vehicle's state."""
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


def _replay(
    path: Path,
    car: CarConfig,
    motion: MotionTable | None,
    rate_hz: float | None,
    outputs: tuple[Path | None, Path | None],
) -> dict[str, object]:
    source = open_source(path, car, rate_hz)
    loop = make_loop(car)
    statuses: Counter[LaneStatus] = Counter()
    times_ms: list[float] = []
    with contextlib.ExitStack() as files:
        files.callback(source.close)
        csv = files.enter_context(PosesCsv(outputs[0])) if outputs[0] else None
        paint = _painter(files, outputs[1], car, rate_hz or getattr(source, "rate_hz", 0.0) or car.camera.rate_hz)
        bar = files.enter_context(progress(f"replay {car.pipeline.name}", getattr(source, "frame_count", None)))
        for frame, moved, state in frames_of(source, motion):
            if isinstance(frame, Frame):
                _check_size(path, frame, car)
            begin = time.perf_counter()
            tick = loop.tick(frame, moved, state, frame.t_ns)
            times_ms.append(1e3 * (time.perf_counter() - begin))
            statuses[tick.estimate.status] += 1
            if csv is not None:
                csv.row(frame, tick.estimate, tick.command, times_ms[-1])
            paint(frame, tick)
            bar()
    return _row(path, car, statuses, times_ms)


def _check_size(path: Path, frame: Frame, car: CarConfig) -> None:
    try:
        check_size(frame, car.camera)
    except SourceError as error:
        raise SourceError(f"{path}: {error}, and give it with --car") from None


def _painter(
    files: contextlib.ExitStack, path: Path | None, car: CarConfig, rate_hz: float
) -> Callable[[AnyFrame, Tick], None]:
    if path is None:
        return lambda frame, tick: None
    video = files.enter_context(VideoWriter(path, rate_hz))
    camera = GroundCamera.from_config(car.camera)

    def paint(frame: AnyFrame, tick: Tick) -> None:
        picture: Image = frame.left if isinstance(frame, StereoFrame) else frame.image
        note = f"{frame.t_ns * 1e-9:.2f} s"
        video.write(draw(picture, tick.estimate, camera, tick.command, car.vehicle.reference_x_m, note))

    return paint


def _row(path: Path, car: CarConfig, statuses: Counter[LaneStatus], times_ms: list[float]) -> dict[str, object]:
    frames = sum(statuses.values())
    if frames == 0:
        print(f"{path}: no frames", file=sys.stderr)
    row: dict[str, object] = {"pipeline": car.pipeline.name, "source": str(path), "frames": frames}
    row.update({status.value.lower(): statuses[status] for status in LaneStatus})
    valid = frames - statuses[LaneStatus.LOST]
    row["availability_pct"] = 100.0 * valid / frames if frames else 0.0
    row["p50_ms"] = float(np.median(times_ms)) if times_ms else None
    row["p99_ms"] = float(np.quantile(times_ms, 0.99)) if times_ms else None
    return row
