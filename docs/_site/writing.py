"""Pages that the build writes, in reStructuredText."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from _site.docstrings import escaped


def write_pages(folder: Path, pages: Mapping[str, str]) -> None:
    """Write what has changed, so that Sphinx reads only that again, and remove pages that are no more."""
    folder.mkdir(exist_ok=True)
    for path in folder.iterdir():
        if path.name not in pages:
            path.unlink()
    for name, text in pages.items():
        path = folder / name
        if not path.exists() or path.read_text() != text:
            path.write_text(text)


def heading(text: str, underline: str) -> str:
    """A heading; the character of the line below it tells the level."""
    return f"{escaped(text)}\n{underline * len(escaped(text))}\n"


def listed(pages: Mapping[str, str], prefix: str = "") -> Iterator[str]:
    """A list of pages in the same folder with what they are about; spaces are hyphens in the names of the files."""
    links = {f"{prefix}{name} <{file_name(name)}>": about for name, about in pages.items()}
    yield from (".. toctree::", "   :hidden:", "", *(f"   {link}" for link in links), "")
    for link, about in links.items():
        yield from (f":doc:`{link}`", f"   {escaped(about)}", "")


def file_name(title: str) -> str:
    """Of the page of a verb or a module, without its ending."""
    return title.replace(" ", "-")
