"""Which results still hold: nothing that made them has changed since the commit that they are of.

What makes a result is its script, the modules that the script imports, in turn, and those of the verbs that it runs.
Comments, docstrings, names and places of modules (:mod:`cuspid.storage.code_digest`) and the number of the version have
no part in it, nor has what only makes pages and pictures of a
finished folder or reads footage, unless all verbs are tried, nor what only plain surfaces need, where none are scanned.
"""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from functools import cache
from pathlib import Path
from typing import Any

from cuspid.storage.code_digest import PACKAGE, Code, meaning

ROOT = Path(__file__).parent.parent
SHOWN_BY = ("cuspid.report", "cuspid.storage.results")
"""Modules that only show what was made."""
PLAIN = ("cuspid.mvs.shading", "cuspid.motion.icp.surface_tracking")
"""Modules that a scan of a textured surface takes nothing from but options."""
FOOTAGE = ("cuspid.storage.videos",)
"""Modules that only real footage is read by."""
UNTOLD = "no commit, or one of uncommitted changes"

_SOURCES = {PACKAGE: "src", "cuspid_thesis": "reproduction/src"}
"""Where the packages lie."""

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
    """Whether it holds for the code of each release, and is measured anew where it does not."""

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
    "orientation": Maker("orientation"),
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
    "real": Maker("real", ("scan",), runs=("real_runs",), plain=True, release=True),
    "cast": Maker("cast", ("scan",)),
    "real_gloss": Maker("real_gloss", plain=True),
    "manufacturing*": Maker("manufacturing"),
    "expectations": Maker("expectations"),
    "targets": Maker("targets"),
    "calibrations": Maker("calibrations"),
    "rolling": Maker("rolling"),
    "grid": Maker("grid"),
    "study": Maker("study", ("study",)),
    "fuzz": Maker("fuzz", ("*",), plain=True, release=True),
    "mutation": Maker("mutation", ("*",), plain=True),
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
        before = _contents(_blobs("ls-tree", "-r", commit))
    except subprocess.CalledProcessError:
        return frozenset({f"commit {commit} is not in this repository"})
    roots, now = _roots(maker), _code_of_today(maker.leaves_out)
    changed = {file for file in map(_file_of, now.modules(roots)) if file not in before or _differs(before[file], file)}
    if all(file in before for file in changed):
        return frozenset(changed)
    then = _code(before.get, maker.leaves_out)
    return frozenset() if _digests(then, roots) == _digests(now, roots) else frozenset(changed)  # some may have moved


def _blobs(*arguments: str) -> dict[str, str]:
    """Contents of files, by the names that Git has for them."""
    lines = _git(*arguments, "src", "reproduction", "benchmarks").decode().splitlines()
    return {line.split("\t")[1]: line.split("\t")[0].split()[2] for line in lines}


_read: dict[str, bytes] = {}
"""Contents of files by Git's names for them; most commits share most of theirs."""


def _contents(blobs: Mapping[str, str]) -> dict[str, bytes]:
    """Python files and what is in them: what was not read before is read at once."""
    files = {file: blob for file, blob in blobs.items() if file.endswith((".py", ".pyi"))}
    wanted = sorted({blob for blob in files.values() if blob not in _read})
    packed = memoryview(_git("cat-file", "--batch", given="\n".join(wanted).encode()) if wanted else b"")
    while packed:
        header, _, _ = bytes(packed[:100]).partition(b"\n")
        blob, _, size = header.decode().split()
        begin = len(header) + 1
        _read[blob] = bytes(packed[begin : begin + int(size)])
        packed = packed[begin + int(size) + 1 :]
    return {file: _read[blob] for file, blob in files.items()}


def _differs(then: bytes, file: str) -> bool:
    now = (ROOT / file).read_bytes()
    return then != now and _meaning(then) != _meaning(now)


@cache
def _meaning(content: bytes) -> str:
    return meaning(content)


def _roots(maker: Maker) -> list[str]:
    """The scripts and the modules of the command line that take part."""
    every = [path.stem for path in (ROOT / "src/cuspid/cli").glob("*.py")]
    verbs = every if "*" in maker.verbs else maker.verbs
    return [maker.script, *maker.runs, *(f"cuspid.cli.{verb}" for verb in verbs if verb != "__init__")]


def _code(read: Callable[[str], bytes | None], without: tuple[str, ...]) -> Code:
    """Modules of cuspid, and scripts of this folder, by the files that they are in."""

    def read_module(module: str) -> bytes | None:
        return next((text for file in _files(module) if (text := read(file)) is not None), None)

    return Code(read_module, without)


@cache
def _code_of_today(without: tuple[str, ...]) -> Code:
    return _code(_today, without)


def _digests(code: Code, modules: Sequence[str]) -> list[str] | None:
    try:
        return [code.digest(module) for module in modules]
    except LookupError:  # one of them is not there
        return None


def _files(module: str) -> tuple[str, ...]:
    """Where a module may be."""
    package, *inside = module.split(".")
    if package not in _SOURCES:
        return () if inside else (f"benchmarks/{module}.py",)
    path = "/".join((_SOURCES[package], package, *inside))
    return (f"{path}.py", f"{path}/__init__.py") if inside else (f"{path}/__init__.pyi",)


def _file_of(module: str) -> str:
    return next(file for file in _files(module) if _today(file) is not None)


def _today(file: str) -> bytes | None:
    path = ROOT / file
    return path.read_bytes() if path.is_file() else None


def _git(*arguments: str, given: bytes = b"") -> bytes:
    return subprocess.run(["git", "-C", str(ROOT), *arguments], check=True, capture_output=True, input=given).stdout
