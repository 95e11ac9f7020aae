"""Which parameters of a test only the slow lane runs."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def rest_slow(values: Iterable[Any], *fast: object) -> list[Any]:
    """All `values` of one argument, for `parametrize`: those that are not among `fast` are marked slow."""
    values = list(values)
    assert all(value in values for value in fast), fast
    return [value if value in fast else pytest.param(value, marks=pytest.mark.slow) for value in values]
