"""The papers' pipelines, side by side, and the table that names them."""

from __future__ import annotations

from importlib import import_module

from automodel.config import PIPELINES, CarConfig, ConfigError
from automodel.interfaces import Pipeline

_CLASSES = {name: name.capitalize() for name in PIPELINES}  # each in a module of its pipeline's name


def make_pipeline(name: str, car: CarConfig) -> Pipeline:
    """The pipeline `name` for a car; raises ConfigError for an unknown name or a camera that it cannot work with.

    What one pipeline needs (a network's runtime, a compiler) is loaded for that one alone.
    """
    if name not in _CLASSES:
        raise ConfigError(f"pipeline {name!r}: none of {', '.join(PIPELINES)}")
    made = getattr(import_module(f"automodel.pipelines.{name}"), _CLASSES[name])
    try:
        pipeline: Pipeline = made(car)
    except ValueError as error:
        raise ConfigError(f"pipeline {name}: {error}") from None
    return pipeline
