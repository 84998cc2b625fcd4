"""Every number that can be given has a range, and none beyond it is taken."""

from __future__ import annotations

import dataclasses
import importlib
import math
import pkgutil
from collections.abc import Callable, Iterator
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import pytest

import cuspid
from cuspid.cli import COMMANDS, main
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import Options, Range, check, limits


def option_classes() -> list[type]:
    """All that are built on Options."""
    for module in pkgutil.walk_packages(cuspid.__path__, "cuspid."):
        if not module.name.endswith(("__main__", "blender_script")):
            importlib.import_module(module.name)
    found: list[type] = []
    left: list[type] = list(Options.__subclasses__())
    while left:
        each = left.pop()
        left += each.__subclasses__()
        found.append(each)
    return sorted((each for each in found if each.__module__.startswith("cuspid.")), key=lambda each: each.__qualname__)


def kinds(hint: Any) -> set[type]:
    """int or float or neither, of one or several numbers."""
    if get_origin(hint) is Annotated:
        return kinds(hint.__origin__)
    if get_origin(hint) is dict:
        return kinds(get_args(hint)[1])
    return {hint} & {int, float} if get_origin(hint) is None else set().union(*map(kinds, get_args(hint)))


def numbers_of(declared: Callable[..., object]) -> dict[str, type]:
    """int or float by the name of each number that is declared."""
    hints = get_type_hints(declared, include_extras=True)
    return {name: kind for name, hint in hints.items() for kind in kinds(hint)}


def nested(options: type) -> Iterator[type]:
    """Dataclasses that a verb takes, and theirs."""
    for hint in get_type_hints(options).values():
        for each in (hint, *get_args(hint)):
            if dataclasses.is_dataclass(each) and isinstance(each, type):
                yield each
                yield from nested(each)


@pytest.mark.parametrize("options", option_classes(), ids=lambda each: each.__qualname__)
def test_every_number_of_options_has_a_range_that_holds(options: type) -> None:
    default = options()
    for name, kind in numbers_of(options).items():
        allowed = limits(options)[name]
        assert isinstance(allowed, Range)
        assert -math.inf < allowed.low < allowed.high < math.inf
        for wrong in (
            allowed.low - 1,
            2 * allowed.high + 1,
            *((math.nan, math.inf, -math.inf) if kind is float else ()),
        ):
            given: object = kind(wrong)
            if isinstance(getattr(default, name), tuple):
                length = len(getattr(default, name)) if kind is float else 1
                given = (given,) * max(1, length)
            elif isinstance(getattr(default, name), dict):
                given = {46: given}
            with pytest.raises(InputError, match=f"--{name.replace('_', '-')} is .*; it must lie between") as error:
                dataclasses.replace(default, **{name: given})
            assert "\n" not in str(error.value)


@pytest.mark.parametrize("verb", COMMANDS.values(), ids=COMMANDS.keys())
def test_every_number_of_a_verb_has_a_range(verb: Callable[..., object]) -> None:
    assert numbers_of(verb).keys() <= limits(verb).keys()
    for each in nested(verb):  # type: ignore[arg-type]
        assert not numbers_of(each) or issubclass(each, Options), each


def test_a_verb_checks_its_numbers_first(tmp_path, capsys: pytest.CaptureFixture[str]) -> None:
    """Before anything is read or written."""
    with pytest.raises(SystemExit) as status:
        main(["study", "compare", "--supersampling", "0", "--out", str(tmp_path / "out")])
    assert status.value.code == 1
    assert (
        capsys.readouterr().err.strip() == "cuspid: study compare: --supersampling is 0; it must lie between 1 and 16"
    )
    assert not (tmp_path / "out").exists()


def test_a_choice_is_one_of_those() -> None:
    def verb(kind: Literal["a", "b"] | None = None, many: tuple[Annotated[int, Range(1, 3)], ...] = ()) -> None:
        """For its declaration."""

    check("verb", verb, {"kind": None, "many": (1, 3)})
    with pytest.raises(InputError, match="verb: --kind is 'c'; choose a, b"):
        check("verb", verb, {"kind": "c"})
    with pytest.raises(InputError, match="verb: --many is 4; it must lie between 1 and 3"):
        check("verb", verb, {"many": (2, 4)})
