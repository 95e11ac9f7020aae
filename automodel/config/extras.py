"""The extras of the package: what only some cars and commands need, so that a small board installs nothing else."""

from __future__ import annotations

import importlib.util

from automodel.config.toml_reader import ConfigError

EXTRA_OF = {  # module that is imported -> the extra that installs it (pyproject.toml)
    "onnxruntime": "centerline",
    "can": "can",
    "cantools": "can",
    "crccheck": "can",
    "aiohttp": "web",
    "foxglove": "foxglove",
    "distributed": "cluster",
    "torch": "train",
    "onnx": "train",
}


def need_extra(what: str, *modules: str) -> None:
    """Raise ConfigError, and say what to install, where one of the modules that `what` needs is missing."""
    for module in modules:
        if importlib.util.find_spec(module) is None:
            raise ConfigError(missing_extra(what, module))


def missing_extra(what: str, module: str) -> str:
    """What to tell a user for whom `what` fails because `module`, one of `EXTRA_OF`, is not installed."""
    return f"{what} needs {module}, which is not installed: pip install 'automodel[{EXTRA_OF[module]}]'"
