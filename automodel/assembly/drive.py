"""A run from start to end: the car of car.toml, or the simulated one in lock-step or real time."""

from __future__ import annotations

import contextlib
import datetime
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from automodel.assembly.parts import (
    build_run,
    make_camera,
    make_checks,
    make_link,
    make_loop,
    make_recorder,
    run_config,
)
from automodel.assembly.run_watcher import Stopwatch, TimedLink, TimedSource, Watcher
from automodel.assembly.simulated_car import Simulation, board_of, lock_step, on_desk, real_time
from automodel.config import CarConfig, ConfigError
from automodel.console.keys import ArmKey
from automodel.console.messages import EventPrinter, say
from automodel.console.progress import progress
from automodel.interfaces import Clock
from automodel.recording.writer import McapRecorder
from automodel.runtime.clocks import MonotonicClock
from automodel.runtime.cores import LoopCores
from automodel.runtime.latencies import Latencies
from automodel.runtime.run_types import RunEnd, RunObserver, RunResult, TickRecord
from automodel.runtime.runner import Runner
from automodel.signals import DriverInput, Event
from automodel.sim.track_files import load_track
from automodel.sources.cameras import CameraStatus, CameraWatch, CaptureThread
from firmware_link.errors import LinkError, PortNotFound
from firmware_link.transport import likely_ports

_QUIET_REAL = frozenset({"end"})
_QUIET_SIMULATED = frozenset({"arming", "driving", "end"})
_DESK_PROMPT = "the board's motor and servo will move: lift the wheels; press Enter to arm, Ctrl-C to stop"
_WIDTH_HINT = 1.2  # times car.toml's width; tracking expects that with a sigma of 12 %: others are found late or never
_TRUTH_ONLY = (
    "laps", "lap_s", "max_abs_offset_m", "mae_offset_m", "left_lane",
    "estimate_mae_m", "misled_pct", "bound_exceeded_pct",
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOptions:
    """What a run is asked for beyond car.toml; `board` is the simulated one (None: that of [link] kind).

    `by_hand`: a person may drive, and a simulated car waits to be armed, too.
    """

    laps: int | None = None
    duration_s: float | None = None
    track: str = "tmr"
    direction: str = "forward"
    seed: int = 0
    style: str = "competition"
    board: str | None = None
    realtime: bool = False
    arm: bool = False
    by_hand: bool = False
    record: Path | None = None
    truth: Path | None = None

    @property
    def on_desk(self) -> bool:
        """Whether a real board drives the simulated car."""
        return self.board == "serial"

    @property
    def arms_itself(self) -> bool:
        """Whether the simulated car is armed without a person: a real board's motor turns, and a hand drives itself."""
        return self.arm if self.on_desk else not self.by_hand


@dataclass(frozen=True, slots=True, kw_only=True)
class RunReport:
    """The results of a run: `row` holds its metrics, `ended` says in words how it went, `failed` whether it failed.

    `loop` has the loop's own times from a frame's delivery to its command on the wire, of a simulated car's frames.
    """

    row: dict[str, Any]
    ended: str
    failed: bool
    loop: Latencies = field(default_factory=Latencies)


class Viewer(RunObserver, Protocol):
    """Who is shown the run; nothing here may wait."""

    def on_event(self, event: Event) -> None:
        """An event of the run."""
        ...


class Operator(Viewer, Protocol):
    """A person who is shown the run and commands it, by a page or a device; nothing here may wait."""

    def arm_requested(self) -> bool:
        """Whether arming was asked for since the last call."""
        ...

    def stop_requested(self) -> str | None:
        """Why the car has to stop, None where it has not; called every cycle, before `arm_requested`."""
        ...

    def wanted_by_hand(self) -> DriverInput | None:
        """What the person wants who drives by hand, None while nobody does; called every cycle, first of all."""
        ...


class _People:
    """The run's own watcher, teller and key, the operators, of whom the first goes before, and who only looks."""

    def __init__(
        self,
        watcher: Watcher,
        teller: EventPrinter,
        key: Callable[[], bool] | None,
        operators: Sequence[Operator],
        viewers: Sequence[Viewer],
    ) -> None:
        self._watcher, self._teller, self._key, self._operators = watcher, teller, key, operators
        self._shown = (*operators, *viewers)

    def on_tick(self, record: TickRecord) -> None:
        self._watcher.on_tick(record)
        for viewer in self._shown:
            viewer.on_tick(record)

    def on_event(self, event: Event) -> None:
        self._teller(event)
        for viewer in self._shown:
            viewer.on_event(event)

    def arm_requested(self) -> bool:
        by_key = self._key is not None and self._key()
        return any([by_key, *(operator.arm_requested() for operator in self._operators)])  # each is asked

    def stop_requested(self) -> str | None:
        reasons = [operator.stop_requested() for operator in self._operators]  # each is asked
        return next((reason for reason in reasons if reason is not None), None)

    def wanted_by_hand(self) -> DriverInput | None:
        wanted = [operator.wanted_by_hand() for operator in self._operators]
        return next((one for one in wanted if one is not None), None)


def drive_simulated(
    car: CarConfig,
    text: str,
    options: RunOptions,
    operators: Sequence[Operator] = (),
    viewers: Sequence[Viewer] = (),
    over: Callable[[], bool] = lambda: False,
) -> RunReport:
    """Drive the simulated car; `text` is the car.toml that a recording shall hold. Events go to stderr meanwhile.

    `over` is asked each cycle whether the run has to end.
    """
    lane = load_track(options.track).lane(options.direction)
    laps = 1 if options.laps is None and options.duration_s is None and not options.by_hand else options.laps
    if laps is not None and not lane.centerline.closed:
        raise ConfigError(f"{options.track}: the road is not closed, there are no laps; give --duration")
    width_m, told_m = float(lane.width_m(0.0)), car.lane.width_m
    if not 1.0 / _WIDTH_HINT < width_m / told_m < _WIDTH_HINT:
        say(f"{options.track}: its lane is {width_m:.3g} m wide, [lane] width_m of car.toml {told_m:.3g}: correct it")
    simulation = Simulation(
        track=options.track,
        direction=options.direction,
        seed=options.seed,
        style=options.style,
        link=options.board or board_of(car),
    )
    checks = make_checks(car, noiseless=options.style == "clean")
    total_m = laps * lane.centerline.length_m if laps else None
    watch = Stopwatch()
    with contextlib.ExitStack() as leaving:
        cores = leaving.enter_context(LoopCores()) if options.realtime else None
        key = leaving.enter_context(ArmKey(_DESK_PROMPT)).pressed if options.on_desk else None
        shown = leaving.enter_context(progress(f"run {options.track}", total_m))
        keep_truth = options.truth is not None
        watcher = Watcher(laps, shown, patient=not options.arms_itself, keep_truth=keep_truth)
        build = on_desk if options.on_desk else real_time if options.realtime else lock_step
        simulated = build(car, simulation, watcher.on_scene)
        leaving.callback(simulated.close)
        recorder = make_recorder(options.record, text, car) if options.record else None
        parts = build_run(
            car,
            source=TimedSource(simulated.source, watch),
            link=TimedLink(simulated.link, watch),
            clock=simulated.clock,
            loop=make_loop(car, checks=checks),
            recorder=recorder,
            auto_arm=options.arms_itself,
        )
        quiet = _QUIET_REAL if options.on_desk else _QUIET_SIMULATED
        people = _People(watcher, EventPrinter(simulated.clock, quiet), key, operators, viewers)
        config = run_config(car, collector_off=options.realtime)
        runner = Runner(
            parts,
            config,
            observer=people,
            arm_requested=people.arm_requested,
            stop_requested=people.stop_requested,
            wanted_by_hand=people.wanted_by_hand,
            on_event=people.on_event,
        )
        result = _run(runner, watcher, simulated.clock, options.duration_s, over, cores)
    if recorder is not None:
        say(recorder.summary())
    if options.truth is not None:
        watcher.write_truth(options.truth)
    latencies_ms = (result.latency_ms(50), result.latency_ms(99)) if options.realtime else watch.percentiles_ms()
    row = watcher.row(result, latencies_ms) | simulated.metrics()
    missed = watcher.gave_up() is not None or row["left_lane"] or (laps is not None and row["laps"] != laps)
    failed = bool(_broken(result) or missed)
    return RunReport(row=row, ended=watcher.ending(result), failed=failed, loop=watch.latencies)


def drive_real(
    car: CarConfig,
    text: str,
    options: RunOptions,
    operators: Sequence[Operator] = (),
    viewers: Sequence[Viewer] = (),
    over: Callable[[], bool] = lambda: False,
) -> RunReport:
    """Drive the car behind car.toml's camera and port, recorded; a person arms it. Events go to stderr meanwhile.

    `over` is asked each cycle whether the run has to end.
    """
    with contextlib.ExitStack() as leaving:
        cores = leaving.enter_context(LoopCores())
        watch = CameraWatch(car.camera.rate_hz, car.safety.frame_timeout_s)
        camera = CaptureThread(make_camera(car), watch)
        leaving.callback(camera.close)
        recorder = make_recorder(options.record or _recording_name(car), text, car)
        leaving.callback(recorder.close)
        key = leaving.enter_context(ArmKey())
        watcher = Watcher(None, leaving.enter_context(progress("run", None)))
        parts = build_run(
            car,
            source=camera,
            link=make_link(car),
            clock=MonotonicClock(),
            loop=make_loop(car, checks=make_checks(car)),
            recorder=recorder,
            auto_arm=options.arm,
        )

        def reopen() -> CaptureThread:
            nonlocal camera
            with cores.elsewhere():
                camera = CaptureThread(make_camera(car), watch)
            return camera

        people = _People(watcher, EventPrinter(parts.clock, _QUIET_REAL), key.pressed, operators, viewers)
        runner = Runner(
            parts,
            run_config(car, collector_off=True),
            observer=people,
            arm_requested=people.arm_requested,
            stop_requested=people.stop_requested,
            wanted_by_hand=people.wanted_by_hand,
            reopen=reopen,
            on_event=people.on_event,
        )
        try:
            result = _run(runner, watcher, parts.clock, options.duration_s, over, cores)
        except LinkError as error:  # only before the board's first hello: the run has not begun
            _discard(recorder)
            if isinstance(error, PortNotFound):
                raise
            raise LinkError(f"{error}; {likely_ports()}") from None
    say(recorder.summary())
    say(f"camera: {watch.status}")
    if camera.pair is not None:
        say(f"cameras: {camera.pair}")
    return RunReport(row=_row(result, watch.status), ended=watcher.ending(result), failed=_broken(result))


def _run(
    runner: Runner,
    watcher: Watcher,
    clock: Clock,
    duration_s: float | None,
    over: Callable[[], bool],
    cores: LoopCores | None,
) -> RunResult:
    """Run until the watcher has seen enough, `duration_s` is over, `over` says so or a signal comes.

    In real time as `cores` says.
    """
    if cores is not None:
        cores.claim()
    start_ns = clock.now_ns()

    def finished() -> bool:
        late = duration_s is not None and clock.now_ns() - start_ns >= duration_s * 1e9
        return late or over() or watcher.finished()

    result = runner.run(stop=finished)
    if result.traceback is not None:
        say(result.traceback.rstrip())
    if runner.warning:
        say(runner.warning)
    return result


def _broken(result: RunResult) -> bool:
    return result.stops > 0 or result.traceback is not None or result.end is RunEnd.SOURCE_FAILED


def _row(result: RunResult, camera: CameraStatus) -> dict[str, object]:
    """The metrics of a simulated run, with None for those that need its truth; the frames, and the camera's."""
    measured = {
        "frames": result.frames,
        "skipped": result.skipped,
        "stops": result.stops,
        "latency_p50_ms": result.latency_ms(50),
        "latency_p99_ms": result.latency_ms(99),
        "camera_hz": camera.rate_hz,
        "camera_dropped": camera.dropped,
        "camera_lost": camera.lost,
        "camera_restarts": camera.restarts,
        "unpaired": result.unpaired,
    }
    return {**dict.fromkeys(_TRUTH_ONLY), **measured}


def _discard(recorder: McapRecorder) -> None:
    """A run that never began leaves no file in the way of the next one."""
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
