"""Times a pipeline's stages for `bench speed`."""

from __future__ import annotations

import time
from typing import Any

import cv2
import numpy as np

from automodel.assembly.parts import make_pipeline
from automodel.assembly.simulated_car import appearance, renderer
from automodel.config import CarConfig
from automodel.signals import Frame
from automodel.sim.track_files import load_track
from automodel.sim.trajectory import Drive, Odometer

WARM_UP = 30  # frames that are not counted


def measure_speed(car: CarConfig, name: str, frames: int, threads: int) -> list[dict[str, object]]:
    """Rows of median and 99th percentile [ms]: the whole step, and each of the pipeline's stages."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(threads)
    try:
        durations = _durations(car, name, frames)
    finally:
        cv2.setNumThreads(before)
    size = {"width_px": car.camera.width_px, "height_px": car.camera.height_px}
    return [
        {
            "pipeline": name,
            "stage": stage,
            **size,
            "p50_ms": float(np.median(values)) * 1e-6,
            "p99_ms": float(np.quantile(values, 0.99)) * 1e-6,
            "threads": threads,
        }
        for stage, values in durations.items()
    ]


def _durations(car: CarConfig, name: str, frames: int) -> dict[str, list[int]]:
    track = load_track("tmr")
    way = Drive(lane=track.lane(), style="centred", speed_mps=1.0, car_width_m=car.vehicle.width_m)
    camera, odometer = renderer(track, car, appearance("competition", 0)), Odometer(0)
    pipeline: Any = make_pipeline(name, car)
    pipeline.stages.stopwatch = time.perf_counter_ns
    durations: dict[str, list[int]] = {"total": []}
    for index in range(frames + WARM_UP):
        t_s = index / car.camera.rate_hz
        pose = way.pose(t_s)
        image = camera.render(pose.x_m, pose.y_m, pose.yaw_rad, pose.speed_mps, pose.yaw_rate_radps, index)
        frame = Frame(t_ns=round(t_s * 1e9), index=index, image=image)
        motion = odometer.motion(pose, frame.t_ns)
        begin = time.perf_counter_ns()
        pipeline.step(frame, motion)
        total = time.perf_counter_ns() - begin
        if index >= WARM_UP:
            durations["total"].append(total)
            for stage, duration in pipeline.stages.durations_ns.items():
                durations.setdefault(stage, []).append(duration)
    return durations
