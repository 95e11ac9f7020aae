"""A machine that is too slow, or stands still for a moment: whole runs on virtual time, with the emulated board."""

from __future__ import annotations

import contextlib
import re
from dataclasses import replace

import numpy as np
import pytest

from automodel.assembly.parts import build_run, make_loop, run_config
from automodel.assembly.run_watcher import Watcher
from automodel.assembly.simulated_car import Simulation, lock_step
from automodel.bench.faults.catalogue import FAULTS
from automodel.bench.faults.fault import At, Hooks, Stall
from automodel.bench.faults.judge import Observed, draw_plan
from automodel.bench.faults.measure import CAR, TRUTH, FaultRig
from automodel.config import CarConfig, ControlConfig, SafetyConfig
from automodel.runtime.clocks import MonotonicClock, VirtualClock
from automodel.runtime.runner import Runner
from automodel.signals import Frame, LaneEstimate, Motion
from automodel.sim.sources import LockStepSource
from automodel.sim.track import Lane
from automodel.sim.track_files import load_track
from automodel.sim.world import Scene, TrueLane
from automodel.types import Image
from firmware_link.pulses import PulseTable

START_NS = 2_000_000_000
SHOWN_NS = 1_500_000_000  # the run goes on for so long


def driven(stall: Stall, speed_mps: float) -> Observed:
    """The run of a car that drives steadily at `speed_mps` when the stall comes."""
    plan = draw_plan(FAULTS[0], 0, 0, 1)
    plan = replace(plan, start_ns=START_NS, end_ns=START_NS + SHOWN_NS, until_ns=START_NS + SHOWN_NS, press_ns=None)
    plan = replace(plan, place=0.0, offset_m=0.0, speed_mps=speed_mps)
    car: CarConfig = replace(CAR, control=replace(CAR.control, speed_mps=speed_mps))
    seen = FaultRig(car, TRUTH, plan, Hooks(stall=stall)).run()
    assert seen.error is None
    return seen


def events(seen: Observed) -> list[tuple[str, str]]:
    return [(event.kind, event.text) for event in seen.events if event.t_ns >= START_NS]


def drives(seen: Observed, t_ns: int) -> bool:
    """Whether the motor is driven at that time."""
    return [motor for t, _, motor in seen.pins if t <= t_ns][-1] != seen.neutral_us


@pytest.mark.parametrize("at", [At.PIPELINE, At.AFTER])
def test_a_slow_car_drives_on_after_a_pause_in_which_its_board_disarmed_itself(at: At) -> None:
    seen = driven(Stall(at=at, seconds=0.15), 0.5)
    found = [event for event in events(seen) if event[0] not in ("vehicle-fault", "end")]
    assert [kind for kind, _ in found][:2] == ["hold", "driving"]
    assert found[0][1].startswith("the loop stood still for 0.1")
    assert "stop" not in [kind for kind, _ in found]
    neutral_ns = next(t for t, _, motor in seen.pins if t > START_NS and motor == seen.neutral_us)
    assert neutral_ns <= START_NS + 150_000_000  # the board's own timer, whatever the host does
    assert drives(seen, START_NS + 500_000_000)
    assert drives(seen, START_NS + SHOWN_NS)


@pytest.mark.parametrize(("seconds", "speed_mps"), [(0.15, 1.0), (0.31, 0.1)])
def test_a_fast_car_and_a_long_pause_stop(seconds: float, speed_mps: float) -> None:
    seen = driven(Stall(at=At.PIPELINE, seconds=seconds), speed_mps)
    assert events(seen)[0][0] == "stop"
    assert not drives(seen, START_NS + SHOWN_NS)


def test_a_machine_that_is_far_too_slow_says_so_and_stops_when_the_hold_is_over() -> None:
    seen = driven(Stall(at=At.PIPELINE, seconds=0.075, again=True), 1.0)
    found = [(kind, text) for kind, text in events(seen) if kind in ("hold", "stop")]
    assert [kind for kind, _ in found] == ["hold", "stop"]
    assert found[0][1] == "overloaded: frames 78 ms late (limit 60)"
    assert re.fullmatch(r"held for 0\.3\d\d s: overloaded: frames [789]\d ms late \(limit 60\)", found[1][1])


def motor_mps(seen: Observed, t_ns: int) -> float:
    """The speed [m/s] that the motor's pulse stands for at that time."""
    motor = CAR.link.motor
    return PulseTable(motor.pulse_us, motor.speed_mps).value([us for t, _, us in seen.pins if t <= t_ns][-1])


def test_a_machine_that_is_slow_drives_slower() -> None:
    seen = driven(Stall(at=At.PIPELINE, seconds=0.04, again=True), 1.0)
    assert [kind for kind, _ in events(seen)] == ["end"]
    assert motor_mps(seen, START_NS) == pytest.approx(1.0, abs=0.01)
    slow_mps = [motor_mps(seen, START_NS + SHOWN_NS - ms * 1_000_000) for ms in range(0, 500, 10)]
    # 43 ms after its capture at least, and another frame's period at most: 0.04 m in that time
    assert min(slow_mps) >= 0.04 / 0.060 - 0.01
    assert max(slow_mps) <= 0.04 / 0.043 + 0.01


class NothingToSee:
    """An eye of the simulated world for a pipeline that knows the truth."""

    def __init__(self, car: CarConfig) -> None:
        noise = np.random.default_rng(0).integers(0, 256, (car.camera.height_px, car.camera.width_px), np.uint8)
        self._image: Image = noise

    def render(self, *pose: float) -> Image:
        return self._image


class SlowTruth(TrueLane):
    """The truth, `work_s` after it was asked for."""

    def __init__(self, lane: Lane, work_s: float) -> None:
        super().__init__(lane)
        self._work_s = work_s
        self.clock: VirtualClock | MonotonicClock = VirtualClock()

    def step(self, frame: Frame, motion: Motion) -> LaneEstimate:
        estimate = super().step(frame, motion)
        self.clock.sleep(self._work_s)
        return estimate


def worst_offset_m(work_s: float) -> float:
    """The greatest offset [m] of ten seconds on the competition track at 1.5 m/s, however late the commands are."""
    car = CarConfig(control=ControlConfig(speed_mps=1.5, late_lanes=1.0), safety=SafetyConfig(frame_timeout_s=0.095))
    truth = SlowTruth(load_track("tmr").lane("forward"), work_s)
    watcher = Watcher(None, lambda *_: None)

    def on_scene(scene: Scene) -> None:
        truth.on_scene(scene)
        watcher.on_scene(scene)

    with contextlib.ExitStack() as leaving:
        simulated = lock_step(car, Simulation(style="clean"), on_scene)
        leaving.callback(simulated.close)
        assert isinstance(simulated.source, LockStepSource)
        simulated.source.world.renderer = NothingToSee(car)
        truth.clock = clock = simulated.clock
        loop = make_loop(car, pipeline=truth)
        parts = build_run(car, source=simulated.source, link=simulated.link, clock=clock, loop=loop)
        runner = Runner(parts, run_config(car, collector_off=False), observer=watcher)
        result = runner.run(stop=lambda: clock.now_ns() >= 10_000_000_000)
    offset_m = watcher.row(result, (None, None))["max_abs_offset_m"]
    assert isinstance(offset_m, float)
    return offset_m


def test_the_measured_delay_is_made_good_by_prediction(monkeypatch: pytest.MonkeyPatch) -> None:
    late_m = worst_offset_m(0.057)
    monkeypatch.setattr("automodel.runtime.runner.WORK_SHARE", 0.0)  # nothing is measured
    assert late_m < 0.5 * worst_offset_m(0.057)
