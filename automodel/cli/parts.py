"""What several commands put together: configuration, loop, cameras."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

from automodel.config import CarConfig, ConfigError, load_car, read_text
from automodel.control.controller import LaneController
from automodel.control.limits import Limits
from automodel.interfaces import Source
from automodel.loop import Loop
from automodel.pipelines import make_pipeline


def car_of(path: Path | None, pipeline: str | None = None) -> CarConfig:
    """car.toml, or the defaults (the simulated car) without one; `pipeline` overrides the file's."""
    car = CarConfig() if path is None else load_car(path)
    if pipeline is None:
        return car
    try:
        return dataclasses.replace(car, pipeline=dataclasses.replace(car.pipeline, name=pipeline))
    except ValueError as error:
        raise ConfigError(f"--pipeline {error}") from None


def car_text(path: Path | None) -> str:
    """The text of car.toml for a recording; empty where the defaults are driven."""
    return "" if path is None else read_text(path)


def make_loop(car: CarConfig) -> Loop:
    """Pipeline, controller and limits of a car."""
    return Loop(
        make_pipeline(car.pipeline.name, car),
        LaneController(car),
        Limits(car.safety, car.vehicle),
        validity_s=car.safety.command_validity_s,
        stopwatch=time.perf_counter_ns,
    )


def make_camera(car: CarConfig) -> Source:
    """The camera that car.toml names: "csi", "usb", or a path to replay from."""
    from automodel.cli.recordings import open_source

    if car.camera.source == "csi":
        from automodel.sources.csi import CsiSource

        return CsiSource(car.camera)
    if car.camera.source == "usb":
        from automodel.sources.usb import UsbSource

        return UsbSource(car.camera)
    return open_source(Path(car.camera.source), car, car.camera.rate_hz)
