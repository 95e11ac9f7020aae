"""What only some cars and commands need and a small board may leave out; it is imported where it is used."""

from __future__ import annotations

import importlib.util

from automodel.config.toml_reader import ConfigError

INSTALLED_BY = {  # module that is imported -> what pip installs it by
    "onnxruntime": "onnxruntime",
    "can": "python-can",
    "cantools": "cantools",
    "crccheck": "crccheck",
    "aiohttp": "automodel[web]",
    "foxglove": "automodel[foxglove]",
    "evdev": "automodel[manual]",
    "distributed": "automodel[cluster]",
    "torch": "automodel[train]",
    "onnx": "automodel[train]",
    "openvino": "automodel[openvino]",
}


def need_extra(what: str, *modules: str) -> None:
    """Raise ConfigError, and say what to install, where one of the modules that `what` needs is missing."""
    for module in modules:
        if importlib.util.find_spec(module) is None:
            raise ConfigError(missing_extra(what, module))


def missing_extra(what: str, module: str) -> str:
    """What to tell a user for whom `what` fails because `module`, one of `INSTALLED_BY`, is not installed."""
    return f"{what} needs {module}, which is not installed: pip install '{INSTALLED_BY[module]}'"
