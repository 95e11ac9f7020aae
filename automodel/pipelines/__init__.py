"""The papers' pipelines, side by side, and the table that names them."""

from __future__ import annotations

from collections.abc import Callable

from automodel.config import PIPELINES, CarConfig, ConfigError
from automodel.interfaces import Pipeline
from automodel.pipelines.centerline import Centerline
from automodel.pipelines.contour import Contour
from automodel.pipelines.windows import Windows

MAKERS: dict[str, Callable[[CarConfig], Pipeline]] = {"centerline": Centerline, "contour": Contour, "windows": Windows}


def make_pipeline(name: str, car: CarConfig) -> Pipeline:
    """The pipeline `name` for a car; raises ConfigError for an unknown name or a camera that it cannot work with."""
    if name not in MAKERS:
        raise ConfigError(f"pipeline {name!r}: none of {', '.join(PIPELINES)}")
    try:
        return MAKERS[name](car)
    except ValueError as error:
        raise ConfigError(f"pipeline {name}: {error}") from None
