"""Files that appear whole or not at all, and the record of what a folder was made from."""

from __future__ import annotations

import csv
import dataclasses
import errno
import hashlib
import json
import math
import os
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import UnionType
from typing import Any, BinaryIO, TypeVar, Union, get_args, get_origin, get_type_hints
from zipfile import ZipFile

import numpy as np
from jaxtyping import jaxtyped

import cuspid
from cuspid.runtime.errors import CuspidError, InputError, OutputError
from cuspid.runtime.inputs import LARGEST_MIB, read_text, require_file
from cuspid.runtime.values import one_line, quote

_Made = TypeVar("_Made")
_UNUSABLE = (ValueError, TypeError, AttributeError, IndexError, OverflowError, csv.Error, np.linalg.LinAlgError)
"""What is raised where a parsed value is of another kind than it should be."""
PART = ".part-"
"""How the names of unfinished files begin; a killed run leaves them behind, and nothing reads them."""


_NOT_FOR_US = ("@eaDir", "__MACOSX", "Thumbs.db", "desktop.ini", "lost+found")
"""What systems put beside files, without a dot."""


def list_finished(folder: Path) -> list[Path]:
    """What is in a folder, without the unfinished files of a killed run and what is hidden, as systems put it beside
    the files of people. Raises InputError where the folder may not be entered."""
    try:
        return [path for path in folder.iterdir() if is_meant(path)]
    except OSError as error:
        raise InputError(f"{folder}: cannot be entered ({error.strerror or error}); change its permissions") from error


def is_meant(path: Path) -> bool:
    """Whether a file or folder is one that people put there."""
    return not path.name.startswith(".") and path.name not in _NOT_FOR_US


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A temporary path beside ``path`` that takes its place when the block ends well.

    Raises OutputError where the disk is full, read-only or the folder cannot be made.
    """
    temporary: Path | None = None
    try:
        with _writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            handle, name = tempfile.mkstemp(dir=path.parent, prefix=PART, suffix=path.suffix)
            os.close(handle)
            temporary = Path(name)
            temporary.chmod(0o644)
            yield temporary
            temporary.replace(path)
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


@contextmanager
def whole_files(folder: Path) -> Iterator[Path]:
    """As :func:`whole_file`, for several files: a temporary folder whose files move into ``folder``."""
    with _writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=PART) as temporary:
            yield Path(temporary)
            for file in sorted(Path(temporary).iterdir()):
                file.replace(folder / file.name)


def open_to_append(path: Path) -> BinaryIO:
    """A file to add to. Raises OutputError where it cannot be written, or what is added would go elsewhere."""
    if path.is_symlink() or (path.exists() and not path.is_file()):
        raise OutputError(f"{path}: is a link, a folder, a pipe or a device, and no file; delete it")
    with _writing(path):
        return path.open("ab")


class AppendedTable:
    """A CSV table that grows by whole lines, so that one of a killed run can be read; threads may share it."""

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        """A new table. Raises OutputError where it cannot be written."""
        self._path, self._lock = path, threading.Lock()
        self._stream = open_to_append(path)
        self.add(*columns)

    def __enter__(self) -> AppendedTable:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):  # whether it could be written was told line by line
            self._stream.close()

    def add(self, *values: str) -> None:
        """Add a line. Raises OutputError where the disk is full; no part of the line is left then."""
        line = (",".join(values) + "\n").encode()
        with self._lock, _writing(self._path):
            before = os.fstat(self._stream.fileno()).st_size
            try:
                if os.write(self._stream.fileno(), line) < len(line):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            except OSError:
                os.ftruncate(self._stream.fileno(), before)
                raise


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Turn what the system says against a file or folder into one clear line."""
    try:
        yield
    except OSError as error:
        raise OutputError(_describe(path, error)) from error


def _describe(path: Path, error: OSError) -> str:
    if error.errno == errno.ENOSPC:
        return f"{path}: the disk is full; free some space and run the same command again to continue"
    return f"{path}: cannot be written ({error.strerror or error}); choose another --out"


def require_suffix(path: Path, *suffixes: str) -> None:
    """Raise OutputError where a file that is to be written has the name of another kind."""
    if path.suffix.lower() not in suffixes:
        choices = " or ".join(suffixes)
        raise OutputError(f"{path}: has no suffix that can be written; give a name that ends in {choices}")


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file whole or not at all."""
    with whole_file(path) as temporary:
        temporary.write_bytes(data)


def write_json(path: Path, value: object) -> None:
    """Write JSON whole or not at all; dataclasses, arrays and paths are converted."""
    write_bytes(path, (json.dumps(to_plain(value), indent=2, allow_nan=False) + "\n").encode())


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray], *, compressed: bool = False) -> None:
    """Write arrays by name as NumPy's ``.npz``, whole or not at all."""
    save = np.savez_compressed if compressed else np.savez
    with whole_file(path) as temporary, temporary.open("wb") as stream:
        save(stream, allow_pickle=False, **arrays)


def read_arrays(path: Path, *, remedy: str) -> dict[str, np.ndarray]:
    """The arrays of an ``.npz`` by name. Raises InputError, which names the remedy, where it is missing or damaged."""
    try:
        require_file(path, "arrays")
        with ZipFile(path) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > LARGEST_MIB["arrays"] << 20:
                raise ValueError("larger than the limit when unpacked")
        with np.load(path, allow_pickle=False) as stored:
            return {name: stored[name] for name in stored}
    except InputError as error:
        raise InputError(f"{error}; {remedy}") from error
    except Exception as error:  # zipfile and NumPy raise whatever they meet, from KeyError to MemoryError
        raise InputError(f"{path}: damaged ({type(error).__name__}: {one_line(error)}); {remedy}") from error


def to_plain(value: Any, path: Callable[[Path], str | None] = str) -> Any:
    """A value as JSON knows it; numbers that are not finite become null, paths what ``path`` makes of them."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_plain(getattr(value, field.name), path) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): to_plain(item, path) for key, item in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [to_plain(item, path) for item in value]
    if isinstance(value, np.generic):
        return to_plain(value.item())
    if isinstance(value, Path):
        return path(value)
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def read_json(path: Path) -> Any:
    """Parse a JSON file. Raises InputError where it is missing or broken."""
    try:
        value = json.loads(read_text(path))
    except ValueError as error:
        raise InputError(f"{path}: not valid JSON ({error})") from error
    except RecursionError as error:
        raise InputError(f"{path}: not valid JSON (nested too deep)") from error
    _require_finite(path, value)
    return value


def _require_finite(path: Path, value: object) -> None:
    """Python reads NaN, the infinities and 1e999, which are no numbers of JSON."""
    left = [("", value)]
    while left:
        where, each = left.pop()
        if isinstance(each, dict):
            left += [(f"{where}.{key}", inner) for key, inner in each.items()]
        elif isinstance(each, list):
            left += [(f"{where}[{k}]", inner) for k, inner in enumerate(each)]
        elif isinstance(each, float) and not math.isfinite(each):
            raise InputError(f"{path}: {where[1:]} is {each}; a number must be finite")


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn what a malformed value in a parsed file, or in the files of a folder, raises into one clear line."""
    try:
        yield
    except InputError as error:
        if str(path) in str(error):
            raise
        raise InputError(f"{path}: {error}") from error
    except CuspidError:
        raise
    except KeyError as error:
        raise InputError(f"{path}: the field {error} is missing; see docs/formats.md") from error
    except _UNUSABLE as error:
        raise InputError(f"{path}: a value cannot be used ({one_line(error)}); see docs/formats.md") from error


def digest_of(value: object) -> str:
    """SHA-256 of a value as JSON: options, arrays and mappings alike."""
    return hashlib.sha256(json.dumps(to_plain(value), sort_keys=True).encode()).hexdigest()


def hash_file(path: Path) -> str:
    """SHA-256 of a file's contents. Raises InputError where it is no regular file or cannot be read."""
    try:
        with require_file(path, "file").open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def read_manifest(folder: Path) -> dict[str, Any]:
    """``run.json`` of a folder, by stage; empty where there is none. Raises InputError where it is broken."""
    path = folder / "run.json"
    found = read_json(path) if path.exists() else {}
    if not isinstance(found, dict) or not all(isinstance(entry, dict) for entry in found.values()):
        raise InputError(f"{path}: not written by cuspid; see docs/formats.md")
    return found


def claim_folder(
    folder: Path, stage: str, settings: Mapping[str, object], inputs: Mapping[str, str], *, replace: bool = False
) -> Mapping[str, object]:
    """Make ``folder`` the home of one run of a stage, or find that it is already; what is kept of the run.

    ``run.json`` keeps for each stage the version, the settings and the hashes of the inputs. Of files that the settings
    name only the contents count, which are among the inputs. Raises OutputError where the folder holds files that no
    run of cuspid wrote, or the same stage made from something else; where that may be replaced, since it is made again
    as a whole, ``run.json`` stays as it is.
    """
    plain = to_plain(settings, path=lambda _: None)
    entry = {"cuspid": cuspid.__version__, "settings": plain, "inputs_sha256": to_plain(inputs)}
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: is a file; give a folder as --out")
    manifest = read_manifest(folder)
    if not manifest and folder.exists() and list_finished(folder):
        raise OutputError(f"{folder}: holds files that are not from cuspid; give an empty or new folder as --out")
    if stage in manifest and manifest[stage] != entry and not replace:
        changed = _first_difference(manifest[stage], entry)
        raise OutputError(
            f"{folder}: holds another run of '{stage}' ({changed} differs); give another --out or delete the folder"
        )
    if stage not in manifest:
        _enter(folder, stage, entry)
    return entry


def _enter(folder: Path, stage: str, entry: Mapping[str, object]) -> None:
    write_json(folder / "run.json", {**read_manifest(folder), stage: entry})


@contextmanager
def claimed_folder(
    folder: Path, stage: str, settings: Mapping[str, object], inputs: Mapping[str, str], *, replace: bool = False
) -> Iterator[None]:
    """:func:`claim_folder` for the work in the block. Leaves no trace where the work is refused before it wrote;
    results that are to be replaced stay those of the run that made them until the work is done."""
    existed = folder.exists()
    empty = not folder.is_dir() or not any(folder.iterdir())
    with _lock_folder(folder):
        try:
            entry = claim_folder(folder, stage, settings, inputs, replace=replace)
            yield
        except (CuspidError, OSError, MemoryError):
            if empty and folder.is_dir() and {path.name for path in folder.iterdir()} <= {"run.json"}:
                (folder / "run.json").unlink(missing_ok=True)
                if not existed:
                    folder.rmdir()
            raise
        if read_manifest(folder).get(stage) != entry:
            _enter(folder, stage, entry)


_held: Counter[Path] = Counter()
_holding = threading.Lock()
"""The folders in which this process works, and how often it has claimed each."""


_PATIENCE_S = 2.0
"""How long a run waits for a folder: the processes of one that was killed end with what they had begun."""


@contextmanager
def _lock_folder(folder: Path) -> Iterator[None]:
    """No other process works in a folder in the block, which is made if need be. Raises OutputError where one does.

    The folder itself is locked (flock), so that no file is left, and the lock of a process that ends ends with it;
    where folders cannot be locked, as on Windows, nothing is.
    """
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: is a file; give a folder as --out")
    with _writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        place = folder.resolve()
    with _holding:
        _held[place] += 1
        first = _held[place] == 1
    try:
        with ExitStack() as stack:
            if first:
                _lock(folder, stack)
            yield
    finally:
        with _holding:
            _held[place] -= 1


def _lock(folder: Path, stack: ExitStack) -> None:
    try:
        import fcntl

        descriptor = os.open(folder, os.O_RDONLY)
    except (ImportError, OSError):
        return
    stack.callback(os.close, descriptor)
    patient_until = time.monotonic() + _PATIENCE_S
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            if time.monotonic() > patient_until:
                raise OutputError(
                    f"{folder}: another run of cuspid works there; wait until it has ended, or give another --out"
                ) from error
            time.sleep(0.05)
        except OSError:  # a file system without locks
            return
        else:
            return


def _first_difference(old: Any, new: Any, name: str = "") -> str:
    if isinstance(old, dict) and isinstance(new, dict):
        for key in {**old, **new}:
            if old.get(key) != new.get(key):
                return _first_difference(old.get(key), new.get(key), f"{name}.{key}" if name else key)
    return name or "it"


@jaxtyped(typechecker=None)
def as_declared(kind: Callable[..., _Made], /, **values: Any) -> _Made:
    """A value of a class of ours from what a file holds. Raises InputError where a field is not of the type that the
    class declares for it, or an array not of the shape: axes of one name are alike."""
    hints = get_type_hints(kind)
    for name, value in values.items():
        if name not in hints:
            raise InputError(f"unknown field '{name}'; see docs/formats.md")
        if not _fits(value, hints[name]):
            found = f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else quote(value)
            raise InputError(f"the field '{name}' cannot be {found}; see docs/formats.md")
        if isinstance(value, int) and float in (hints[name], *get_args(hints[name])):
            values[name] = float(value)
    return kind(**values)


def _fits(value: object, hint: Any) -> bool:
    """Whether a value is of an annotated type; numbers must be finite, and whole ones may stand for others."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return any(_fits(value, each) for each in arguments)
    if origin is tuple:
        return isinstance(value, tuple) and all(_fits(each, arguments[0]) for each in value)
    if hint in (int, float):
        whole = isinstance(value, int) and not isinstance(value, bool)
        return whole or (hint is float and isinstance(value, float) and math.isfinite(value))
    return isinstance(value, origin or hint)
