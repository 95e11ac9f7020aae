"""The lane in metres from a camera, the car's pose in it, and a safe command.

    from automodel import LaneFinder
    finder = LaneFinder("car.toml")
    estimate = finder.see(image, t_s)  # estimate.pose.offset_m, .heading_rad; estimate.status

Everything named here is imported when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from automodel.assembly.lane_finder import LaneFinder
    from automodel.config import CarConfig, ConfigError, load_car
    from automodel.signals import (
        NEUTRAL,
        Command,
        Crossing,
        Frame,
        LaneEstimate,
        LaneLine,
        LanePose,
        LaneStatus,
        Motion,
        MotionSource,
        StereoFrame,
        VehicleState,
    )

__version__ = "0.1.0"
__all__ = [
    "NEUTRAL",
    "CarConfig",
    "Command",
    "ConfigError",
    "Crossing",
    "Frame",
    "LaneEstimate",
    "LaneFinder",
    "LaneLine",
    "LanePose",
    "LaneStatus",
    "Motion",
    "MotionSource",
    "StereoFrame",
    "VehicleState",
    "__version__",
    "load_car",
]
_MODULES = {
    "LaneFinder": "automodel.assembly.lane_finder",
    "CarConfig": "automodel.config",
    "ConfigError": "automodel.config",
    "load_car": "automodel.config",
}


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_MODULES.get(name, "automodel.signals")), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
