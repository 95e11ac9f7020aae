"""Drives the simulated car: in lock-step, or against the real clock."""

from __future__ import annotations

import contextlib

from automodel.assembly.parts import make_loop, make_recorder
from automodel.assembly.run_watcher import Options, Stopwatch, TimedLink, TimedSource, Watcher, drive, run_config
from automodel.assembly.simulated_car import Simulation, lock_step, real_time
from automodel.config import CarConfig, ConfigError
from automodel.console.messages import EventTeller, say
from automodel.console.progress import progress
from automodel.console.tables import show
from automodel.estimation.ego_motion import MotionEstimator
from automodel.runtime.input_checks import InputChecks
from automodel.runtime.run_types import RunEnd, RunParts
from automodel.runtime.runner import Runner
from automodel.runtime.safety import Safety
from automodel.sim.track_files import load_track

QUIET = frozenset({"arming", "driving", "end"})


def drive_simulated(car: CarConfig, text: str, options: Options) -> int:
    """The exit code of a run; its figures go to stdout, what happens meanwhile to stderr."""
    lane = load_track(options.track).lane(options.direction)
    laps = 1 if options.laps is None and options.duration_s is None else options.laps
    if laps is not None and not lane.centerline.closed:
        raise ConfigError(f"{options.track}: the road is not closed, there are no laps; give --duration")
    simulation = Simulation(
        track=options.track,
        direction=options.direction,
        seed=options.seed,
        style=options.style,
        link=options.link or ("autonomos" if car.link.kind == "autonomos" else "emulated"),
    )
    checks = InputChecks(car, noiseless=options.style == "clean")
    total_m = laps * lane.centerline.length_m if laps else None
    watch = Stopwatch()
    with contextlib.ExitStack() as leaving:
        watcher = Watcher(laps, leaving.enter_context(progress(f"run {options.track}", total_m)))
        simulated = (real_time if options.realtime else lock_step)(car, simulation, watcher.on_scene)
        leaving.callback(simulated.close)
        recorder = make_recorder(options.record, text, car) if options.record else None
        parts = RunParts(
            source=simulated.source if options.realtime else TimedSource(simulated.source, watch),
            link=simulated.link if options.realtime else TimedLink(simulated.link, watch),
            recorder=recorder,
            motion=MotionEstimator(car.vehicle),
            loop=make_loop(car, checks=checks),
            safety=Safety(car.safety, auto_arm=True),
            clock=simulated.clock,
        )
        teller = EventTeller(simulated.clock, QUIET)
        runner = Runner(parts, run_config(car, options.realtime), observer=watcher, on_event=teller)
        result = drive(runner, watcher, simulated.clock, options.duration_s)
    gave_up = watcher.gave_up()
    if gave_up is not None:
        say(gave_up)
    if recorder is not None:
        say(recorder.summary())
    if options.truth is not None:
        watcher.write_truth(options.truth)
    latencies_ms = (result.latency_ms(50), result.latency_ms(99)) if options.realtime else watch.percentiles_ms()
    row = watcher.row(result, latencies_ms)
    show("run", [row], options.as_json)
    broken = result.stops > 0 or result.traceback is not None or result.end is RunEnd.SOURCE_FAILED
    missed = gave_up is not None or row["left_lane"] or (laps is not None and row["laps"] != laps)
    return 1 if broken or missed else 0
