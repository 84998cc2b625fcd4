"""Options: every number is declared with its range, which is checked when the options are created.

.. code-block:: python

    @dataclass(frozen=True, kw_only=True)
    class StereoOptions(Options):
        spacing_px: Annotated[int, Range(1, 100)] = 3
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from cuspid.runtime.errors import InputError
from cuspid.runtime.values import number, quote


@dataclass(frozen=True)
class Range:
    """The numbers that an option may take, bounds included; for a sequence of numbers, each of them."""

    low: int | float
    high: int | float


SEED = Range(0, 2**31 - 1)
"""Seed of random draws."""
SHARE = Range(0, 1)
TOOTH = Range(11, 48)
"""FDI number; whether the jaw has the tooth is checked later."""
WORKERS = Range(1, 1024)
"""Processes that share the work."""
Choices = tuple[object, ...]
"""The values that a ``Literal`` allows."""


class Options:
    """Base class of all options: dataclasses whose numbers must lie in the :class:`Range` that they are annotated with,
    and whose ``Literal`` fields must have one of the declared values.

    Construction raises InputError for the first value that does not. A class with checks of its own calls this one's
    first.
    """

    def __post_init__(self) -> None:
        check(_title(type(self)), type(self), vars(self))


def check(what: str, declared: Callable[..., object], values: Mapping[str, object]) -> None:
    """Raise InputError for the first of the values that does not fit the declaration of a class or a function."""
    for name, allowed in limits(declared).items():
        if name in values:
            _check(f"{what}: --{name.replace('_', '-')}", values[name], allowed)


@cache
def limits(declared: Callable[..., object]) -> Mapping[str, Range | Choices]:
    """The range or the choices that a class or a function declares for each of its fields or arguments, by name."""
    hints = get_type_hints(declared, include_extras=True)
    found = {name: next(_limits_in(hint), None) for name, hint in hints.items()}
    return MappingProxyType({name: allowed for name, allowed in found.items() if allowed is not None})


def _limits_in(hint: Any) -> Iterator[Range | Choices]:
    if get_origin(hint) is Literal:
        yield get_args(hint)
        return
    if get_origin(hint) is Annotated:
        yield from (each for each in hint.__metadata__ if isinstance(each, Range))
    for part in get_args(hint):
        yield from _limits_in(part)


def _check(what: str, value: object, allowed: Range | Choices) -> None:
    """A number or one of several, a choice; None is nothing to check."""
    if isinstance(value, Mapping):
        value = tuple(value.values())
    if isinstance(value, tuple | list):
        for each in value:
            _check(what, each, allowed)
    elif value is None:
        return
    elif isinstance(allowed, Range):
        number(what, value, float(allowed.low), float(allowed.high))
    elif value not in allowed:
        raise InputError(f"{what} is {quote(value)}; choose {', '.join(map(str, allowed))}")


def _title(options: type) -> str:
    """``scan path`` of ``ScanPathOptions``."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", options.__name__.removesuffix("Options")).lower()
