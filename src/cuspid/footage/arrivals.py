"""Frames of a capture that is still being written: images appear in ``images/<camera>/<frame>.png``."""

from __future__ import annotations

from pathlib import Path

from cuspid.capture import Dropped, Frame, ImageFolder, image_size
from cuspid.errors import InputError
from cuspid.rig import Handpiece
from cuspid.storage.captures import IMAGE_SUFFIXES
from cuspid.storage.files import is_meant

_State = tuple[int, int]
"""Size and time of modification of a file."""


class Arrivals:
    """Gives each frame once, when its images are whole, in the order of their names.

    An image is whole when it did not change between two looks and its header can be read. A frame of which images are
    missing is waited for as long as ``late_s`` after the first image of a later one, and then given with those that
    it has.
    """

    def __init__(self, folder: Path, handpiece: Handpiece, *, late_s: float) -> None:
        self._images, self._folder, self._handpiece, self._late_s = folder / "images", folder, handpiece, late_s
        self._states = dict[Path, _State]()
        self._whole = dict[str, set[str]]()
        self._since = dict[str, float]()
        self._given = set[str]()
        self._refused = dict[Path, str]()
        self._suffix: str | None = None

    @property
    def source(self) -> ImageFolder | None:
        """Where the images of the frames are; None before there is one."""
        return None if self._suffix is None else ImageFolder(self._folder, self._suffix)

    @property
    def left_out(self) -> tuple[Dropped, ...]:
        """The images that the frames so far do not have, and why."""
        idle, late = self._idle(), "its image came too late"
        why = {(path.stem, path.parent.name): reason for path, reason in self._refused.items()}
        missing = [
            Dropped(what=f"camera {camera} of frame {name}", reason=why.get((name, camera), late))
            for name in sorted(self._given | {path.stem for path in self._refused})
            for camera in self._handpiece.rig.names
            if camera not in idle and camera not in self._whole.get(name, ())
        ]
        return (*(Dropped(what=f"camera {camera}", reason="it has no images") for camera in idle), *missing)

    def _idle(self) -> list[str]:
        """Cameras without a whole image so far."""
        seen = set[str]().union(*self._whole.values(), {path.parent.name for path in self._refused})
        return [camera for camera in self._handpiece.rig.names if camera not in seen]

    def news(self, now_s: float) -> list[Frame]:
        """The frames that are whole by now and were not given before. Raises InputError where images are of a camera
        that the handpiece does not have, or of different types."""
        self._look(now_s)
        return self._take(now_s, self._late_s)

    def rest(self) -> list[Frame]:
        """What is left at the end, with the images that there are."""
        self._look(float("inf"))
        return self._take(float("inf"), -1.0)

    def _take(self, now_s: float, late_s: float) -> list[Frame]:
        idle = set(self._idle()) if self._given else set[str]()
        found = list[Frame]()
        for name in sorted(self._whole.keys() - self._given):
            complete = self._whole[name] | idle >= set(self._handpiece.rig.names)
            later = [since for other, since in self._since.items() if other > name]
            if not complete and late_s >= 0 and not (later and now_s - min(later) > late_s):
                break
            self._given.add(name)
            cameras = tuple(camera for camera in self._handpiece.rig.names if camera in self._whole[name])
            found.append(Frame(name=name, cameras=cameras, lighting=self._handpiece.only_lighting))
        return found

    def _look(self, now_s: float) -> None:
        for folder in sorted(path for path in self._images.glob("*") if path.is_dir() and is_meant(path)):
            if folder.name not in self._handpiece.rig.names:
                raise InputError(
                    f"{folder}: the handpiece has no camera {folder.name}; its cameras are "
                    f"{', '.join(self._handpiece.rig.names)}"
                )
            for path in folder.iterdir():
                if is_meant(path) and path.suffix.lower() in IMAGE_SUFFIXES and path.stem not in self._given:
                    self._look_at(path, now_s)

    def _look_at(self, path: Path, now_s: float) -> None:
        camera, stem = path.parent.name, path.stem
        if camera in self._whole.get(stem, ()):
            return
        try:
            state = path.stat()
            before, self._states[path] = self._states.get(path), (state.st_size, state.st_mtime_ns)
            if before != self._states[path]:
                return
            image_size(path)
        except OSError:  # moved to its place meanwhile
            return
        except InputError as error:  # still being written, or damaged
            self._refused[path] = str(error)
            return
        self._refused.pop(path, None)
        if self._suffix not in (None, path.suffix):
            raise InputError(f"{path}: the images before are {self._suffix} files; write all images in one type")
        self._suffix = path.suffix
        self._whole.setdefault(stem, set()).add(camera)
        self._since.setdefault(stem, now_s)
