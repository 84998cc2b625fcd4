"""Turns photographs of one camera into a capture with located frames: the input of dense stereo.

A photograph is a frame that one camera took; the rig frame is that of the camera. Where the scale is unknown, all
lengths are in a unit of which the median distance of the surface has :data:`UNITS`, whatever the names of fields say,
and the result says so (``has_scale``).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from cuspid import storage
from cuspid.calibration.corners import find_corners
from cuspid.geometry import Rigid3
from cuspid.model.board import Board
from cuspid.model.capture import Capture, Frame
from cuspid.model.photographs import Photographs
from cuspid.model.reconstruction import Reconstruction
from cuspid.model.rig import Handpiece, MountedCamera, Rig
from cuspid.model.sparse_model import PhotoModel, Scale
from cuspid.motion.colmap import hash_sparse, write_model
from cuspid.motion.monocular.accuracy import expect_accuracy
from cuspid.motion.monocular.photograph_poses import take_photograph_poses
from cuspid.motion.monocular.photographs import PhotographOptions, locate_photographs
from cuspid.motion.monocular.scale import (
    BoardSighting,
    PhotoScaleOptions,
    PickedDistance,
    scale_by_board,
    scale_by_distances,
)
from cuspid.runtime.errors import InputError
from cuspid.runtime.image_files import full_range_grey
from cuspid.runtime.progress import Progress, silent
from cuspid.runtime.workers import map_in_threads
from cuspid.storage.reconstructions import RECONSTRUCTION_FILES
from cuspid.storage.stages import Stage

__all__ = [
    "UNITS",
    "LocatedPhotographs",
    "PhotoScaleOptions",
    "PhotographOptions",
    "depth_range",
    "find_scale",
    "locate",
    "to_capture",
]

UNITS = 100.0
"""Median distance of the surface from the cameras where the scale is unknown, in the unit that is then used."""
_NEAR_PCT, _FAR_PCT = 1.0, 99.0
_NEARER, _FARTHER = 0.9, 1.1
"""The range of depths is that of these percentiles of the sparse points, with a margin."""
_CODE = (__name__,)


@dataclass(frozen=True, eq=False, kw_only=True)
class LocatedPhotographs:
    """Photographs with their poses, as the dense stereo takes them."""

    capture: Capture
    """A frame for each photograph, with the camera that took it."""
    found: Reconstruction
    """Poses, the lens and the sparse points."""
    scale: Scale | None
    """What the millimetres are from; None where there are none."""


def locate(
    photographs: Photographs,
    folder: Path,
    options: PhotographOptions | None = None,
    scale: PhotoScaleOptions | None = None,
    *,
    colmap_model: Path | None = None,
    progress: Progress = silent,
) -> LocatedPhotographs:
    """Locate photographs, found once and kept in ``folder``: a COLMAP model, poses, ``handpiece.json``, ``scale.json``
    and the sparse points as ``points.ply``. With a COLMAP model, its poses are taken instead of found."""
    options, scale = options or PhotographOptions(), scale or PhotoScaleOptions()
    settings = {"options": options, "scale": scale, "poses": colmap_model is not None}
    stage = Stage("photographs", folder, settings, _CODE)
    inputs = storage.hash_photographs(photographs)
    if colmap_model is not None:
        inputs["model"] = hash_sparse(colmap_model)

    def write() -> None:
        if colmap_model is None:
            model = locate_photographs(photographs, options, progress=progress)
        else:
            model = take_photograph_poses(photographs, colmap_model, options, progress=progress)
        _write(folder, to_capture(model, photographs, find_scale(model, photographs, scale, progress=progress)))

    names = (*RECONSTRUCTION_FILES, "scale.json", "points.ply")
    stage.make(inputs, [folder / name for name in names], write)
    return _read_poses(folder, photographs)


def find_scale(
    model: PhotoModel, photographs: Photographs, options: PhotoScaleOptions, *, progress: Progress = silent
) -> Scale | None:
    """What sets the scale; None where nothing does: a board before distances."""
    board = options.board
    if board is not None:
        sightings = _sightings(photographs, board, progress)
        return scale_by_board(model, sightings, board, len(photographs.names))
    if options.distance:
        return scale_by_distances(model, _picked_distances(options, photographs))
    return None


def to_capture(model: PhotoModel, photographs: Photographs, scale: Scale | None) -> LocatedPhotographs:
    """A model as a capture and its reconstruction, in millimetres, or without a scale."""
    own = model.scaled(UNITS / float(np.median(model.depths)) if scale is None else scale.mm_per_unit)
    rig = Rig({name: MountedCamera(camera, Rigid3.identity()) for name, camera in own.cameras.items()})
    near, middle, far = depth_range(own.depths)
    handpiece = Handpiece(
        rig=rig, working_distance_mm=middle, depth_range_mm=(near, far), name=photographs.source.name or "photographs"
    )
    capture = _capture(photographs, handpiece, own)
    held = frozenset(name for name in own.cameras if _is_calibrated(photographs, name))
    found = Reconstruction(
        rig=rig,
        expectation=expect_accuracy(own, 0.0 if scale is None else scale.sigma_share, held),
        rig_from_world=own.cam_from_world,
        tracks=own.tracks,
        dropped=own.dropped,
        reprojection_rms_px=own.reprojection_rms_px,
        has_scale=scale is not None,
        log=own.log,
        notes=(*own.notes, *(() if scale is None else scale.notes)),
    )
    return LocatedPhotographs(capture=capture, found=found, scale=scale)


def _is_calibrated(photographs: Photographs, camera: str) -> bool:
    return camera in photographs.cameras and photographs.cameras[camera].calibrated is not None


def depth_range(depths: Float[np.ndarray, "n"]) -> tuple[float, float, float]:
    """Nearest, median and farthest depth of a surface, from those of its sparse points, a few of which are wrong."""
    near, middle, far = np.percentile(depths[depths > 0], [_NEAR_PCT, 50.0, _FAR_PCT])
    return _NEARER * float(near), float(middle), _FARTHER * float(far)


def _capture(photographs: Photographs, handpiece: Handpiece, model: PhotoModel) -> Capture:
    """The located photographs, for the lens of the others may be unknown."""
    frames = tuple(Frame(name=name, cameras=(model.camera_of[name],)) for name in model.frames)
    return Capture(handpiece=handpiece, frames=frames, source=photographs, left_out=photographs.left_out)


def _sightings(photographs: Photographs, board: Board, progress: Progress) -> list[BoardSighting]:
    """The board in every photograph that shows it."""

    def find(name: str) -> BoardSighting | None:
        try:
            image = photographs.read(name, "")
        except InputError:  # it is among the dropped
            return None
        view = find_corners(full_range_grey(image), board)
        return None if view is None else BoardSighting(frame=name, corner=view.corner, pixels=view.pixels)

    found = map_in_threads(find, photographs.names, stage="board", progress=progress)
    return [each for each in found if each is not None]


def _picked_distances(options: PhotoScaleOptions, photographs: Photographs) -> list[PickedDistance]:
    """The distances of the command line, whose places are px of the upright pictures."""
    assert options.between is not None
    taken = [photographs[name] for name in options.between]
    picked = []
    for *places, mm in options.distances:
        upright = np.array(places, dtype=np.float64).reshape(2, 2, 2)
        pixels = np.stack([[each.in_sensor(end) for end in two] for each, two in zip(taken, upright, strict=True)])
        picked.append(PickedDistance(frames=(taken[0].name, taken[1].name), pixels=pixels, mm=mm))
    return picked


def _write(folder: Path, located: LocatedPhotographs) -> None:
    capture, found, scale = located.capture, located.found, located.scale
    source = capture.source
    assert isinstance(source, Photographs)
    write_model(folder / "sparse", found, capture, {name: source[name].path.name for name in found.frames})
    if found.tracks is not None:
        comment = "lengths in mm" if found.has_scale else storage.NO_SCALE
        storage.write_points(folder / "points.ply", found.tracks.points, found.tracks.colors, comment)
    record = {"scale": "unknown"} if scale is None else {"scale": "known", **asdict(scale)}
    storage.write_json(folder / "scale.json", record)
    storage.write_reconstruction(folder, found, capture.handpiece)


def _read_poses(folder: Path, photographs: Photographs) -> LocatedPhotographs:
    found, value = storage.read_reconstruction(folder), storage.read_json(folder / "scale.json")
    with storage.reading(folder / "scale.json"):
        fields = {name: each for name, each in value.items() if name != "scale"}
        scale = None if value["scale"] == "unknown" else Scale(**{**fields, "notes": tuple(fields["notes"])})
    handpiece = replace(storage.read_handpiece(folder / "handpiece.json"), rig=found.rig)
    frames = tuple(Frame(name=name, cameras=(_camera_of(found, name, photographs),)) for name in found.frames)
    capture = Capture(handpiece=handpiece, frames=frames, source=photographs, left_out=photographs.left_out)
    return LocatedPhotographs(capture=capture, found=found, scale=scale)


def _camera_of(found: Reconstruction, name: str, photographs: Photographs) -> str:
    """The camera that took a located photograph; given poses may tell apart what its size and EXIF do not."""
    own = photographs[name].camera
    if own in found.rig.names or found.tracks is None:
        return own
    seen = found.tracks.camera_index[found.tracks.frame_index == found.frames.index(name)]
    return found.rig.names[int(seen[0])]
