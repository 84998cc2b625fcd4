"""Frames of a capture that is still being written: images appear in ``images/<camera>/<frame>.png``."""

from __future__ import annotations

from pathlib import Path

from cuspid.model.capture import Dropped, Frame, ImageFolder
from cuspid.model.rig import Handpiece
from cuspid.runtime.errors import InputError
from cuspid.runtime.image_files import read_image
from cuspid.storage.captures import IMAGE_SUFFIXES, folders_of_images
from cuspid.storage.files import list_finished

_State = tuple[int, int]
"""Size and time of modification of a file."""


class Arrivals:
    """Gives each frame once, when its images are whole, in the order of their names.

    An image is whole when it did not change between two looks and can be decoded. A frame of which images are missing
    is waited for as long as ``late_s`` after the first image of a later one, and then given with those that it has.
    What does not belong to the capture is refused before the first frame, and passed over once there is one.
    """

    def __init__(self, folder: Path, handpiece: Handpiece, *, late_s: float) -> None:
        self._images, self._folder, self._handpiece, self._late_s = folder / "images", folder, handpiece, late_s
        self._states = dict[Path, _State]()
        self._whole = dict[str, set[str]]()
        self._since = dict[str, float]()
        self._given = set[str]()
        self._refused = dict[Path, str]()
        self._strange = dict[str, str]()
        self._suffix: str | None = None

    @property
    def source(self) -> ImageFolder | None:
        """Where the images of the frames are; None before there is one."""
        return None if self._suffix is None else ImageFolder(self._folder, self._suffix)

    @property
    def left_out(self) -> tuple[Dropped, ...]:
        """The images that the frames so far do not have, and why."""
        idle, late = self._idle(), "its image came too late"
        why = {(path.stem, self._camera_of(path)): reason for path, reason in self._refused.items()}
        missing = [
            Dropped(what=f"camera {camera} of frame {name}", reason=why.get((name, camera), late))
            for name in sorted(self._given | {path.stem for path in self._refused})
            for camera in self._handpiece.rig.names
            if camera not in idle and camera not in self._whole.get(name, ())
        ]
        return (
            *(Dropped(what=what, reason=reason) for what, reason in self._strange.items()),
            *(Dropped(what=f"camera {camera}", reason="it has no images") for camera in idle),
            *missing,
        )

    def _idle(self) -> list[str]:
        """Cameras without a whole image so far."""
        seen = set[str]().union(*self._whole.values(), map(self._camera_of, self._refused))
        return [camera for camera in self._handpiece.rig.names if camera not in seen]

    def news(self, now_s: float) -> list[Frame]:
        """The frames that are whole by now and were not given before. Raises InputError where, before the first one,
        images are of a camera that the handpiece does not have, or of different types."""
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
        try:
            folders = folders_of_images(self._images) if self._images.is_dir() else set[str]()
            there = {camera: list_finished(self._images / camera) for camera in sorted(folders)}
        except InputError as error:  # a folder that is moved meanwhile, or closed to others
            self._pass_over(self._images, "not all of it can be entered", error)
            return
        for camera, paths in there.items():
            images = [path for path in paths if path.suffix.lower() in IMAGE_SUFFIXES]
            if camera in self._handpiece.rig.names:
                for path in images:
                    if path.stem not in self._given:
                        self._look_at(path, camera, now_s)
            elif images:
                names = ", ".join(self._handpiece.rig.names)
                self._pass_over(self._images / camera, f"the handpiece has no camera {camera}; its cameras are {names}")

    def _pass_over(self, path: Path, reason: str, error: InputError | None = None) -> None:
        if not self._given:
            raise error or InputError(f"{path}: {reason}")
        self._strange[str(path)] = reason

    def _camera_of(self, path: Path) -> str:
        return path.parent.relative_to(self._images).as_posix()

    def _look_at(self, path: Path, camera: str, now_s: float) -> None:
        stem = path.stem
        if camera in self._whole.get(stem, ()):
            return
        try:
            state = path.stat()
            before, self._states[path] = self._states.get(path), (state.st_size, state.st_mtime_ns)
            if before != self._states[path]:
                return
            read_image(path)
        except OSError:  # moved to its place meanwhile
            return
        except InputError as error:  # still being written, or damaged
            self._refused[path] = str(error)
            return
        self._refused.pop(path, None)
        if self._suffix not in (None, path.suffix):
            self._pass_over(path, f"the images before are {self._suffix} files; write all images in one type")
            return
        self._suffix = path.suffix
        self._whole.setdefault(stem, set()).add(camera)
        self._since.setdefault(stem, now_s)
