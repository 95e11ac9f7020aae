"""Functions compiled to machine code by numba: loops of the pipelines and of the tracking, too small for numpy's calls.

They are compiled when they are first called and kept for the next run in the user's cache folder: $NUMBA_CACHE_DIR
where set, otherwise `automodel/` in $XDG_CACHE_HOME or ~/.cache. Where nothing can be written there, they are compiled
in each run. With NUMBA_DISABLE_JIT=1 they run as plain Python, for a debugger or a coverage report.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import logging
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar, cast

from numba import config as numba_config
from numba import njit
from numba.core import event as numba_event

F = TypeVar("F", bound=Callable[..., object])
_PACKAGE = Path(__file__).parent
_anew = False
config: Any = numba_config  # its names are made at run time


def compiled(function: F) -> F:
    """The function, compiled at its first call; arguments and results are numbers, tuples and arrays of numbers."""
    _announce()
    folder = None if _anew else _cache_folder()
    if folder is None:
        return cast(F, njit(error_model="numpy")(function))
    before, config.CACHE_DIR = config.CACHE_DIR, str(folder)  # numba looks there when it decorates
    try:
        return cast(F, njit(cache=True, error_model="numpy")(function))
    except RuntimeError:  # the function has no file
        return cast(F, njit(error_model="numpy")(function))
    finally:
        config.CACHE_DIR = before


@contextlib.contextmanager
def compiled_anew() -> Iterator[None]:
    """Within it, functions are neither read from disk nor kept there: what is kept does not know their constants."""
    global _anew
    before, _anew = _anew, True
    try:
        yield
    finally:
        _anew = before


@functools.cache
def _cache_folder() -> Path | None:
    """Where machine code is kept, None where that cannot be written to."""
    try:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        folder = Path(config.CACHE_DIR or cache / "automodel" / _version())
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except (OSError, RuntimeError):  # RuntimeError: there is no home
        return None
    return folder


def _version() -> str:
    """A hash of all compiled modules: numba does not see that a function of another module has changed."""
    sources = (path.read_bytes() for path in sorted(_PACKAGE.rglob("*.py")))
    code = b"".join(source for source in sources if b"@compiled" in source)
    return hashlib.sha256(code).hexdigest()[:16]


class _Announcement(numba_event.Listener):
    """Logs one line before the first of our functions is compiled."""

    done = False

    def on_start(self, event: Any) -> None:
        """Called before any function is compiled that was not found on disk."""
        if not self.done and str(event.data["dispatcher"].__module__).startswith("automodel."):
            self.done = True
            logging.getLogger("automodel").info("compiling (once, takes one or two minutes, on a small board several)")

    def on_end(self, event: Any) -> None:
        """Nothing."""


@functools.cache
def _announce() -> None:
    register: Any = numba_event.register
    register("numba:compile", _Announcement())
