"""What several commands put together: configuration, loop, cameras."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

import cv2

from automodel.config import CarConfig, ConfigError, load_car, parse_car
from automodel.config.toml_reader import read_text
from automodel.console.messages import say
from automodel.control.controller import LaneController
from automodel.control.limits import Limits
from automodel.interfaces import Pipeline, Source
from automodel.pipelines import make_pipeline
from automodel.recording.writer import McapRecorder
from automodel.runtime.loop import Checks, Loop


def car_of(path: Path | None, pipeline: str | None = None) -> CarConfig:
    """car.toml, or the defaults (the simulated car) without one; `pipeline` overrides the file's."""
    car = CarConfig() if path is None else load_car(path)
    if pipeline is None:
        return car
    try:
        return dataclasses.replace(car, pipeline=dataclasses.replace(car.pipeline, name=pipeline))
    except ValueError as error:
        raise ConfigError(f"--pipeline {error}") from None


def read_car(path: Path | None, pipeline: str | None, speed_mps: float | None) -> tuple[CarConfig, str]:
    """What is driven, and the text of car.toml that says so: a replay of the recording must find what was in force.

    `pipeline` and `speed_mps` override the file's.
    """
    text = "" if path is None else read_text(path)
    name = "car.toml" if path is None else str(path)
    car = parse_car(text, name)
    if speed_mps is not None and speed_mps > car.safety.speed_max_mps:
        raise ConfigError(f"--speed {speed_mps}: {name} allows {car.safety.speed_max_mps} ([safety] speed_max_mps)")
    for section, key, value in (("pipeline", "name", pipeline), ("control", "speed_mps", speed_mps)):
        if value is not None:
            text = _with_key(text, section, key, value)
    return parse_car(text, name), text


def _with_key(text: str, section: str, key: str, value: str | float) -> str:
    import tomlkit

    document = tomlkit.parse(text)
    if section not in document:
        document[section] = tomlkit.table()
    document[section][key] = value
    return tomlkit.dumps(document)


def make_recorder(path: Path, text: str, car: CarConfig) -> McapRecorder:
    """A recorder into a new file at `path`; `text` is the car.toml that the run has."""
    return McapRecorder(path, text, car.recording)


def make_loop(car: CarConfig, *, pipeline: Pipeline | None = None, checks: Checks | None = None) -> Loop:
    """Pipeline, controller and limits of a car; `pipeline` instead of the one that car.toml names.

    OpenCV is kept to one thread: handing so little over costs more. `checks` are for a car that drives.
    """
    cv2.setNumThreads(1)
    pipeline = make_pipeline(car.pipeline.name, car) if pipeline is None else pipeline
    notice = getattr(pipeline, "notice", "")
    if notice:  # of a network that runs on something else than expected
        say(notice)
    return Loop(
        pipeline,
        LaneController(car),
        Limits(car.safety, car.vehicle),
        validity_s=car.safety.command_validity_s,
        stopwatch=time.perf_counter_ns,
        checks=checks,
    )


def make_camera(car: CarConfig) -> Source:
    """The camera that car.toml names: "csi", "usb", or a path to replay from."""
    from automodel.assembly.recordings import open_source

    if car.camera.source == "csi":
        from automodel.sources.cameras import CsiSource

        return CsiSource(car.camera)
    if car.camera.source == "usb":
        from automodel.sources.cameras import UsbSource

        return UsbSource(car.camera)
    return open_source(Path(car.camera.source), car, car.camera.rate_hz)
