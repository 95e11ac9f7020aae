"""The results of a run in figures and in words."""

from __future__ import annotations

import numpy as np
import pytest

from automodel.assembly.run_watcher import Watcher
from automodel.runtime.latencies import Latencies
from automodel.runtime.loop import Tick
from automodel.runtime.run_types import RunEnd, RunResult, TickRecord
from automodel.runtime.safety import Action, SafetyDecision, SafetyMode
from automodel.signals import NEUTRAL, Event, LaneEstimate, LanePose, LaneStatus, Motion
from automodel.sim.plant import CarState
from automodel.sim.truth import Truth
from automodel.sim.world import Scene

SECOND_NS = 1_000_000_000
STILL = Motion(t_ns=0, speed_mps=0.0, yaw_rate_radps=0.0)
DRIVING = SafetyDecision(mode=SafetyMode.DRIVING, action=Action.PASS, arm=False, disarm=False, reason=None, events=())


def watched(reaches_m: list[float]) -> Watcher:
    """A watcher of a car that drives 1 m/s in a lane of 0.4 m, a scene a second, each with the reach of its body."""
    watcher = Watcher(None, lambda *_: None)
    for index, reach_m in enumerate(reaches_m):
        car = CarState(
            x_m=0.0, y_m=0.0, yaw_rad=0.0, speed_mps=1.0, steering_rad=0.0, yaw_rate_radps=0.0, distance_m=float(index)
        )
        truth = Truth(offset_m=0.01, heading_rad=0.0, curvature_per_m=0.0, width_m=0.4, s_m=float(index), lap=0)
        watcher.on_scene(Scene(t_ns=index * SECOND_NS, index=index, car=car, truth=truth, reach_m=reach_m))
        record = TickRecord(
            t_ns=index * SECOND_NS, frame=None, state=None, tick=None, decision=DRIVING, sent=None, latency_ns=None
        )
        watcher.on_tick(record)
    return watcher


def result(*events: tuple[str, str]) -> RunResult:
    return RunResult(
        end=RunEnd.STOP,
        frames=5,
        skipped=0,
        overruns=0,
        stops=0,
        latencies=Latencies(),
        events=tuple([Event(t_ns=SECOND_NS, kind=kind, text=text) for kind, text in events]),
        traceback=None,
    )


@pytest.mark.parametrize(
    ("reaches_m", "left_lane", "text"),
    [
        ([0.1, 0.2, 0.199, 0.1], 0, "drove 3.0 m and stayed in its lane"),
        ([0.1, 0.1, 0.21, 0.3, 0.1], 1, "left its lane at t = 2.0 s, s = 2.0 m"),
        ([0.3, 0.1, 0.21, 0.1, 0.3], 3, "left its lane at t = 0.0 s, s = 0.0 m (and 2 more times)"),
    ],
)
def test_departures_are_the_same_in_figures_and_in_words(reaches_m: list[float], left_lane: int, text: str) -> None:
    watcher = watched(reaches_m)
    assert watcher.row(result(), (None, None))["left_lane"] == left_lane
    assert watcher.ending(result()) == text


def test_holds_of_an_overloaded_machine_are_counted_in_words() -> None:
    ending = watched([0.1, 0.1]).ending(result(("hold", "overloaded: frames 97 ms late (limit 60)")))
    assert ending == "drove 1.0 m and stayed in its lane; held 1 time because the machine was overloaded"


@pytest.mark.parametrize(("times", "text"), [(1, "held 1 time"), (3, "held 3 times")])
def test_holds_for_an_uncertain_offset_are_counted_in_words(times: int, text: str) -> None:
    hold = ("hold", "offset uncertain: 0.14 m (limit 0.10)")
    others = [("hold", "the lane is lost"), ("driving", "healthy again"), ("arm-refused", hold[1])]
    ending = watched([0.1, 0.1]).ending(result(*[hold] * times, *others))
    assert ending == f"drove 1.0 m and stayed in its lane; {text} because its offset was uncertain"


def test_estimates_are_held_against_the_truth() -> None:
    watcher = watched([0.1] * 4)
    told = [(0.01, 0.02), (0.03, 0.05), (0.12, 0.05), (0.12, 0.2)]  # offset and its bound; the truth is 0.01 of 0.4 m
    for index, (offset_m, bound_m) in enumerate(told):
        pose = LanePose(offset_m=offset_m, heading_rad=0.0, curvature_per_m=0.0, width_m=0.4,
                        covariance=np.eye(3), offset_bound_m=bound_m, heading_bound_rad=0.1)  # fmt: skip
        estimate = LaneEstimate(t_ns=index * SECOND_NS, status=LaneStatus.TRACKING, pose=pose)
        tick = Tick(estimate=estimate, motion=STILL, wanted=NEUTRAL, command=NEUTRAL)
        record = TickRecord(
            t_ns=index * SECOND_NS + 5, frame=None, state=None, tick=tick, decision=DRIVING, sent=None, latency_ns=None
        )
        watcher.on_tick(record)
    row = watcher.row(result(), (None, None))
    assert row["estimate_mae_m"] == pytest.approx((0.0 + 0.02 + 0.11 + 0.11) / 4)
    assert row["misled_pct"] == row["bound_exceeded_pct"] == 25.0
    assert "misled it in 1 frame, from t = 2.0 s on" in watcher.ending(result())
