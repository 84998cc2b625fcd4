"""The command line: each verb loads its inputs, makes one call and saves the results.

What takes long to load is loaded where it is needed: the overview of the verbs should come at once.
"""

from __future__ import annotations

import codecs
import io
import logging
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import wraps
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, get_type_hints

from cuspid import __version__
from cuspid.cli.verbs import GROUPS, VERBS, overview, reject_old_options, reject_unknown, split_verb
from cuspid.runtime.errors import CuspidError
from cuspid.runtime.plugins import load_plugin

if TYPE_CHECKING:
    from rich.console import Console


class _Commands(Mapping[str, Callable[..., Any]]):
    """The function of each verb. Its module is loaded when it is asked for: to load them all takes seconds."""

    def __getitem__(self, verb: str) -> Callable[..., Any]:
        module, _, function, distribution = VERBS[verb]
        if distribution is not None:
            return load_plugin("cuspid.verbs", verb, requested=verb, distribution=distribution)
        return getattr(import_module(f"cuspid.cli.{module}"), function or verb.split()[-1])

    def __iter__(self) -> Iterator[str]:
        return iter(VERBS)

    def __len__(self) -> int:
        return len(VERBS)


COMMANDS: Mapping[str, Callable[..., Any]] = _Commands()


def load(arguments: Sequence[str]) -> None:
    """Load what the verb that the arguments begin with needs."""
    verb, _ = split_verb(arguments)
    if verb in VERBS:
        import_module("tyro")
        with suppress(CuspidError):  # which running it tells
            COMMANDS[verb]


def check_options_of(verb: str) -> Callable[..., None]:
    """The function of a verb, which checks its own numbers before it begins."""
    from cuspid.runtime.options import check

    command = COMMANDS[verb]

    @wraps(command)
    def first_checked(*given: object, **options: object) -> None:
        check(verb, command, signature(command).bind(*given, **options).arguments)
        command(*given, **options)

    # As text they would be looked up here.
    first_checked.__annotations__ = get_type_hints(command, include_extras=True)
    return first_checked


class _Notes(logging.Handler):
    """What the code has to say while it runs, a line each."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print it."""
        _console().print(f"note: {record.getMessage()}", soft_wrap=True, highlight=False)


def _console() -> Console:
    from cuspid.cli.shared import console

    return console


def main(arguments: list[str] | None = None) -> None:
    """Run a verb; a known error prints one line on stderr and exits with status 1."""
    _require_streams()
    warnings.filterwarnings("ignore", module="PIL")  # what is wrong with an image is told where it is read
    log = logging.getLogger("cuspid")
    log.setLevel(logging.INFO)
    log.handlers = [_Notes()]
    try:
        _run(sys.argv[1:] if arguments is None else arguments)
    except CuspidError as error:
        _fail(str(error))
    except KeyboardInterrupt:
        _console().print("cuspid: interrupted; run the same command again to continue")
        sys.exit(130)
    except BrokenPipeError:  # what reads us, as ``head`` does, has had enough
        _print_no_more()
        sys.exit(1)
    except (MemoryError, ImportError, RuntimeError, OSError) as error:
        if _lacks_memory(error):
            size = str(error) or "for this size"
            _fail(f"there is not enough memory ({size}); give less, smaller or coarser input")
        if not isinstance(error, OSError):
            raise
        if error.filename is None:  # no file of ours: where we print to
            _print_no_more()
            _fail(f"what is printed cannot be written ({error.strerror or error}); print elsewhere")
        _fail(f"{error.filename}: cannot be used ({error.strerror or error}); change its permissions, or give another")


def _lacks_memory(error: Exception) -> bool:
    """Whether it is for want of memory that something failed: loading a library and beginning a thread need some."""
    return isinstance(error, MemoryError) or any(words in str(error) for words in _NO_MEMORY)


_NO_MEMORY = ("failed to map segment", "annot allocate memory", "can't start new thread")


def _fail(message: str) -> NoReturn:
    try:
        _console().print(f"cuspid: {CuspidError(message)}", style="red", soft_wrap=True, highlight=False)
    except (ImportError, MemoryError):  # there may be no memory for what prints, either
        print(f"cuspid: {CuspidError(message)}", file=sys.stderr)
    sys.exit(1)


def _print_no_more() -> None:
    """Let what is still to be printed go nowhere, which at the end would fail again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _require_streams() -> None:
    """Streams that take all that is printed: nowhere, if they are closed, and in other letters where a terminal does
    not have those."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115
        stream = getattr(sys, name)
        if isinstance(stream, io.TextIOWrapper) and codecs.lookup(stream.encoding).name != "utf-8":
            stream.reconfigure(errors=_IN_OTHER_LETTERS)


_IN_OTHER_LETTERS = "cuspid.in_other_letters"
_LETTERS = {"µ": "u", "μ": "u", "±": "+-", "°": " deg", "²": "2", "³": "3", "×": "x", "…": "...", "—": "-", "–": "-"}


def _describe_system_error(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    letters = error.object[error.start : error.end]
    return "".join(_LETTERS.get(letter, "?") for letter in letters), error.end


codecs.register_error(_IN_OTHER_LETTERS, _describe_system_error)


def _run_verb(verb: str, given: list[str]) -> None:
    import tyro

    from cuspid.cli.config import options_of, read_config, take_target, write_config
    from cuspid.cli.usage import show_help

    prog, command = f"cuspid {verb}", COMMANDS[verb]
    if {"-h", "--help", "--help-all"} & set(given):
        show_help(prog, command, given, every="--help-all" in given)
    reject_old_options(verb, given, options_of(command))
    target, given = take_target(read_config(verb, command, given))
    if target is None:
        tyro.cli(check_options_of(verb), prog=prog, args=given)
        return

    @wraps(command)
    def keep(*positional: object, **options: object) -> None:
        bound = signature(command).bind(*positional, **options)
        bound.apply_defaults()
        write_config(target, verb, command, bound.arguments)

    tyro.cli(keep, prog=prog, args=given)
    _console().print(f"{target}: take it with --config", highlight=False)


def _run(arguments: Sequence[str]) -> None:
    verb, given = split_verb(arguments or ["--help"])
    group = verb.removesuffix(" --help").removesuffix(" -h")
    try:
        if verb in ("--help", "-h"):
            print(overview())
        elif group in GROUPS:
            print(overview(group))
        elif verb == "--version":
            print(f"cuspid {__version__}")
        elif verb not in COMMANDS:
            print(f"cuspid: {CuspidError(reject_unknown(verb))}", file=sys.stderr)
            sys.exit(2)
        else:
            _run_verb(verb, given)
    finally:
        sys.stdout.flush()
