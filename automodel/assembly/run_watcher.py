"""Watches a run: progress, the simulator's truth, and the results."""

from __future__ import annotations

import csv
import math
import time
from array import array
from collections import deque
from collections.abc import Callable
from pathlib import Path

import numpy as np

from automodel.interfaces import Source, VehicleLink, wake_of
from automodel.output_files import output_text
from automodel.runtime.input_checks import UNCERTAIN
from automodel.runtime.latencies import Latencies
from automodel.runtime.run_types import RunEnd, RunResult, TickRecord
from automodel.runtime.safety import OVERLOADED, SafetyMode
from automodel.signals import FALSE_LANE, Command, Frame, LanePose, StereoFrame, VehicleState
from automodel.sim.world import Scene

TRUTH_COLUMNS = (
    "t_s", "frame", "offset_m", "heading_rad", "curvature_per_m", "width_m", "x_m", "y_m", "yaw_rad"
)  # fmt: skip
GIVE_UP_S = 5.0  # a simulated car that stands for so long has failed
_RECENT = 64  # scenes: the frame of an estimate is among the newest


class Watcher:
    """Implements `RunObserver`, and takes the scenes of the simulator, which a real car does not have.

    It adds up as the run goes, so that an hour needs no more memory than a minute; only with `keep_truth` is each scene
    kept, for `write_truth`. `patient`: a simulated car may stand for as long as it likes, because a person drives it.
    """

    def __init__(
        self, laps: int | None, advance: Callable[..., None], *, patient: bool = False, keep_truth: bool = False
    ) -> None:
        self._laps, self._advance, self._patient = laps, advance, patient
        self._start_ns: int | None = None  # of the first scene
        self._recent: deque[Scene] = deque(maxlen=_RECENT)
        self._truth: array[float] | None = array("d") if keep_truth else None
        self._driven = _Driven()
        self._estimated = _Estimated()
        self._has_driven = False
        self._stood_since_ns: int | None = None
        self._now_ns = 0
        self._reason: str | None = None
        self._lap_times_ns: list[int] = []

    def on_scene(self, scene: Scene) -> None:
        """The truth of a frame."""
        if self._start_ns is None:
            self._start_ns = scene.t_ns
        else:
            before = self._recent[-1]
            self._advance(max(scene.car.distance_m - before.car.distance_m, 0.0))
            if scene.truth.lap > before.truth.lap:
                self._lap_times_ns.append(scene.t_ns)
        self._recent.append(scene)
        if self._has_driven:
            self._driven.add(scene)
        if self._truth is not None:
            truth, car = scene.truth, scene.car
            self._truth.extend((scene.t_ns * 1e-9, scene.index, truth.offset_m, truth.heading_rad))
            self._truth.extend((truth.curvature_per_m, truth.width_m, car.x_m, car.y_m, car.yaw_rad))

    def on_tick(self, record: TickRecord) -> None:
        """A turn of the runner."""
        if record.tick is not None and record.tick.estimate.pose is not None:
            t_ns = record.tick.estimate.t_ns
            scene = next((scene for scene in reversed(self._recent) if scene.t_ns == t_ns), None)
            if scene is not None:
                self._estimated.add(record.tick.estimate.pose, scene)
        if not self._has_driven and record.decision.mode in (SafetyMode.DRIVING, SafetyMode.HOLD):
            self._has_driven = True
            self._lap_times_ns = [record.t_ns]
            if self._recent:
                self._driven.add(self._recent[-1])
        if self._recent and abs(self._recent[-1].car.speed_mps) >= 0.01:
            self._stood_since_ns = None
        elif self._stood_since_ns is None:
            self._stood_since_ns = record.t_ns
        self._now_ns, self._reason = record.t_ns, record.decision.reason

    def finished(self) -> bool:
        """Whether the laps are driven, or the simulated car has given up."""
        if not self._recent:
            return False
        if self._laps is not None and self._recent[-1].truth.lap >= self._laps:
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
        driven, laps = self._driven, np.diff(self._lap_times_ns) * 1e-9
        return {
            "laps": driven.laps,
            "lap_s": float(laps.mean()) if len(laps) else None,
            "max_abs_offset_m": driven.max_offset_m if driven.scenes else None,
            "mae_offset_m": driven.offsets_m / driven.scenes if driven.scenes else None,
            "left_lane": driven.departures,
            "stops": result.stops,
            "latency_p50_ms": latencies_ms[0],
            "latency_p99_ms": latencies_ms[1],
            **self._estimated.row(),
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
        if not self._recent:
            return f"{result.frames} frames, no stop"
        if not self._has_driven:
            return f"the car did not drive: {self._reason or 'it was not armed yet'}"
        last = self._recent[-1]
        laps = last.truth.lap
        driven = f"{laps} lap{'s' if laps > 1 else ''}" if laps > 0 else f"{last.car.distance_m:.1f} m"
        return f"drove {driven} and stayed in its lane"

    def _led_astray(self) -> list[str]:
        """The first estimate that misled, and how many did."""
        misled, first_ns = self._estimated.misled, self._estimated.misled_from_ns
        if first_ns is None:
            return []
        frames = f"{misled} frame{'s' if misled > 1 else ''}"
        return [f"its estimate misled it in {frames}, from t = {(first_ns - (self._start_ns or 0)) * 1e-9:.1f} s on"]

    def _left_lane(self) -> list[str]:
        """The first place where the body left the lane, and how often it did."""
        first, departures = self._driven.departure, self._driven.departures
        if first is None:
            return []
        often = f" (and {departures - 1} more times)" if departures > 1 else ""
        return [f"left its lane at t = {first.t_ns * 1e-9:.1f} s, s = {first.truth.s_m:.1f} m{often}"]

    def _stops(self, result: RunResult) -> list[str]:
        """The first stop that had to be cleared by a person, and how many there were."""
        stop = next((event for event in result.events if event.kind == "stop"), None)
        if result.stops == 0 or stop is None:
            return []
        often = f" (and {result.stops - 1} more times)" if result.stops > 1 else ""
        start_ns = result.events[0].t_ns if self._start_ns is None else self._start_ns
        return [f"stopped at t = {(stop.t_ns - start_ns) * 1e-9:.1f} s: {stop.text}{often}"]

    def write_truth(self, path: Path) -> None:
        """truth.csv: where the car really was, a row a frame; raises ConfigError where it cannot be written."""
        assert self._truth is not None
        rows = np.frombuffer(self._truth).reshape(-1, len(TRUTH_COLUMNS))
        with output_text(path) as file:
            table = csv.writer(file, lineterminator="\n")
            table.writerow(TRUTH_COLUMNS)
            for t_s, index, *numbers in rows.tolist():
                table.writerow([f"{t_s:.9f}", int(index), *(f"{number:.6f}" for number in numbers)])


class _Driven:
    """What came of the scenes since the car began to drive."""

    def __init__(self) -> None:
        self.scenes, self.laps, self.departures = 0, 0, 0
        self.offsets_m, self.max_offset_m = 0.0, 0.0
        self.departure: Scene | None = None  # the first in which the body had left the lane
        self._outside = False

    def add(self, scene: Scene) -> None:
        """One more."""
        offset_m, outside = abs(scene.truth.offset_m), scene.reach_m > 0.5 * scene.truth.width_m
        self.scenes += 1
        self.laps = max(self.laps, scene.truth.lap)
        self.offsets_m += offset_m
        self.max_offset_m = max(self.max_offset_m, offset_m)
        if outside and not self._outside:
            self.departures += 1
            self.departure = self.departure or scene
        self._outside = outside


class _Estimated:
    """How true the poses were that were told."""

    def __init__(self) -> None:
        self.poses, self.errors_m, self.exceeded = 0, 0.0, 0
        self.misled = 0  # off by more than `FALSE_LANE` of the lane's width while the bound is less
        self.misled_from_ns: int | None = None

    def add(self, pose: LanePose, scene: Scene) -> None:
        """One more, and the truth of its frame."""
        true = scene.truth
        offset_m = abs(pose.offset_m - true.offset_m)
        heading_rad = abs(math.remainder(pose.heading_rad - true.heading_rad, math.tau))
        self.poses += 1
        self.errors_m += offset_m
        self.exceeded += offset_m > pose.offset_bound_m or heading_rad > pose.heading_bound_rad
        if offset_m > FALSE_LANE * true.width_m and not pose.offset_bound_m >= offset_m:
            self.misled += 1
            self.misled_from_ns = scene.t_ns if self.misled_from_ns is None else self.misled_from_ns

    def row(self) -> dict[str, object]:
        """The mean error of the offset, shares that mislead or exceed a bound."""
        keys = ("estimate_mae_m", "misled_pct", "bound_exceeded_pct")
        if not self.poses:
            return dict.fromkeys(keys)
        figures = (self.errors_m, 100.0 * self.misled, 100.0 * self.exceeded)
        return {key: figure / self.poses for key, figure in zip(keys, figures, strict=True)}


def _holds(result: RunResult, word: str, reason: str) -> list[str]:
    """How often the car was held with `word` in the event's text, and for what `reason`, in words."""
    held = sum(event.kind == "hold" and word in event.text for event in result.events)
    return [f"held {held} time{'s' if held > 1 else ''} because {reason}"] if held else []


class Stopwatch:
    """The loop's own times from a frame's delivery to its command on the wire, by the machine's clock."""

    def __init__(self) -> None:
        self._taken_ns: int | None = None
        self.latencies = Latencies()

    def percentiles_ms(self) -> tuple[float | None, float | None]:
        """The median and the 99th percentile [ms]; None where nothing was sent."""
        return self.latencies.percentile_ms(50), self.latencies.percentile_ms(99)

    def taken(self) -> None:
        """A frame was delivered."""
        self._taken_ns = time.perf_counter_ns()

    def sent(self) -> None:
        """A command is on the wire."""
        if self._taken_ns is not None:
            self.latencies.add(time.perf_counter_ns() - self._taken_ns)
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

    @property
    def wake_ns(self) -> int | None:
        """As the link's."""
        return wake_of(self._link)

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
