"""Single keys of a configuration by their place, as "lane.width_m": what they are, and the car with another value."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from typing import Any

from automodel.config import CarConfig
from automodel.config.ranges import out_of_range
from automodel.config.toml_reader import ConfigError

_TRUTH = {"true": True, "false": False}  # as in TOML


def keys_of(section: object, before: str = "") -> Iterator[tuple[str, object]]:
    """The keys of a configuration or a section, with their places and values."""
    for field in dataclasses.fields(section):  # type: ignore[arg-type]
        value, place = getattr(section, field.name), before + field.name
        if dataclasses.is_dataclass(value):
            yield from keys_of(value, f"{place}.")
        else:
            yield place, value


def with_value(car: CarConfig, key: str, text: str) -> CarConfig:
    """The car with the value in `text` at `key`, a number, a word, true or false, checked as if it stood in car.toml.

    Raises ConfigError, in one line, for a value that cannot be; KeyError for a key that there is not.
    """
    place = tuple(key.split("."))
    sections: list[Any] = [car]
    for name in place[:-1]:
        sections.append(getattr(sections[-1], name, None))
    if not dataclasses.is_dataclass(sections[-1]) or dict(keys_of(car)).get(key) is None:
        raise KeyError(key)
    value = _value_of(place, getattr(sections[-1], place[-1]), text.strip())
    try:
        for section, name in zip(reversed(sections), reversed(place), strict=True):
            value = dataclasses.replace(section, **{name: value})
    except ValueError as error:
        raise ConfigError(str(error)) from None
    return value


def _value_of(place: tuple[str, ...], before: object, text: str) -> Any:
    """The value in `text`, of the kind of the one before; raises ConfigError."""
    key = ".".join(place)
    if isinstance(before, bool):
        if text not in _TRUTH:
            raise ConfigError(f"{key}: expected true or false")
        return _TRUTH[text]
    if isinstance(before, str):
        return text
    if not isinstance(before, int | float):
        raise ConfigError(f"{key}: is no single number or word; change it in car.toml")
    try:
        number = int(text) if isinstance(before, int) else float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ConfigError(f"{key}: expected a {'whole' if isinstance(before, int) else 'finite'} number")
    if expected := out_of_range(place, number):
        raise ConfigError(f"{key}: expected {expected}")
    return number
