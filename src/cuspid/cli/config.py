"""The options of a verb from a TOML file (``--config``), and as one (``--write-config``).

.. code-block:: toml

    quality = "fine"
    stereo.spacing-px = 2        # or spacing_px, or below [stereo]
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import is_dataclass, make_dataclass
from difflib import get_close_matches
from inspect import signature
from io import StringIO
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_args, get_origin, get_type_hints

import tyro
from tyro.conf import OmitArgPrefixes, Positional

from cuspid.runtime.errors import InputError
from cuspid.runtime.inputs import read_text
from cuspid.runtime.values import one_line, quote
from cuspid.storage.files import write_bytes

READ, WRITE = "--config", "--write-config"


class Option(NamedTuple):
    """An option of a verb."""

    hint: Any
    """Its type, without its marks."""
    path: tuple[str, ...]
    """The argument of the function and the fields that lead to it."""


def options_of(command: Callable[..., object]) -> dict[str, Option]:
    """The options of a verb by their names on the command line, without dashes: ``stereo.spacing-px``."""
    hints = get_type_hints(command, include_extras=True)
    return {
        name: option
        for argument in signature(command).parameters
        for name, option in _options(argument, hints[argument], (), "", False)
    }


def _options(name: str, hint: Any, path: tuple[str, ...], prefix: str, omitted: bool) -> Iterator[tuple[str, Option]]:
    bare, marks = (hint.__origin__, hint.__metadata__) if get_origin(hint) is Annotated else (hint, ())
    typed = next((its for mark in marks if (its := getattr(mark, "name", None)) is not None), name.replace("_", "-"))
    here = (*path, name)
    if Positional in marks or any(is_dataclass(getattr(each, "__origin__", each)) for each in get_args(bare)):
        return  # what is typed without a name, or chooses a kind by its name
    if not is_dataclass(bare):
        yield prefix + typed, Option(bare, here)
        return
    omitted = omitted or OmitArgPrefixes in marks
    below = prefix if omitted or not typed else f"{prefix}{typed}."
    for field, its in get_type_hints(bare, include_extras=True).items():
        yield from _options(field, its, here, below, omitted)


def read_config(verb: str, command: Callable[..., object], given: Sequence[str]) -> list[str]:
    """Arguments with the contents of a file in the place of ``--config FILE``; what comes later wins.

    Raises InputError for a file that is not TOML, or has an option that the verb lacks, or a value that it cannot take.
    """
    arguments = list(given)
    while (at := next((k for k, each in enumerate(arguments) if each.split("=")[0] == READ), None)) is not None:
        file, after = _value(arguments, at)
        arguments[at:after] = _arguments(verb, options_of(command), Path(file))
    return arguments


def take_target(given: Sequence[str]) -> tuple[Path | None, list[str]]:
    """The file of ``--write-config FILE``, and the other arguments."""
    at = next((k for k, each in enumerate(given) if each.split("=")[0] == WRITE), None)
    if at is None:
        return None, list(given)
    file, after = _value(given, at)
    return Path(file), [*given[:at], *given[after:]]


def _value(arguments: Sequence[str], at: int) -> tuple[str, int]:
    """The file of the option at a place, and the place after it."""
    name, equals, file = arguments[at].partition("=")
    if equals:
        return file, at + 1
    if at + 1 == len(arguments):
        raise InputError(f"{name}: name a file, such as {name} settings.toml")
    return arguments[at + 1], at + 2


def _arguments(verb: str, options: Mapping[str, Option], file: Path) -> list[str]:
    try:
        table = tomllib.loads(read_text(file))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{file}: not valid TOML ({one_line(error)})") from error
    arguments: list[str] = []
    for name, value in _leaves(table):
        if name not in options:
            near = get_close_matches(name, options, n=1)
            meant = f"; did you mean {near[0]}?" if near else f"; cuspid {verb} --help-all lists its options"
            raise InputError(f"{file}: {verb} has no option {one_line(name)}{meant}")
        if not _is_taken(value, options[name].hint):
            raise InputError(
                f"{file}: {name} is {quote(value)}, which is not allowed; cuspid {verb} --help-all lists its options"
            )
        arguments += _as_arguments(name, value, options[name].hint)
    return arguments


def _is_taken(value: Any, hint: Any) -> bool:
    """Whether the command line makes a value of this type of it."""
    if hint is bool:
        return isinstance(value, bool)
    alone, silence = make_dataclass("alone", [("value", hint)]), StringIO()
    try:
        with redirect_stdout(silence), redirect_stderr(silence):
            tyro.cli(alone, args=_as_arguments("value", value, hint))
    except SystemExit:
        return False
    return True


def _leaves(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        name = prefix + key.replace("_", "-")
        if isinstance(value, dict):
            yield from _leaves(value, f"{name}.")
        else:
            yield name, value


def _as_arguments(name: str, value: Any, hint: Any) -> list[str]:
    if hint is bool and isinstance(value, bool):
        before, _, last = name.rpartition(".")
        return [f"--{name}" if value else f"--{before}{'.' if before else ''}no-{last}"]
    if isinstance(value, list) and any(isinstance(each, list) for each in value):
        return [word for each in value for word in _as_arguments(name, each, hint)]
    return [f"--{name}", *map(str, value if isinstance(value, list) else [value])]


def write_config(file: Path, verb: str, command: Callable[..., object], values: Mapping[str, object]) -> None:
    """Every option of a call of a verb as TOML; those without a value are left out. ``values`` are the arguments by
    name. Raises OutputError where it cannot be written."""
    lines = [f"# cuspid {verb} --config {file.name}"]
    for name, option in options_of(command).items():
        value: Any = values.get(option.path[0])
        for field in option.path[1:]:
            value = getattr(value, field)
        if (text := _toml(value)) is not None:
            lines.append(f"{name} = {text}")
    write_bytes(file, ("\n".join(lines) + "\n").encode())


def _toml(value: object) -> str | None:
    """A value; None for what TOML has no word for."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str | Path):
        return json.dumps(str(value))
    if isinstance(value, tuple | list):
        parts = [_toml(each) for each in value]
        return None if None in parts else f"[{', '.join(part for part in parts if part is not None)}]"
    return None
