"""Functions compiled to machine code: the loops of `contour`, where what numpy asks per call would be most of the time.

They are compiled when they are first called, for some seconds, and kept on disk for the next run where that has a
place. With NUMBA_DISABLE_JIT=1 they run as plain Python, for a debugger or a coverage report.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

from numba import njit

F = TypeVar("F", bound=Callable[..., object])


def compiled(function: F) -> F:
    """The function, to be compiled: scalars, tuples and arrays of numbers go in and come out."""
    try:
        made = njit(cache=True, error_model="numpy")(function)
    except RuntimeError:  # neither beside the file nor in the user's cache may anything be written
        made = njit(error_model="numpy")(function)
    return cast(F, made)
