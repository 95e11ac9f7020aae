"""Functions compiled to machine code by numba: loops of the pipelines and of the tracking, too small for numpy's calls.

They are compiled when they are first called and kept for the next run in the user's cache folder: $NUMBA_CACHE_DIR
where set, otherwise `automodel/` in $XDG_CACHE_HOME or ~/.cache. What is kept there goes by the source, not by the
place of the source: another environment with the same one finds it. Where nothing can be written there, they are
compiled in each run. With NUMBA_DISABLE_JIT=1 they run as plain Python, for a debugger or a coverage report.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import logging
import os
import re
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar, cast

from numba import config as numba_config
from numba import njit
from numba.core import caching as numba_caching
from numba.core import event as numba_event

F = TypeVar("F", bound=Callable[..., object])
_PACKAGE = Path(__file__).parent
_IMPORT = re.compile(rb"^(?:from|import) automodel([\w.]*)(?: import (\([^)]*\)|[^#\n]*))?", re.MULTILINE)
_anew = False
config: Any = numba_config  # its names are made at run time
caching: Any = numba_caching


def compiled(function: F) -> F:
    """The function, compiled at its first call; arguments and results are numbers, tuples and arrays of numbers."""
    _announce()
    if _anew or _cache_folder() is None or not Path(function.__code__.co_filename).is_file():
        return cast(F, njit(error_model="numpy")(function))
    places = caching.CacheImpl._locator_classes  # asked when it decorates
    before = list(places)
    places[:] = [_Kept]
    try:
        return cast(F, njit(cache=True, error_model="numpy")(function))
    except OSError:  # its folder cannot be made
        return cast(F, njit(error_model="numpy")(function))
    finally:
        places[:] = before


class _Kept(caching._CacheLocator):  # type: ignore[misc]
    """Where numba keeps a function's machine code: a folder for each state of its module and of what that imports.

    numba itself knows a function by the place of its file, and does not see that a function or a number of another
    module has changed.
    """

    def __init__(self, function: Any, file: str) -> None:
        self._py_file = file  # numba names it in warnings
        self._line = function.__code__.co_firstlineno
        self._folder = cast(Path, _cache_folder()) / f"{Path(file).stem}-{_version(Path(file))}"

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> _Kept:
        """As numba calls it."""
        kept = cls(py_func, py_file)
        kept.ensure_cache_path()
        return kept

    def get_cache_path(self) -> str:
        """The folder."""
        return str(self._folder)

    def get_source_stamp(self) -> str:
        """Nothing: the folder's name says it."""
        return ""

    def get_disambiguator(self) -> str:
        """The function's line."""
        return str(self._line)


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
        folder = Path(config.CACHE_DIR or cache / "automodel")
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except (OSError, RuntimeError):  # RuntimeError: there is no home
        return None
    return folder


@functools.cache
def _version(file: Path) -> str:
    """A hash of a module and of all modules of the package that it imports, directly or through others."""
    found = {file}
    while more := {one for each in found for one in _module(each)[1]} - found:
        found |= more
    return hashlib.sha256("".join(sorted(_module(each)[0] for each in found)).encode()).hexdigest()[:16]


@functools.cache
def _module(file: Path) -> tuple[str, frozenset[Path]]:
    """A hash of a module, and the files of the package that it imports itself."""
    source = file.read_bytes()
    names: set[str] = set()
    for module, imported in _IMPORT.findall(source):
        names |= {module.decode(), *(f"{module.decode()}.{name}" for name in re.findall(r"\w+", imported.decode()))}
    found = [_PACKAGE.joinpath(*name.split(".")) for name in names]
    files = [one for each in found for one in (each.with_suffix(".py"), each / "__init__.py")]
    return hashlib.sha256(source).hexdigest(), frozenset(one for one in files if one.is_file())


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
