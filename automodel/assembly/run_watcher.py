"""Watches a run: progress, the simulator's truth, and the results."""

from __future__ import annotations

import csv
import math
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from automodel.interfaces import Source, VehicleLink
from automodel.output_files import output_text
from automodel.runtime.input_checks import UNCERTAIN
from automodel.runtime.run_types import RunEnd, RunResult, TickRecord
from automodel.runtime.safety import OVERLOADED, SafetyMode
from automodel.signals import FALSE_LANE, Command, Frame, LanePose, StereoFrame, VehicleState
from automodel.sim.world import Scene
from automodel.types import Bools, FloatArray

TRUTH_COLUMNS = (
    "t_s", "frame", "offset_m", "heading_rad", "curvature_per_m", "width_m", "x_m", "y_m", "yaw_rad"
)  # fmt: skip
GIVE_UP_S = 5.0  # a simulated car that stands for so long has failed


class Watcher:
    """Implements `RunObserver`, and takes the scenes of the simulator, which a real car does not have.

    `patient`: a simulated car may stand for as long as it likes, because a person drives it.
    """

    def __init__(self, laps: int | None, advance: Callable[..., None], *, patient: bool = False) -> None:
        self._laps, self._advance, self._patient = laps, advance, patient
        self.scenes: list[Scene] = []
        self._estimates: list[tuple[int, LanePose]] = []  # with their capture times [ns]
        self._driving_from: int | None = None  # index of the first scene in which it was driving
        self._stood_since_ns: int | None = None
        self._now_ns = 0
        self._reason: str | None = None
        self._lap_times_ns: list[int] = []

    def on_scene(self, scene: Scene) -> None:
        """The truth of a frame."""
        if self.scenes:
            before = self.scenes[-1]
            self._advance(max(scene.car.distance_m - before.car.distance_m, 0.0))
            if scene.truth.lap > before.truth.lap:
                self._lap_times_ns.append(scene.t_ns)
        self.scenes.append(scene)

    def on_tick(self, record: TickRecord) -> None:
        """A turn of the runner."""
        if self.scenes and record.tick is not None and record.tick.estimate.pose is not None:
            self._estimates.append((record.tick.estimate.t_ns, record.tick.estimate.pose))
        driving = record.decision.mode in (SafetyMode.DRIVING, SafetyMode.HOLD)
        if driving and self._driving_from is None:
            self._driving_from = max(len(self.scenes) - 1, 0)
            self._lap_times_ns = [record.t_ns]
        if self.scenes and abs(self.scenes[-1].car.speed_mps) >= 0.01:
            self._stood_since_ns = None
        elif self._stood_since_ns is None:
            self._stood_since_ns = record.t_ns
        self._now_ns, self._reason = record.t_ns, record.decision.reason

    def finished(self) -> bool:
        """Whether the laps are driven, or the simulated car has given up."""
        if not self.scenes:
            return False
        if self._laps is not None and self.scenes[-1].truth.lap >= self._laps:
            return True
        return self.gave_up() is not None

    def gave_up(self) -> str | None:
        """Why the simulated car stands and will not go on; None where it does."""
        stood = self._stood_since_ns
        if self._patient or stood is None or self._now_ns - stood <= GIVE_UP_S * 1e9:
            return None
        return f"the car has stood for {GIVE_UP_S:g} s: {self._reason or 'it was given no speed'}"

    def row(self, result: RunResult, latencies_ms: tuple[float | None, float | None]) -> dict[str, object]:
        """The figures of a simulated run."""
        scenes = self._driven()
        offsets = np.abs([scene.truth.offset_m for scene in scenes])
        laps = np.diff(self._lap_times_ns) * 1e-9
        return {
            "laps": max((scene.truth.lap for scene in scenes), default=0),
            "lap_s": float(laps.mean()) if len(laps) else None,
            "max_abs_offset_m": float(offsets.max()) if len(offsets) else None,
            "mae_offset_m": float(offsets.mean()) if len(offsets) else None,
            "left_lane": len(self._departures()),
            "stops": result.stops,
            "latency_p50_ms": latencies_ms[0],
            "latency_p99_ms": latencies_ms[1],
            **self._estimated(),
        }

    def ending(self, result: RunResult) -> str:
        """In words how the run went: what went wrong and where, or what was driven; and why it was held."""
        held = ((UNCERTAIN, "its offset was uncertain"), (OVERLOADED, "the machine was overloaded"))
        return "; ".join(
            [self._outcome(result), *self._led_astray(), *(text for what in held for text in _holds(result, *what))]
        )

    def _outcome(self, result: RunResult) -> str:
        wrong = [*self._left_lane(), *self._stops(result)]
        if result.end is RunEnd.SIGNAL:
            wrong.insert(0, f"stopped by {result.events[-1].text}")
        elif result.end is RunEnd.SOURCE_FAILED:
            wrong.append(RunEnd.SOURCE_FAILED.value)
        gave_up = self.gave_up()
        if gave_up is not None:
            wrong.append(gave_up)
        if wrong:
            return "; ".join(wrong)
        if not self.scenes:
            return f"{result.frames} frames, no stop"
        if self._driving_from is None:
            return f"the car did not drive: {self._reason or 'it was not armed yet'}"
        laps = self.scenes[-1].truth.lap
        driven = f"{laps} lap{'s' if laps > 1 else ''}" if laps > 0 else f"{self.scenes[-1].car.distance_m:.1f} m"
        return f"drove {driven} and stayed in its lane"

    def _errors(self) -> FloatArray:
        """Of the estimates of scenes (n, 6): time [s], errors of offset and heading, their bounds, lane width."""
        truth = {scene.t_ns: scene.truth for scene in self.scenes}
        rows = [
            (
                1e-9 * t_ns,
                abs(pose.offset_m - true.offset_m),
                abs(math.remainder(pose.heading_rad - true.heading_rad, math.tau)),
                pose.offset_bound_m,
                pose.heading_bound_rad,
                true.width_m,
            )
            for t_ns, pose in self._estimates
            if (true := truth.get(t_ns)) is not None
        ]
        return np.array(rows, dtype=np.float64).reshape(-1, 6)

    def _estimated(self) -> dict[str, object]:
        """How true the estimates were: mean error of the offset, shares that mislead or exceed a bound."""
        if not len(errors := self._errors()):
            return dict.fromkeys(("estimate_mae_m", "misled_pct", "bound_exceeded_pct"))
        _, offset, heading, offset_bound, heading_bound, _ = errors.T
        return {
            "estimate_mae_m": float(offset.mean()),
            "misled_pct": 100.0 * float(_misled(errors).mean()),
            "bound_exceeded_pct": 100.0 * float(((offset > offset_bound) | (heading > heading_bound)).mean()),
        }

    def _led_astray(self) -> list[str]:
        """The first estimate that misled, and how many did."""
        errors = self._errors()
        misled = np.flatnonzero(_misled(errors))
        if not len(misled):
            return []
        start_s = 1e-9 * self.scenes[0].t_ns
        frames = f"{len(misled)} frame{'s' if len(misled) > 1 else ''}"
        return [f"its estimate misled it in {frames}, from t = {errors[misled[0], 0] - start_s:.1f} s on"]

    def _departures(self) -> list[Scene]:
        """The scenes in which the body has just left the lane."""
        scenes = self._driven()
        outside = np.array([scene.reach_m > 0.5 * scene.truth.width_m for scene in scenes], dtype=np.int8)
        return [scenes[index] for index in np.flatnonzero(np.diff(outside, prepend=0) == 1)]

    def _left_lane(self) -> list[str]:
        """The first place where the body left the lane, and how often it did."""
        departures = self._departures()
        if not departures:
            return []
        first = departures[0]
        often = f" (and {len(departures) - 1} more times)" if len(departures) > 1 else ""
        return [f"left its lane at t = {first.t_ns * 1e-9:.1f} s, s = {first.truth.s_m:.1f} m{often}"]

    def _stops(self, result: RunResult) -> list[str]:
        """The first stop that had to be cleared by a person, and how many there were."""
        stop = next((event for event in result.events if event.kind == "stop"), None)
        if result.stops == 0 or stop is None:
            return []
        often = f" (and {result.stops - 1} more times)" if result.stops > 1 else ""
        start_ns = self.scenes[0].t_ns if self.scenes else result.events[0].t_ns
        return [f"stopped at t = {(stop.t_ns - start_ns) * 1e-9:.1f} s: {stop.text}{often}"]

    def _driven(self) -> list[Scene]:
        return self.scenes[self._driving_from :] if self._driving_from is not None else []

    def write_truth(self, path: Path) -> None:
        """truth.csv: where the car really was, a row a frame; raises ConfigError where it cannot be written."""
        with output_text(path) as file:
            table = csv.writer(file, lineterminator="\n")
            table.writerow(TRUTH_COLUMNS)
            for scene in self.scenes:
                truth, car = scene.truth, scene.car
                values = (truth.offset_m, truth.heading_rad, truth.curvature_per_m, truth.width_m)
                numbers = [f"{v:.6f}" for v in (*values, car.x_m, car.y_m, car.yaw_rad)]
                table.writerow([f"{scene.t_ns * 1e-9:.9f}", scene.index, *numbers])


def _misled(errors: FloatArray) -> Bools:
    """The rows (n,) of `Watcher._errors` off by more than `FALSE_LANE` of the lane's width while the bound is less."""
    return np.asarray((errors[:, 1] > FALSE_LANE * errors[:, 5]) & ~(errors[:, 3] >= errors[:, 1]))


def _holds(result: RunResult, word: str, reason: str) -> list[str]:
    """How often the car was held with `word` in the event's text, and for what `reason`, in words."""
    held = sum(event.kind == "hold" and word in event.text for event in result.events)
    return [f"held {held} time{'s' if held > 1 else ''} because {reason}"] if held else []


class Stopwatch:
    """The loop's own time from a frame's delivery to its command on the wire, where the run lives on virtual time."""

    def __init__(self) -> None:
        self._taken_ns: int | None = None
        self.latencies_ns: list[int] = []

    def percentiles_ms(self) -> tuple[float | None, float | None]:
        """The median and the 99th percentile [ms]."""
        if not self.latencies_ns:
            return None, None
        median_ns, p99_ns = np.percentile(self.latencies_ns, (50, 99))
        return float(median_ns) * 1e-6, float(p99_ns) * 1e-6

    def taken(self) -> None:
        """A frame was delivered."""
        self._taken_ns = time.perf_counter_ns()

    def sent(self) -> None:
        """A command is on the wire."""
        if self._taken_ns is not None:
            self.latencies_ns.append(time.perf_counter_ns() - self._taken_ns)
            self._taken_ns = None


class TimedSource:
    """A source that starts the stopwatch."""

    def __init__(self, source: Source, watch: Stopwatch) -> None:
        self._source, self._watch = source, watch

    def read(self, timeout_s: float) -> Frame | StereoFrame | None:
        """As the source's."""
        frame = self._source.read(timeout_s)
        if frame is not None:
            self._watch.taken()
        return frame

    def close(self) -> None:
        """As the source's."""
        self._source.close()


class TimedLink:
    """A link that stops the stopwatch."""

    def __init__(self, link: VehicleLink, watch: Stopwatch) -> None:
        self._link, self._watch = link, watch

    def open(self) -> None:
        """As the link's."""
        self._link.open()

    def poll(self, now_ns: int) -> VehicleState | None:
        """As the link's."""
        return self._link.poll(now_ns)

    def send(self, command: Command, now_ns: int) -> None:
        """As the link's."""
        self._link.send(command, now_ns)
        self._watch.sent()

    def arm(self, now_ns: int) -> None:
        """As the link's."""
        self._link.arm(now_ns)

    def disarm(self, now_ns: int) -> None:
        """As the link's."""
        self._link.disarm(now_ns)

    def close(self) -> None:
        """As the link's."""
        self._link.close()
