"""One pose of every pipeline, to compare two machines: `python -m tests.support.one_pose draw | run | compare`."""

from __future__ import annotations

import dataclasses
import json
import platform
import sys
from pathlib import Path
from typing import Any

import numpy as np

from automodel.assembly.parts import make_pipeline
from automodel.assembly.simulated_car import Simulation, build_world
from automodel.config import CarConfig
from automodel.config.camera import SecondCamera
from automodel.config.parts import PAIR_PIPELINES, PIPELINES
from automodel.interfaces import Pipeline
from automodel.signals import Frame, Motion, MotionSource, StereoFrame

FRAMES = 3  # some pipelines see the lane from the second frame on
PERIOD_NS = 16_666_667
MOST_APART = 1e-6  # [m] and [rad]: rounding, no more


def car_of(pipeline: str) -> CarConfig:
    """The simulated car with one camera, or with two that stand 0.25 m apart."""
    car = CarConfig()
    car = dataclasses.replace(car, pipeline=dataclasses.replace(car.pipeline, name=pipeline))
    if pipeline not in PAIR_PIPELINES:
        return car
    left = dataclasses.replace(car.camera.extrinsics, y_m=0.125)
    right = SecondCamera(extrinsics=dataclasses.replace(car.camera.extrinsics, y_m=-0.125))
    return dataclasses.replace(car, camera=dataclasses.replace(car.camera, extrinsics=left, right=right))


def draw(path: Path) -> None:
    """What a simulated car sees of the oval, for one camera and for two."""
    images: dict[str, Any] = {}
    for pipeline in PIPELINES.names:
        world = build_world(car_of(pipeline), Simulation(track="oval", style="competition"))
        images[pipeline] = np.stack([world.capture(0, index)[0] for index in range(FRAMES)])
    np.savez(path, **images)


def poses(path: Path) -> dict[str, Any]:
    """Status and pose of each pipeline after the last frame."""
    found = {}
    with np.load(path) as images:
        for name in PIPELINES.names:
            found[name] = _pose(make_pipeline(name, car_of(name)), images[name])
    return found


def _pose(pipeline: Pipeline, images: Any) -> dict[str, object]:
    for index, image in enumerate(images):
        t_ns = PERIOD_NS * (index + 1)
        frame: Any = Frame(t_ns=t_ns, index=index, image=image) if image.ndim == 2 else None
        if frame is None:
            frame = StereoFrame(t_ns=t_ns, index=index, left=image[0], right=image[1])
        still = Motion(t_ns=t_ns, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)
        estimate = pipeline.step(frame, still)
    if estimate.pose is None:
        return {"status": estimate.status.value}
    offset_m, heading_rad = float(estimate.pose.offset_m), float(estimate.pose.heading_rad)
    return {"status": estimate.status.value, "offset_m": offset_m, "heading_rad": heading_rad}


def compare(here: dict[str, Any], there: dict[str, Any]) -> list[str]:
    """What differs by more than rounding; prints how far each pipeline is apart."""
    wrong = []
    for name, ours in here["poses"].items():
        theirs = there["poses"][name]
        keys = [key for key in ("offset_m", "heading_rad") if key in ours and key in theirs]
        apart = max((abs(ours[key] - theirs[key]) for key in keys), default=float("inf"))
        sys.stdout.write(f"{name}: {ours['status']}, {here['machine']} and {there['machine']} {apart:.1e} apart\n")
        if ours["status"] != theirs["status"] or not apart <= MOST_APART:
            wrong.append(name)
    return wrong


def main(words: list[str]) -> int:
    """0 where all is well, 1 where two machines differ."""
    if words[0] == "draw":
        draw(Path(words[1]))
    elif words[0] == "run":
        json.dump({"machine": platform.machine(), "poses": poses(Path(words[1]))}, sys.stdout)
    else:
        here, there = (json.loads(Path(word).read_text()) for word in words[1:3])
        return 1 if compare(here, there) else 0
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
