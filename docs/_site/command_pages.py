"""A page for each verb of the command line, from the very parser that reads the user's options."""

from __future__ import annotations

import argparse
import inspect
import re
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro
from _site.docstrings import escaped
from _site.writing import file_name, heading, listed, write_pages

if TYPE_CHECKING:
    from sphinx.application import Sphinx

DEFAULT = re.compile(r"\s*\((default:.*?|required|optional|repeatable.*)\)\s*$", re.DOTALL)
"""What tyro puts at the end of an option's help."""


def setup(app: Sphinx) -> dict[str, Any]:
    app.connect("builder-inited", lambda app: write_pages(Path(app.srcdir) / "cli", pages()))
    return {"parallel_read_safe": True}


def pages() -> dict[str, str]:
    """The text of each page by its file name."""
    from cuspid.cli import COMMANDS

    found = {f"{file_name(verb)}.rst": _page(verb, parser(command)) for verb, command in COMMANDS.items()}
    return {"index.rst": _index({verb: summary(command) for verb, command in COMMANDS.items()}), **found}


def parser(command: Any) -> argparse.ArgumentParser:
    """The parser of one verb. tyro calls this way of getting it deprecated but offers no other that is public."""
    from cuspid.cli.usage import describe_command

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        shown, registry = describe_command(command)
        return tyro.extras.get_parser(shown, registry=registry)


def summary(command: Any) -> str:
    """First sentence of what a verb says of itself."""
    paragraph = inspect.getdoc(command).split("\n\n")[0].replace("\n", " ")
    return re.sub(":$", ".", re.split(r"(?<=[.:]) (?=[A-Z])", paragraph)[0])


def _index(verbs: Mapping[str, str]) -> str:
    intro = "Every verb of ``cuspid`` with all its options, as ``cuspid VERB --help-all`` tells them."
    return "\n".join([heading("Command line", "="), intro, "", *listed(verbs, "cuspid ")])


def _page(verb: str, parser: argparse.ArgumentParser) -> str:
    lines = [heading(f"cuspid {verb}", "="), *_described(f"cuspid {verb}", parser)]
    for kinds in filter(_has_kinds, parser._actions):
        for kind, below in kinds.choices.items():
            if len(below._actions) > 1:
                lines += [heading(f"cuspid {verb} ... {kind}", "-"), *_described(f"cuspid {verb} {kind}", below, "~")]
    return "\n".join(lines)


def _has_kinds(action: argparse.Action) -> bool:
    """Whether a word chooses further options, as the kind of a preparation."""
    return isinstance(action.choices, Mapping)


def _described(program: str, parser: argparse.ArgumentParser, underline: str = "-") -> Iterator[str]:
    yield from (escaped(parser.description or ""), "", f".. program:: {program}", "")
    for group in parser._action_groups:
        actions = [
            each for each in group._group_actions if "--help" not in each.option_strings and not _has_kinds(each)
        ]
        if actions:
            yield from _group(group, actions, underline)


def _group(group: Any, actions: list[argparse.Action], underline: str) -> Iterator[str]:
    title = _title(group)
    if title:
        yield heading(title, underline)
    for action in actions:
        text, remark = _help(action)
        default = f" *({escaped(remark)})*" if remark else ""
        yield from (f".. option:: {_signature(action)}", "", f"   {escaped(text)}{default}", "")


def _title(group: Any) -> str:
    """What a group of options is about, and the prefix that they share where it has one."""
    prefix = group.title.removesuffix(" options")
    shared = all("".join(action.option_strings).startswith(f"--{prefix}.") for action in group._group_actions)
    about = (group.description or (prefix if shared else "")).strip().rstrip(".").replace("``", "")
    return f"{about} (--{prefix}.…)" if shared else about


def _signature(action: argparse.Action) -> str:
    metavar = action.metavar or ""
    if isinstance(metavar, tuple):
        metavar = " ".join(metavar)
    if not action.option_strings:
        return metavar or action.dest
    return ", ".join(f"{name} {metavar}".strip() for name in action.option_strings)


def _help(action: argparse.Action) -> tuple[str, str]:
    """The help of an option, and what stands in brackets at its end."""
    text = " ".join((action.help or "").split())
    found = DEFAULT.search(text)
    if found is None:
        return text, ""
    remark = found.group(1).strip()
    return text[: found.start()], "default: nothing" if remark == "default:" else remark
