"""`bench speed`: how long a pipeline's step and its stages take."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Sequence
from typing import Any

import cv2
import numpy as np

from automodel.assembly.parts import make_pipeline
from automodel.bench.accuracy import Case, Row, watch
from automodel.config import PIPELINE_NAMES, CarConfig
from automodel.console.progress import progress
from automodel.pipelines.stages import StageClock
from automodel.signals import Frame, LaneEstimate, Motion

WARM_UP = 30  # frames that are not counted
COLUMNS = ("pipeline", "stage", "p50_ms", "p99_ms", "threads", "width_px", "height_px")


class TimedStep:
    """A pipeline's step with a stopwatch: `durations_ns` has the whole step ("total") and its stages, frame by frame.

    The first `WARM_UP` frames are left out.
    """

    def __init__(self, pipeline: Any) -> None:
        self._pipeline = pipeline
        self._stages: StageClock = getattr(pipeline, "stages", StageClock())  # a team's own need not have any
        self._stages.stopwatch = time.perf_counter_ns
        self.durations_ns: list[dict[str, int]] = []

    def __call__(self, frame: Frame, motion: Motion) -> LaneEstimate:
        """One step."""
        start_ns = time.perf_counter_ns()
        estimate: LaneEstimate = self._pipeline.step(frame, motion)
        total_ns = time.perf_counter_ns() - start_ns
        if frame.index >= WARM_UP:
            self.durations_ns.append({"total": total_ns, **self._stages.durations_ns})
        return estimate


@contextlib.contextmanager
def opencv_threads(count: int) -> Iterator[None]:
    """OpenCV uses so many threads inside."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(count)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def measure(car: CarConfig, pipelines: Sequence[str], frames: int, threads: int) -> list[Row]:
    """Rows of median and 99th percentile [ms] of each pipeline (default: all): the whole step, and each stage."""
    names = pipelines or PIPELINE_NAMES
    rows: list[Row] = []
    with progress("bench speed", len(names), threaded=False) as bar, opencv_threads(threads):
        for name in names:
            step = TimedStep(make_pipeline(name, car))
            case = Case(pipeline=name, track="tmr", style="centred", seed=0)
            for _ in watch(car, case, step, bar, frames + WARM_UP):
                pass
            rows += _rows(name, step, car, threads)
    return rows


def _rows(name: str, step: TimedStep, car: CarConfig, threads: int) -> list[Row]:
    stages = dict.fromkeys(stage for frame in step.durations_ns for stage in frame)
    durations_ns = {stage: [frame[stage] for frame in step.durations_ns if stage in frame] for stage in stages}
    return [
        {
            "pipeline": name,
            "stage": stage,
            "width_px": car.camera.width_px,
            "height_px": car.camera.height_px,
            "p50_ms": float(np.median(values)) * 1e-6,
            "p99_ms": float(np.quantile(values, 0.99)) * 1e-6,
            "threads": threads,
        }
        for stage, values in durations_ns.items()
    ]
