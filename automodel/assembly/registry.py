"""Makes parts by name: ours, those of installed packages, and a team's own class."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable
from typing import Any

from automodel.config import ConfigError
from automodel.config.parts import PartKind


def find_part(kind: PartKind, name: str) -> Callable[..., Any]:
    """The class or function that makes the part `name`; raises ConfigError where there is none.

    Modules are looked for as Python does, and last in the current folder, so that a team's file beside its car.toml
    is found without being installed.
    """
    target = kind.target(name)
    if target is None:
        raise ConfigError(f"{kind.key} {name!r}: expected one of {', '.join(kind.names)}, or package.module:Class")
    module_name, _, attribute = target.partition(":")
    if name not in kind.targets and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise ConfigError(f"{kind.key} {name!r}: {module_name} cannot be imported: {error}") from None
    made = getattr(module, attribute, None)
    if not callable(made):
        raise ConfigError(f"{kind.key} {name!r}: there is no class {attribute} in {module_name}")
    factory: Callable[..., Any] = made
    return factory


def make_part(kind: PartKind, name: str, *arguments: object) -> Any:
    """The part `name`, made with `arguments`; raises ConfigError where it cannot be made or does not fit its kind.

    A part of automodel's own raises what it raises for a wrong value (ValueError) or a missing device (OSError); only
    a stranger's TypeError is turned into a ConfigError, because that is how a constructor that does not fit shows.
    """
    factory = find_part(kind, name)
    try:
        part = factory(*arguments)
    except ValueError as error:
        raise ConfigError(f"{kind.kind} {name}: {error}") from None
    except TypeError as error:
        if name in kind.targets:
            raise
        raise ConfigError(f"{kind.kind} {name}: cannot be made from the configuration: {error}") from None
    missing = [method for method in kind.methods if not callable(getattr(part, method, None))]
    if missing:
        needed = ", ".join(f"{method}()" for method in kind.methods)
        raise ConfigError(f"{kind.kind} {name}: has no {missing[0]}(); a {kind.kind} needs {needed}")
    return part
