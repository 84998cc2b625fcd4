"""Which results still hold: nothing that made them has changed since the commit that they are of.

What makes a result is its script, the modules that the script imports, in turn, and those of the verbs that it runs.
Comments, docstrings and the number of the version have no part in it, nor has what only makes pages and pictures of a
finished folder or reads footage, unless all verbs are tried, nor what only plain surfaces need, where none are scanned.
"""

from __future__ import annotations

import ast
import subprocess
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from functools import cache
from pathlib import Path
from typing import Any

import grimp

HERE = Path(__file__).parent
ROOT = HERE.parent
SHOWN_BY = ("cuspid.reporting", "cuspid.storage.results")
"""Modules that only show what was made."""
PLAIN = ("cuspid.stereo.shading", "cuspid.motion.surface_tracking")
"""Modules that a scan of a textured surface takes nothing from but options."""
FOOTAGE = ("cuspid.storage.videos",)
"""Modules that only real footage is read by."""
UNTOLD = "no commit, or one of uncommitted changes"

Result = Mapping[str, Any]


@dataclass(frozen=True)
class Maker:
    """What a result is made by."""

    script: str
    """In this folder, without its ending."""
    verbs: tuple[str, ...] = ()
    """Modules of ``cuspid.cli`` that it runs; ``*`` for all of them."""
    runs: tuple[str, ...] = ()
    """Further scripts in this folder, which it starts instead of importing them."""
    plain: bool = False
    """Whether surfaces without texture take part."""
    release: bool = False
    """Whether it is measured anew for each release, together with the others of these, at one commit."""

    @property
    def leaves_out(self) -> tuple[str, ...]:
        """Modules without a part in it."""
        return (*(() if "*" in self.verbs else SHOWN_BY + FOOTAGE), *(() if self.plain else PLAIN))


_SCAN = ("scan", "jaws")
MAKERS: Mapping[str, Maker] = {
    **dict.fromkeys(
        ("molar-*", "arch", "real-arch", "spheres", "prepared-*", "all-round-*"), Maker("run", _SCAN, release=True)
    ),
    "motion-*": Maker("compare_motion", _SCAN),
    "qualities": Maker("qualities", _SCAN, runs=("staged",)),
    "live": Maker("live", _SCAN),
    "mouth": Maker("mouth"),
    "measure": Maker("measure_jaws"),
    "landmarks": Maker("landmarks"),
    "populations": Maker("populations"),
    "mean_shape": Maker("mean_shape", ("jaws", "surveys")),
    "visibility": Maker("visibility"),
    "precision": Maker("precision"),
    "camera_pair": Maker("camera_pair"),
    "camera_sweep": Maker("camera_sweep", ("studies",)),
    "design_comparison*": Maker("design_comparison"),
    "any_rig": Maker("any_rig"),
    "stereo_pairs": Maker("stereo_pairs"),
    "jaws_*": Maker("jaws"),
    "enamel": Maker("enamel", plain=True),
    "plain_frames": Maker("plain_frames", plain=True),
    "real": Maker("real", ("scan",), runs=("real_runs",), plain=True),
    "cast": Maker("cast", ("scan",)),
    "real_gloss": Maker("real_gloss", plain=True),
    "manufacturing*": Maker("manufacturing"),
    "expectations": Maker("expectations"),
    "targets": Maker("targets"),
    "calibrations": Maker("calibrations"),
    "grid": Maker("grid"),
    "study": Maker("study", ("study",)),
    "fuzz": Maker("fuzz", ("*",), plain=True, release=True),
    "kill": Maker("kill", ("*",), plain=True, release=True),
    "large": Maker("large", ("*",), plain=True, release=True),
    "panorama/*": Maker("panorama", ("film", "panorama", "panorama_evaluation")),
}
"""By the name of the result."""


def maker_of(name: str) -> Maker:
    """What the result of this name is made by."""
    return next(maker for pattern, maker in MAKERS.items() if fnmatch(name, pattern))


def changes(name: str, result: Result) -> tuple[str, ...]:
    """Files that made a result, as far as they have changed since; empty where it still holds."""
    maker = maker_of(name)
    changed: set[str] = set()
    for commit in _commits(result):
        changed |= {UNTOLD} if commit is None or commit.endswith("-dirty") else _changed_since(commit, maker)
    return tuple(sorted(changed))


def _commits(result: Result) -> Iterator[str | None]:
    """Of the result, and of its scans where these tell of their own."""
    scans = result.get("scans", ())
    told = [scan.get("commit") for scan in (scans.values() if isinstance(scans, Mapping) else scans)]
    yield from {each for each in told if each is not None} or {result.get("commit")}


@cache
def _changed_since(commit: str, maker: Maker) -> frozenset[str]:
    try:
        before = _blobs("ls-tree", "-r", commit)
    except subprocess.CalledProcessError:
        return frozenset({f"commit {commit} is not in this repository"})
    today = _made_by(maker)
    return frozenset(file for file in today if file not in before or _differs(before[file], file))


def _blobs(*arguments: str) -> dict[str, str]:
    """Contents of files, by the names that Git has for them."""
    lines = _git(*arguments, "src", "benchmarks").decode().splitlines()
    return {line.split("\t")[1]: line.split("\t")[0].split()[2] for line in lines}


def _differs(blob: str, file: str) -> bool:
    then, now = _content(blob), (ROOT / file).read_bytes()
    return then != now and _meaning(then) != _meaning(now)


@cache
def _content(blob: str) -> bytes:
    return _git("cat-file", "blob", blob)


@cache
def _meaning(content: bytes) -> str:
    """A module without what people only read."""
    tree = ast.parse(content)
    for node in ast.walk(tree):
        for body in (getattr(node, "body", None), getattr(node, "orelse", None)):
            if isinstance(body, list):
                body[:] = [each for each in body if not _is_text(each)]
    return ast.dump(tree)


def _is_text(statement: ast.AST) -> bool:
    constant = statement.value if isinstance(statement, ast.Expr) else None
    return isinstance(constant, ast.Constant) and isinstance(constant.value, str)


def _made_by(maker: Maker) -> set[str]:
    """Files that take part."""
    scripts = set[Path]().union(*(_scripts(name) for name in (maker.script, *maker.runs)))
    roots = {name for script in scripts for name in _imported(script) if name.split(".")[0] == "cuspid"}
    every = [path.stem for path in (ROOT / "src/cuspid/cli").glob("*.py")]
    verbs = every if "*" in maker.verbs else maker.verbs
    modules = _upstream(roots | {f"cuspid.cli.{verb}" for verb in verbs if verb != "__init__"}, maker.leaves_out)
    return {str(path.relative_to(ROOT)) for path in [*scripts, *map(_file_of, modules)]}


def _scripts(name: str) -> set[Path]:
    """A script and the others of this folder that it imports, in turn."""
    found, waiting = set(), [HERE / f"{name}.py"]
    while waiting:
        script = waiting.pop()
        found.add(script)
        others = {HERE / f"{name}.py" for name in _imported(script)}
        waiting += [other for other in others - found if other.exists()]
    return found


@cache
def _imported(script: Path) -> frozenset[str]:
    """Modules, and what else is imported from them: that may be a module, too."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(script.read_bytes())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return frozenset(names)


@cache
def _graph(without: tuple[str, ...]) -> grimp.ImportGraph:
    graph = grimp.build_graph("cuspid", cache_dir=None)
    for name in without:
        for module in {name} | graph.find_descendants(name):
            graph.remove_module(module)
    return graph


def _upstream(roots: Iterable[str], without: tuple[str, ...]) -> set[str]:
    graph = _graph(without)
    known: Sequence[str] = [root for root in roots if root in graph.modules]
    return set(known).union(*(graph.find_upstream_modules(root) for root in known)) - {"cuspid"}


def _file_of(module: str) -> Path:
    path = ROOT / "src" / Path(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def _git(*arguments: str) -> bytes:
    return subprocess.run(["git", "-C", str(ROOT), *arguments], check=True, capture_output=True).stdout
