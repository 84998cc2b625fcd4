"""Stages: results on disk that are used again only where they are still those of what made them.

What makes a result has a key: SHA-256 over the name of the stage, its options, the contents of its inputs and what the
code does.
A folder of results keeps ``made.jsonl``, a line for each file with the key that it was made under and the SHA-256 of
its contents. A file with another key, or with other contents, is made again.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files as package_files
from pathlib import Path
from threading import Lock

from cuspid.runtime.errors import InputError, OutputError
from cuspid.runtime.inputs import read_bytes
from cuspid.storage.code_digest import PACKAGE, Code
from cuspid.storage.files import digest_of, hash_file, open_to_append

RECORD = "made.jsonl"
"""Name of the file that records what a folder's results were made from."""

_log = logging.getLogger("cuspid")


@cache
def _installed_code() -> Code:
    """The modules of cuspid as they are installed."""
    root = Path(str(package_files(PACKAGE)))

    def read(module: str) -> bytes | None:
        package, *inside = module.split(".")
        if package != PACKAGE:
            return None
        path = root.joinpath(*inside)
        file = path / f"__init__.py{'' if inside else 'i'}" if path.is_dir() else path.with_suffix(".py")
        return file.read_bytes() if file.is_file() else None

    return Code(read)


@cache
def code_version(*modules: str) -> str:
    """What some modules do, and those that they import: see :mod:`cuspid.storage.code_digest`."""
    return digest_of([_installed_code().digest(module) for module in modules])


@dataclass(frozen=True, eq=False)
class Stage:
    """One kind of results, and the folder that they are kept in."""

    name: str
    """What is made, for people: ``depth``."""
    folder: Path
    """Where ``made.jsonl`` lies."""
    options: object
    """How it is made."""
    code: tuple[str, ...] = ()
    """The modules of cuspid that make it, as ``__name__``; those that they import count, too."""
    _version: str = field(init=False, repr=False)
    _made: dict[str, tuple[str, str]] = field(init=False, repr=False)
    _lock: Lock = field(init=False, repr=False, default_factory=Lock)

    def __post_init__(self) -> None:
        """Raises InputError where ``made.jsonl`` is there and no file."""
        object.__setattr__(self, "_version", code_version(*self.code))  # here, or every thread would read all modules
        object.__setattr__(self, "_made", _read_record(self.folder / RECORD))

    def key(self, inputs: Mapping[str, str]) -> str:
        """What identifies a result that is made from inputs, given by their digests."""
        return digest_of([self.name, self.options, inputs, self._version])

    def has(self, key: str, files: Sequence[Path]) -> bool:
        """Whether all of the files are there as they were made under a key."""
        return all(self._made.get(self._name(file)) == (key, _digest(file)) for file in files)

    def make(self, inputs: Mapping[str, str], files: Sequence[Path], write: Callable[[], None]) -> str:
        """Call ``write``, which writes the files, unless they are there already from the same inputs; their key.

        Raises OutputError where they cannot be recorded.
        """
        key = self.key(inputs)
        if not self.has(key, files):
            stale = [file for file in files if file.exists() and self._name(file) in self._made]
            if stale:
                _log.info(f"{stale[0]}: {self._rerun_reason(stale[0], key)}; making it again")
            write()
            self.record(key, files)
        return key

    def record(self, key: str, files: Sequence[Path]) -> None:
        """Keep that files, which are there, were made under a key. Raises OutputError."""
        entries = {self._name(file): (key, _digest(file)) for file in files}
        lines = "".join(json.dumps([name, *entry]) + "\n" for name, entry in entries.items())
        try:
            with self._lock, open_to_append(self.folder / RECORD) as stream:
                stream.write(lines.encode())
        except OSError as error:
            _remove_empty(self.folder / RECORD)
            raise OutputError(f"{self.folder / RECORD}: cannot be written ({error.strerror})") from error
        self._made.update(entries)

    def _name(self, file: Path) -> str:
        return os.path.relpath(file, self.folder)

    def _rerun_reason(self, file: Path, key: str) -> str:
        made_under, contents = self._made[self._name(file)]
        return (
            "made from other inputs, options or code" if made_under != key or contents == _digest(file) else "damaged"
        )


def _digest(file: Path) -> str:
    """SHA-256 of a file, empty where there is none."""
    try:
        return hash_file(file)
    except InputError:
        return ""


def _remove_empty(file: Path) -> None:
    with suppress(OSError):
        if file.stat().st_size == 0:
            file.unlink()


def _read_record(path: Path) -> dict[str, tuple[str, str]]:
    """Key and contents by file; what a killed run left unfinished does not count, later lines go before earlier."""
    made: dict[str, tuple[str, str]] = {}
    if not path.exists():
        return made
    for line in read_bytes(path, "text").decode(errors="replace").splitlines():
        try:
            name, key, contents = json.loads(line)
        except (ValueError, TypeError):
            continue
        made[str(name)] = (str(key), str(contents))
    return made
