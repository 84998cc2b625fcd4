"""The command line: each verb loads its inputs, makes one call and saves the results."""

from __future__ import annotations

import codecs
import io
import logging
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import wraps
from importlib import import_module
from inspect import signature
from keyword import iskeyword
from pathlib import Path
from typing import Any, NoReturn, get_type_hints

import tyro

from cuspid import __version__
from cuspid.cli.shared import console
from cuspid.errors import CuspidError
from cuspid.options import check
from cuspid.values import one_line

DESCRIPTION = (
    f"cuspid {__version__}: passive intra-oral 3D scanning: simulate, reconstruct, and prove the accuracy. "
    "What a verb does and takes: cuspid VERB --help."
)


class _Verbs(Mapping[str, Callable[..., Any]]):
    """The function of each verb. Its module is loaded when it is asked for: to load them all takes seconds."""

    def __init__(self, modules: Mapping[str, str]) -> None:
        self._modules = modules

    def __getitem__(self, verb: str) -> Callable[..., Any]:
        name = verb.replace("-", "_")
        return getattr(import_module(f"cuspid.cli.{self._modules[verb]}"), f"{name}_" if iskeyword(name) else name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._modules)

    def __len__(self) -> int:
        return len(self._modules)


COMMANDS: Mapping[str, Callable[..., Any]] = _Verbs(
    {
        "run": "scan",
        "phantom": "jaws",
        "measure": "surveys",
        "shape": "surveys",
        "prepare": "jaws",
        "box": "jaws",
        "mouth": "mouth",
        "handpiece": "handpieces",
        "design": "handpieces",
        "target": "calibration",
        "photograph": "calibration",
        "calibrate": "calibration",
        "convert": "conversion",
        "record": "record",
        "import": "footage",
        "optics": "forecasts",
        "visibility": "forecasts",
        "precision": "forecasts",
        "compare": "comparison",
        "sweep": "studies",
        "simulate": "scan",
        "film": "film",
        "stitch-eval": "panorama_evaluation",
        "reconstruct": "scan",
        "live": "live",
        "evaluate": "scan",
        "stitch": "panorama",
        "rescale": "rescaling",
        "reproduce": "reproduction",
        "repeat": "repeat",
        "report": "report",
        "view": "view",
    }
)


def commands(arguments: Sequence[str]) -> dict[str, Callable[..., None]]:
    """The verb that the arguments begin with, none for ``--version``, otherwise all verbs; their modules are loaded."""
    first = arguments[0] if arguments else ""
    named = [first] if first in COMMANDS else [] if first == "--version" else COMMANDS
    return {verb: _checked(verb, COMMANDS[verb]) for verb in named}


def _checked(name: str, verb: Callable[..., None]) -> Callable[..., None]:
    """A verb that checks its own numbers before it begins."""

    @wraps(verb)
    def checked(*given: object, **options: object) -> None:
        check(name, verb, signature(verb).bind(*given, **options).arguments)
        verb(*given, **options)

    checked.__annotations__ = get_type_hints(verb, include_extras=True)  # as text they would be looked up here
    return checked


class _Notes(logging.Handler):
    """What the code has to say while it runs, a line each."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print it."""
        console.print(f"note: {record.getMessage()}", soft_wrap=True, highlight=False)


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
        console.print("cuspid: interrupted; run the same command again to continue")
        sys.exit(130)
    except BrokenPipeError:  # what reads us, as ``head`` does, has had enough
        _print_no_more()
        sys.exit(1)
    except (MemoryError, ImportError, RuntimeError, OSError) as error:
        if _lacks_memory(error):
            size = one_line(error) or "for this size"
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
    console.print(f"cuspid: {CuspidError(message)}", style="red", soft_wrap=True, highlight=False)
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


def _in_other_letters(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    wanted = error.object[error.start : error.end]
    return "".join(_LETTERS.get(letter, "?") for letter in wanted), error.end


codecs.register_error(_IN_OTHER_LETTERS, _in_other_letters)


def _run(arguments: Sequence[str]) -> None:
    verbs = commands(arguments)
    try:
        if not verbs:
            print(f"cuspid {__version__}")
        elif len(verbs) == 1:
            ((name, verb),) = verbs.items()
            tyro.cli(verb, prog=f"cuspid {name}", args=arguments[1:])
        else:
            tyro.extras.subcommand_cli_from_dict(verbs, prog="cuspid", description=DESCRIPTION, args=arguments)
    finally:
        sys.stdout.flush()
