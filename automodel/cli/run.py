"""`automodel run`: drive, a real car or a simulated one, by the same loop."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import sys
from dataclasses import dataclass
from pathlib import Path

import click

from automodel.cli.driving import Stopwatch, TimedLink, TimedSource, Watcher
from automodel.cli.figures import show
from automodel.cli.keys import ArmKey
from automodel.cli.parts import car_of, car_text, make_camera, make_loop
from automodel.cli.progress import progress
from automodel.clocks import MonotonicClock
from automodel.config import PIPELINES, CarConfig, ConfigError
from automodel.estimation.motion import MotionEstimator
from automodel.interfaces import Recorder
from automodel.run_values import RunConfig, RunParts, RunResult
from automodel.runner import Runner
from automodel.safety import Safety


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """What the command line says."""

    laps: int | None
    duration_s: float | None
    track: str | None
    direction: str
    seed: int
    style: str
    realtime: bool
    arm: bool
    record: Path | None
    truth: Path | None
    as_json: bool


@click.command("run")
@click.option("--car", "car_file", type=click.Path(path_type=Path), help="car.toml (default: the simulated car).")
@click.option("--pipeline", type=click.Choice(PIPELINES), help="Which paper sees the lane.")
@click.option("--speed", "speed_mps", type=float, help="Wanted speed [m/s] (default: that of car.toml).")
@click.option("--laps", type=click.IntRange(1), help="End after so many laps (simulated car; default 1).")
@click.option("--duration", "duration_s", type=click.FloatRange(0, min_open=True), help="End after so many seconds.")
@click.option("--track", help="Simulated: tmr, oval, chicane, or a .toml or .csv file.  [default: tmr]")
@click.option("--direction", type=click.Choice(["forward", "reverse"]), default="forward", show_default=True)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Simulated: light, floor, noise.")
@click.option(
    "--style", type=click.Choice(["clean", "competition", "varied"]), default="competition", show_default=True
)
@click.option(
    "--realtime", is_flag=True, help="Simulated: against the real clock, camera and board in another process."
)
@click.option("--arm", is_flag=True, help="Real car: arm once without asking, as soon as all is well.")
@click.option(
    "--record", type=click.Path(path_type=Path), help="Write the run here (.mcap); a real car always records."
)
@click.option("--truth", type=click.Path(path_type=Path), help="Simulated: write truth.csv here.")
@click.option("--json", "as_json", is_flag=True, help="Figures as JSON on stdout.")
def command(car_file: Path | None, pipeline: str | None, speed_mps: float | None, **rest: object) -> int:
    """Drive. Without --car: a simulated car on a simulated track, as fast as the machine can (or --realtime)."""
    car = car_of(car_file, pipeline)
    if speed_mps is not None:
        car = _with_speed(car, speed_mps)
    options = Options(**rest)  # type: ignore[arg-type]
    simulated = car.camera.source == "sim"
    if simulated != (car.link.port == "sim"):
        raise ConfigError('car.toml: [camera] source and [link] port: either both are "sim" or neither is')
    if not simulated:
        return _drive_real(car, car_text(car_file), options)
    return _drive_simulated(car, car_text(car_file), options)


def _with_speed(car: CarConfig, speed_mps: float) -> CarConfig:
    if not 0 < speed_mps <= car.safety.speed_max_mps:
        raise ConfigError(f"--speed: {speed_mps} m/s where 0 .. {car.safety.speed_max_mps} ([safety] speed_max_mps) is")
    return dataclasses.replace(car, control=dataclasses.replace(car.control, speed_mps=speed_mps))


def _drive_simulated(car: CarConfig, text: str, options: Options) -> int:
    from automodel.cli.simulated import Simulation, lock_step, real_time
    from automodel.sim.track import load_track

    track = options.track or "tmr"
    simulation = Simulation(track=track, direction=options.direction, seed=options.seed, style=options.style)
    lane = load_track(track).lane(options.direction)
    laps = options.laps
    if laps is None and options.duration_s is None:
        laps = 1
    if laps is not None and not lane.centerline.closed:
        raise ConfigError(f"{track}: the road is not closed, there are no laps; give --duration")
    total = laps * lane.centerline.length_m if laps else None
    with contextlib.ExitStack() as leaving:
        watcher = Watcher(car, laps, leaving.enter_context(progress(f"run {track}", total)))
        simulated = (real_time if options.realtime else lock_step)(car, simulation, watcher.on_scene)
        leaving.callback(simulated.close)
        watch = Stopwatch()
        parts = RunParts(
            source=simulated.source if options.realtime else TimedSource(simulated.source, watch),
            link=simulated.link if options.realtime else TimedLink(simulated.link, watch),
            recorder=_recorder(options.record, text, car) if options.record else None,
            motion=MotionEstimator(car.vehicle),
            loop=make_loop(car),
            safety=Safety(car.safety, auto_arm=True),
            clock=simulated.clock,
        )
        result = _run(parts, car, options, watcher)
    if options.truth is not None:
        watcher.write_truth(options.truth)
    latencies = watch.percentile_ms(50), watch.percentile_ms(99)
    if options.realtime:
        latencies = result.latency_ms(50), result.latency_ms(99)
    row = watcher.row(result, latencies)
    show("run", [row], options.as_json)
    wanted = laps is None or row["laps"] == laps
    return 0 if wanted and not result.stops and not row["left_lane"] and result.traceback is None else 1


def _drive_real(car: CarConfig, text: str, options: Options) -> int:
    from automodel.sources.capture import CaptureThread
    from firmware_link.arduino import ArduinoLink
    from firmware_link.transport import SerialTransport

    if options.laps is not None or options.track is not None or options.truth is not None or options.realtime:
        raise ConfigError("--laps, --track, --truth and --realtime are for the simulated car")
    if car.camera.source not in ("csi", "usb"):
        raise ConfigError(f"car.toml: [camera] source {car.camera.source!r}: a car is driven by csi or usb; see replay")
    record = options.record or _recording_name(car)
    with contextlib.ExitStack() as leaving:
        key = leaving.enter_context(ArmKey())
        watcher = Watcher(car, None, leaving.enter_context(progress("run", None)))
        parts = RunParts(
            source=CaptureThread(make_camera(car)),
            link=ArduinoLink(SerialTransport(car.link.port, car.link.baud), car.link, car.vehicle),
            recorder=_recorder(record, text, car),
            motion=MotionEstimator(car.vehicle),
            loop=make_loop(car),
            safety=Safety(car.safety, auto_arm=options.arm),
            clock=MonotonicClock(),
        )
        result = _run(parts, car, options, watcher, key)
    print(f"{record}: recorded", file=sys.stderr)
    row = {
        "frames": result.frames,
        "skipped": result.skipped,
        "stops": result.stops,
        "latency_p50_ms": result.latency_ms(50),
        "latency_p99_ms": result.latency_ms(99),
    }
    show("run", [row], options.as_json)
    return 1 if result.stops or result.traceback is not None else 0


def _run(parts: RunParts, car: CarConfig, options: Options, watcher: Watcher, key: ArmKey | None = None) -> RunResult:
    config = RunConfig(
        command_validity_s=car.safety.command_validity_s,
        period_s=1.0 / car.camera.rate_hz,
        collector_off=key is not None or options.realtime,
    )
    runner = Runner(parts, config, observer=watcher, arm_requested=key.pressed if key is not None else None)
    start_ns = parts.clock.now_ns()

    def finished() -> bool:
        over = options.duration_s is not None and parts.clock.now_ns() - start_ns >= options.duration_s * 1e9
        return over or watcher.finished()

    result = runner.run(stop=finished)
    if result.traceback is not None:
        print(result.traceback, file=sys.stderr)
    return result


def _recorder(path: Path, text: str, car: CarConfig) -> Recorder:
    from automodel.recording.writer import McapRecorder

    return McapRecorder(path, text, car.recording)


def _recording_name(car: CarConfig) -> Path:
    folder = Path(car.recording.directory)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be made: {error.strerror}; see [recording] directory") from None
    return folder / f"{datetime.datetime.now():%Y%m%d-%H%M%S}.mcap"
