"""What ``--help`` shows of a verb: the options that most people need; ``--help-all`` shows every one.

Options of parts of the pipeline (those with a dot in their names) and those that few people ever change are left out of
the first. Both call things by their kinds: tyro prints what a default of None would be, which the help says in words.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import is_dataclass, replace
from functools import wraps
from inspect import Parameter, signature
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.conf import OmitArgPrefixes, Suppress, arg
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructTypeInfo

RARE = re.compile(
    "manufacturing_.*|jitter_.*|led_.*|gamma.*|step_.*|label_map|labels|jaw_seed|supersampling|renderer"
    "|aperture_mm|smear_mm|readout|scattering|saliva|crosstalk|bayer|jpeg_quality"
    "|clearance_mm|min_overlap|turn_deg|cross_sweep|own_images|left_share"
    "|max_distance_mm|pair_samples|retry_failed|new_texture|cluster"
    "|side_.*|outer_.*|ring_mm|seat_.*|wall_mm|web_mm|shoulder_mm|duct_mm|arm_.*|neck_.*|grip_.*|handle_.*"
    "|views|views_of_.*|min_tilt_deg|distance_ratio|shared_instants|move_share|settle_s|pixels|port|host|inverted"
    "|terraces|clear_px|outlier_sigmas|rounds|border_bits|circle_share|marker_share|spacing_share|legacy|patches"
)
"""Names of options, as Python has them, that ``--help`` leaves out."""
_SHORT = """{summary}

{prog} --help-all shows all options.
--config FILE.toml takes them from a file; --write-config FILE.toml writes them to one and exits."""
_KINDS = {int: "INT", float: "FLOAT", str: "TEXT", Path: "PATH", bool: "{True,False}"}


def show_help(prog: str, command: Callable[..., None], given: Sequence[str] = (), *, every: bool) -> None:
    """Print the help of a verb, or of the kind that the arguments name, and exit."""
    summary = re.split(r"\n\s*Args:", command.__doc__ or "")[0].strip()
    about = None if every else _SHORT.format(summary=summary, prog=prog)
    words = [word for word in given if not word.startswith("-")]
    shown, registry = describe_command(command, every=every)
    tyro.cli(shown, prog=prog, description=about, args=[*words, "--help"], registry=registry)


def describe_command(
    command: Callable[..., None], *, every: bool = True
) -> tuple[Callable[..., None], ConstructorRegistry]:
    """A verb as tyro should describe it, with the registry that it needs."""
    near = frozenset(_flat_option_classes(command))

    def describe(name: str, hint: Any, default: object) -> Any:
        if default in (tyro.MISSING, Parameter.empty):
            return hint
        if not every and (RARE.fullmatch(name) or (is_dataclass(bare := _bare(hint)) and bare not in near)):
            return Annotated[hint, Suppress]
        return hint if default is not None else _with_kind(hint)

    registry, busy = ConstructorRegistry(), set[int]()

    @registry.struct_rule
    def describe_fields(info: StructTypeInfo) -> StructConstructorSpec | None:
        if id(info) in busy:
            return None  # the rules of tyro itself come next
        busy.add(id(info))
        found = ConstructorRegistry.get_struct_spec(info)
        busy.discard(id(info))
        if not isinstance(found, StructConstructorSpec):
            return None
        fields = (replace(each, type=describe(each.name, each.type, each.default)) for each in found.fields)
        return replace(found, fields=tuple(fields))

    @wraps(command)
    def run(*given: object, **options: object) -> None:
        command(*given, **options)

    taken, hints = signature(command), get_type_hints(command, include_extras=True)
    parameters = [
        each.replace(annotation=describe(each.name, hints[each.name], each.default))
        for each in taken.parameters.values()
    ]
    del run.__wrapped__  # which tyro would look at instead
    run.__signature__ = taken.replace(parameters=parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {each.name: each.annotation for each in parameters}
    return run, registry


def _flat_option_classes(command: Callable[..., None]) -> Iterator[Any]:
    """Classes of options whose fields have no dot in their names."""
    waiting = [(hint, ()) for hint in get_type_hints(command, include_extras=True).values()]
    while waiting:
        hint, around = waiting.pop()
        marks = (*getattr(hint, "__metadata__", ()), *around)
        omitted = tuple(mark for mark in marks if mark is OmitArgPrefixes)
        if is_dataclass(bare := _bare(hint)) and (omitted or any(getattr(mark, "name", None) == "" for mark in marks)):
            yield bare
            waiting += [(each, omitted) for each in get_type_hints(bare, include_extras=True).values()]


def _bare(hint: Any) -> Any:
    return hint.__origin__ if get_origin(hint) is Annotated else hint


def _with_kind(hint: Any) -> Any:
    """An option that may be left out: its help says what happens then, and what its value is."""
    kind = _kind(hint)
    hints = arg(help_behavior_hint="") if kind is None else arg(help_behavior_hint="", metavar=kind)
    return Annotated[hint, hints]


def _kind(hint: Any) -> str | None:
    """What stands for the value of an option that may be left out: PATH of ``Path | None``; None for several values."""
    bare = _bare(hint)
    named = any(getattr(mark, "metavar", None) for mark in getattr(hint, "__metadata__", ()))
    if named or get_origin(bare) not in (Union, UnionType):
        return None
    kinds = [each for each in get_args(bare) if each is not NoneType]
    if len(kinds) != 1:
        return None
    if get_origin(kinds[0]) is Literal:
        return f"{{{','.join(map(str, get_args(kinds[0])))}}}"
    return _KINDS.get(kinds[0])
