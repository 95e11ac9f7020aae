"""Drives a real car: camera, serial port, and a person who arms it."""

from __future__ import annotations

import contextlib
import datetime
from pathlib import Path

from automodel.assembly.links import make_link
from automodel.assembly.parts import make_camera, make_loop, make_recorder
from automodel.assembly.run_watcher import Options, Watcher, drive, run_config
from automodel.config import CarConfig, ConfigError
from automodel.console.keys import ArmKey
from automodel.console.messages import EventTeller, say
from automodel.console.progress import progress
from automodel.console.tables import show
from automodel.estimation.ego_motion import MotionEstimator
from automodel.recording.writer import McapRecorder
from automodel.runtime.clocks import MonotonicClock
from automodel.runtime.input_checks import InputChecks
from automodel.runtime.run_types import RunEnd, RunParts, RunResult
from automodel.runtime.runner import Runner
from automodel.runtime.safety import Safety
from automodel.sources.cameras import CaptureThread
from firmware_link.errors import LinkError, PortNotFound
from firmware_link.transport import likely_ports

QUIET = frozenset({"end"})
COLUMNS = ("frames", "skipped", "stops", "latency_p50_ms", "latency_p99_ms")
_TRUTH_ONLY = ("laps", "lap_s", "max_abs_offset_m", "mae_offset_m", "left_lane")


def drive_real(car: CarConfig, text: str, options: Options) -> int:
    """The exit code of a run; its figures go to stdout, what happens meanwhile to stderr."""
    with contextlib.ExitStack() as leaving:
        camera = CaptureThread(make_camera(car))
        leaving.callback(camera.close)
        recorder = make_recorder(options.record or _recording_name(car), text, car)
        leaving.callback(recorder.close)
        key = leaving.enter_context(ArmKey())
        watcher = Watcher(None, leaving.enter_context(progress("run", None)))
        parts = RunParts(
            source=camera,
            link=make_link(car),
            recorder=recorder,
            motion=MotionEstimator(car.vehicle),
            loop=make_loop(car, checks=InputChecks(car)),
            safety=Safety(car.safety, auto_arm=options.arm),
            clock=MonotonicClock(),
        )
        runner = Runner(
            parts,
            run_config(car, collector_off=True),
            observer=watcher,
            arm_requested=key.pressed,
            reopen=lambda: CaptureThread(make_camera(car)),
            on_event=EventTeller(parts.clock, QUIET),
        )
        try:
            result = drive(runner, watcher, parts.clock, options.duration_s)
        except LinkError as error:  # only before the board's first hello: the run has not begun
            _drop(recorder)
            if isinstance(error, PortNotFound):
                raise
            raise LinkError(f"{error}; {likely_ports()}") from None
    say(recorder.summary())
    show("run", [_row(result)], options.as_json, None if options.as_json else COLUMNS)
    return 1 if result.stops or result.traceback is not None or result.end is RunEnd.SOURCE_FAILED else 0


def _row(result: RunResult) -> dict[str, object]:
    """The figures of a simulated run, those that need its truth empty; and the frames."""
    measured = {
        "frames": result.frames,
        "skipped": result.skipped,
        "stops": result.stops,
        "latency_p50_ms": result.latency_ms(50),
        "latency_p99_ms": result.latency_ms(99),
    }
    return {**dict.fromkeys(_TRUTH_ONLY), **measured}


def _drop(recorder: McapRecorder) -> None:
    """A run that never began leaves no file in the way of the next try."""
    recorder.close()
    with contextlib.suppress(OSError):
        recorder.path.unlink()


def _recording_name(car: CarConfig) -> Path:
    folder = Path(car.recording.directory)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be made: {error.strerror}; see [recording] directory") from None
    return folder / f"{datetime.datetime.now():%Y%m%d-%H%M%S}.mcap"
