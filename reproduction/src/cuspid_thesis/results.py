"""Results, by name, and how a figure is found in one: a path is the names on the way to it, as ``radius.least_mm``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from string import Formatter
from typing import Any

from cuspid.runtime.errors import InputError
from cuspid.runtime.values import quote

Result = Mapping[str, Any]
Results = Mapping[str, Result]
"""By name."""
Figures = dict[str, float | bool | str]
"""What a check returns, units in the names."""

CHECKED = "thesis_checks"
"""Name of the results of what is computed in seconds."""
PANORAMA = "panorama/"
"""How the names of results of panoramas begin; then follow subject and method."""


def value_at(result: Result, path: str) -> Any:
    """What stands at a path. Raises KeyError, TypeError, ValueError or IndexError where nothing does."""
    found: Any = result
    for name in path.split("."):
        found = found[int(name)] if isinstance(found, list) else found[name]
    return found


def in_words(text: str, result: Result, found: Mapping[str, Any] = {}) -> str:
    """A text whose fields are names of what was found, or paths: ``{ours:.1f} of {gap.least_mm:.0f}``."""
    return _Paths().vformat(text, (), {"result": result, "found": found})


@contextmanager
def looking(where: str) -> Iterator[None]:
    """While figures are taken from results. Raises InputError where these are not as a run writes them."""
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, StopIteration, TypeError, ValueError) as error:
        raise InputError(f"results {where}: unexpected content ({quote(error)}); run it again") from error


class _Paths(Formatter):
    def get_field(self, field_name: str, args: Any, kwargs: Mapping[str, Any]) -> Any:
        found = kwargs["found"]
        return found[field_name] if field_name in found else value_at(kwargs["result"], field_name), field_name
