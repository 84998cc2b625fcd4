"""The command line: a verb is load, one call, save."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Mapping
from functools import wraps
from inspect import signature
from typing import Any, get_type_hints

import tyro

from cuspid.cli.comparison import compare
from cuspid.cli.film import film
from cuspid.cli.forecasts import optics, precision, visibility
from cuspid.cli.handpieces import design, handpiece
from cuspid.cli.jaws import box, phantom, prepare
from cuspid.cli.mouth import mouth
from cuspid.cli.panorama import stitch
from cuspid.cli.panorama_evaluation import stitch_eval
from cuspid.cli.repeat import repeat
from cuspid.cli.report import report
from cuspid.cli.reproduction import reproduce
from cuspid.cli.scan import evaluate, reconstruct, run, simulate
from cuspid.cli.shared import console
from cuspid.cli.studies import sweep
from cuspid.cli.surveys import measure, shape
from cuspid.cli.view import view
from cuspid.errors import CuspidError
from cuspid.options import check

COMMANDS: Mapping[str, Callable[..., Any]] = {
    "run": run,
    "phantom": phantom,
    "measure": measure,
    "shape": shape,
    "prepare": prepare,
    "box": box,
    "mouth": mouth,
    "handpiece": handpiece,
    "design": design,
    "optics": optics,
    "visibility": visibility,
    "precision": precision,
    "compare": compare,
    "sweep": sweep,
    "simulate": simulate,
    "film": film,
    "stitch-eval": stitch_eval,
    "reconstruct": reconstruct,
    "evaluate": evaluate,
    "stitch": stitch,
    "reproduce": reproduce,
    "repeat": repeat,
    "report": report,
    "view": view,
}


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
    """Run a verb; a known error is one line on stderr and exit status 1."""
    log = logging.getLogger("cuspid")
    log.setLevel(logging.INFO)
    log.handlers = [_Notes()]
    try:
        _run(arguments)
    except CuspidError as error:
        console.print(f"cuspid: {error}", style="red", soft_wrap=True, highlight=False)
        sys.exit(1)
    except KeyboardInterrupt:
        console.print("cuspid: interrupted; the same command goes on where it stopped")
        sys.exit(130)
    except BrokenPipeError:  # what reads us, as ``head`` does, has had enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)


def _run(arguments: list[str] | None) -> None:
    try:
        tyro.extras.subcommand_cli_from_dict(
            {name: _checked(name, verb) for name, verb in COMMANDS.items()},
            prog="cuspid",
            description="Passive intra-oral 3D scanning: simulate, reconstruct, and prove the accuracy.",
            args=arguments,
        )
    finally:
        sys.stdout.flush()
