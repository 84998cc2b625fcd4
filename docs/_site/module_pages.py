"""A page for the ground floor and for each package, with the docstrings of their public modules (Sphinx's autodoc)."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from _site.writing import heading, listed, write_pages

if TYPE_CHECKING:
    from docutils import nodes
    from sphinx.application import Sphinx

SOURCE = Path(__file__).parents[2] / "src"
SCRIPTS = ("cuspid.__main__", "cuspid.simulation.blender_script")
"""To be run, not imported."""
GROUND_FLOOR = "cuspid"


def setup(app: Sphinx) -> dict[str, Any]:
    app.connect("builder-inited", lambda app: write_pages(Path(app.srcdir) / "api", pages()))
    app.connect("doctree-read", _take_names_exactly)
    return {"parallel_read_safe": True}


def _take_names_exactly(app: Sphinx, page: nodes.document) -> None:
    """Types are named in full. Sphinx would also look for each word of a shape, as ``n``, in all names that end so."""
    for name in page.findall(lambda node: getattr(node, "attributes", {}).get("refspecific") is False):
        del name["refspecific"]


def pages() -> dict[str, str]:
    """The text of each page by its file name."""
    modules = public_modules()
    floors = _floors(modules)
    return {
        "index.rst": _index({name: modules[name] for name in floors}),
        **{f"{name}.rst": _page(name, {each: modules[each] for each in inside}) for name, inside in floors.items()},
    }


def public_modules() -> dict[str, str]:
    """The dotted name of each public module that can be imported, and what its docstring says first."""
    found = {}
    for path in sorted((SOURCE / "cuspid").rglob("*.py")):
        parts = path.relative_to(SOURCE).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        if name not in SCRIPTS and not any(part.startswith("_") for part in parts[:-1]):
            found[name] = _summary(path)
    return found


def _summary(path: Path) -> str:
    docstring = (ast.get_docstring(ast.parse(path.read_text())) or "").split("\n\n")[0].replace("\n", " ")
    return re.split(r"(?<=\.) (?=[A-Z])", docstring)[0]


def _floors(modules: Mapping[str, str]) -> dict[str, list[str]]:
    """The modules that stand on a page together: those right below cuspid, and those of each of its packages."""
    packages = sorted({name for name in modules if any(other.startswith(f"{name}.") for other in modules)})
    floors: dict[str, list[str]] = {name: [] for name in packages if name.count(".") <= 1}
    for name in modules:
        package = ".".join(name.split(".")[:2])
        floors[package if package in floors else GROUND_FLOOR].append(name)
    return floors


def _index(floors: Mapping[str, str]) -> str:
    intro = "What the modules offer, from their docstrings. How they hang together: :doc:`/architecture`."
    return "\n".join([heading("Python modules", "="), intro, "", *listed(floors)])


def _page(floor: str, modules: Mapping[str, str]) -> str:
    title = "cuspid: the ground floor" if floor == GROUND_FLOOR else floor
    return "\n".join([heading(title, "="), *(line for name in modules for line in _section(name, floor))])


def _section(name: str, floor: str) -> Iterator[str]:
    if name != floor:
        yield heading(name, "-")
    if name == GROUND_FLOOR:
        yield from (f".. automodule:: {name}", "   :no-members:", "", *_face(), "")
    else:
        yield from (f".. automodule:: {name}", "")


def _face() -> Iterator[str]:
    """What the package offers by name; it has its place where it is made."""
    stub = ast.parse((SOURCE / GROUND_FLOOR / "__init__.pyi").read_text())
    places = {
        alias.name: f"{GROUND_FLOOR}.{node.module}.{alias.name}"
        for node in stub.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    for name in sorted(places, key=str.swapcase):
        yield f"- :py:obj:`{GROUND_FLOOR}.{name} <{places[name]}>`"
