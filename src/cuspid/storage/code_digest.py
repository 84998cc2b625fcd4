"""What code does, as a digest: that of a module and, in turn, of the modules that it imports.

Comments, docstrings, the layout of the text, the order of imports, and the names and places of modules have no part in
it: an import counts as what it brings, the digest of the other module and the name that is taken from it. What is only
named in a text, as the module of ``import_module`` or a script that is run, is not found; name it beside the first one.
"""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache, cached_property

Reader = Callable[[str], bytes | None]
"""The text of a module of ours by its dotted name, None where there is none; of the package ``cuspid`` itself its stub,
which tells where the names are from that it offers."""
PACKAGE = "cuspid"


def meaning(text: bytes) -> str:
    """The statements of a module without what people only read."""
    return ast.dump(_without_texts(ast.parse(text)))


def _without_texts(tree: ast.Module) -> ast.Module:
    """The tree itself, from which they are taken."""
    for body in _bodies(tree):
        body[:] = [statement for statement in body if not _is_text(statement)]
    return tree


def _bodies(tree: ast.AST) -> Iterator[list[ast.stmt]]:
    for node in ast.walk(tree):
        for name in ("body", "orelse", "finalbody"):
            if isinstance(body := getattr(node, name, None), list):
                yield body


def _is_text(statement: ast.AST) -> bool:
    constant = statement.value if isinstance(statement, ast.Expr) else None
    return isinstance(constant, ast.Constant) and isinstance(constant.value, str)


def _imports(tree: ast.Module) -> frozenset[tuple[str, str]]:
    """What a module imports, wherever in it: the other module, and the name that is taken from it, empty for all of it.
    What is used as ``cuspid.name`` is taken from there."""
    found = set[tuple[str, str]]()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            found |= {_imported_name(node, alias) for alias in node.names}
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == PACKAGE:
            found.add((PACKAGE, node.attr))
    return frozenset(found)


@cache
def _parsed_imports(text: bytes) -> frozenset[tuple[str, str]]:
    return _imports(ast.parse(text))


def _imported_name(statement: ast.Import | ast.ImportFrom, alias: ast.alias) -> tuple[str, str]:
    if isinstance(statement, ast.Import):
        return alias.name, ""
    if statement.level:
        raise LookupError(f"line {statement.lineno}: imports by a name relative to its own, which is not followed")
    return statement.module or "", alias.name


class Code:
    """The modules that a reader finds; ``without`` some of them, and those inside, of which only the names count."""

    def __init__(self, read: Reader, without: Sequence[str] = ()) -> None:
        self._read, self._without = read, tuple(without)
        self._texts: dict[str, bytes | None] = {}
        self._digests: dict[str, str] = {}

    def digest(self, module: str) -> str:
        """SHA-256 of what a module does. Raises LookupError where there is no such module."""
        if self._is_left_out(module):
            return module
        if module not in self._digests:
            self._digests[module] = module  # where imports go round in a circle
            self._digests[module] = self._digest(self._read_source(module))
        return self._digests[module]

    def modules(self, roots: Iterable[str]) -> frozenset[str]:
        """Some modules and those that they import, in turn. Raises LookupError where there is none of these names."""
        found, waiting = set[str](), list(roots)
        while waiting:
            module = waiting.pop()
            if module not in found and not self._is_left_out(module):
                found.add(module)
                named = (self._source(*each) for each in _parsed_imports(self._read_source(module)))
                waiting += [each[0] for each in named if each is not None and each[0]]
        return frozenset(found)

    def _is_left_out(self, module: str) -> bool:
        return any(module == each or module.startswith(f"{each}.") for each in self._without)

    def _text(self, module: str) -> bytes | None:
        if module not in self._texts:
            self._texts[module] = self._read(module)
        return self._texts[module]

    def _read_source(self, module: str) -> bytes:
        text = self._text(module)
        if text is None:
            raise LookupError(f"there is no module {module}")
        return text

    def _digest(self, text: bytes) -> str:
        tree = ast.parse(text)
        imported = _imports(tree)
        for body in [*_bodies(_without_texts(tree))]:
            brought: list[tuple[str, str, str]] = []
            body[:] = [rest for statement in body if (rest := self._strip_own_imports(statement, brought)) is not None]
            body.insert(0, ast.Expr(ast.Constant(repr(sorted(brought)))))
        used = sorted(self._brought(PACKAGE, *each) for each in imported if each[0] == PACKAGE)
        return hashlib.sha256(f"{used} {ast.dump(tree)}".encode()).hexdigest()

    def _strip_own_imports(self, statement: ast.stmt, brought: list[tuple[str, str, str]]) -> ast.stmt | None:
        """The statement without what it imports from modules of ours, which is added to ``brought``."""
        if not isinstance(statement, ast.Import | ast.ImportFrom):
            return statement
        foreign = []
        for alias in statement.names:
            taken = _imported_name(statement, alias)
            if self._source(*taken) is None:
                foreign.append(alias)
            else:
                brought.append(self._brought(alias.asname or alias.name, *taken))
        statement.names = foreign
        return statement if foreign else None

    def _brought(self, bound: str, module: str, name: str) -> tuple[str, str, str]:
        """What an import brings: what that is called here, the digest of where it is from, and its name there."""
        source, own = self._source(module, name) or ("", name)
        return bound, self.digest(source) if source else "", own

    def _source(self, module: str, name: str) -> tuple[str, str] | None:
        """The module of ours that a name is imported from, and its name there, empty for the module itself; None for
        what is not ours. Of the package itself, only what it offers from elsewhere has a module."""
        if name and self._text(f"{module}.{name}") is not None:
            return f"{module}.{name}", ""
        if module == PACKAGE:
            return self._face.get(name, ""), name
        return None if self._text(module) is None else (module, name)

    @cached_property
    def _face(self) -> dict[str, str]:
        """Where the names are from that the package offers."""
        stub = ast.parse(self._text(PACKAGE) or b"")
        return {
            alias.name: f"{PACKAGE}.{node.module}"
            for node in stub.body
            if isinstance(node, ast.ImportFrom)
            for alias in node.names
        }
