"""The Markdown pages of the documentation, taken apart into what a reader would type."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from markdown_it import MarkdownIt

ROOT = Path(__file__).parents[2]
GENERATED = ("api", "cli")
NOT_RUN = re.compile(r"<!-- not run: .+ -->\s*$")
COMMAND = re.compile(r"^(\$ )?cuspid [a-z]")
INLINE = re.compile(r"`(cuspid [a-z][^`]*)`")


@dataclass(frozen=True)
class Block:
    """Code on a page, and where it stands."""

    page: Path
    line: int
    language: str
    """As the fence says; empty for an indented block."""
    text: str
    run: bool
    """Whether nothing says "not run" right above it."""

    @property
    def place(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"

    def lines(self) -> Iterator[str]:
        """Its lines, with those that a backslash continues in one."""
        yield from (line.strip() for line in self.text.replace("\\\n", " ").splitlines() if line.strip())


def pages() -> list[Path]:
    """README.md and all pages that somebody wrote."""
    docs = ROOT / "docs"
    written = (path for path in docs.rglob("*.md") if path.relative_to(docs).parts[0] not in GENERATED)
    return [ROOT / "README.md", *sorted(written)]


def blocks(page: Path) -> list[Block]:
    """The code on a page, in its order."""
    found, above = [], ""
    for token in MarkdownIt().parse(page.read_text()):
        if token.type in ("fence", "code_block"):
            run = not NOT_RUN.match(above)
            found.append(Block(page, token.map[0] + 1, token.info.strip(), token.content, run))
        if token.content:
            above = token.content if token.type == "html_block" else ""
    return found


def commands(page: Path) -> Iterator[tuple[str, list[str]]]:
    """Each command line of cuspid in the blocks of a page, with its place."""
    for block in blocks(page):
        for line in block.lines():
            if COMMAND.match(line):
                yield block.place, words(line.removeprefix("$ "))


def mentions(page: Path) -> Iterator[tuple[str, list[str]]]:
    """Each command with options within the text of a page, with its place; it need not be complete."""
    for number, line in enumerate(page.read_text().splitlines(), start=1):
        for command in INLINE.findall(line):
            if " --" in command and "--help" not in command:
                yield f"{page.relative_to(ROOT)}:{number}", words(command)


def words(line: str) -> list[str]:
    """What the shell would make of a line, without its comment and without ``cuspid``."""
    return shlex.split(line, comments=True)[1:]
