"""Tracks whose positions are those of one and the same patch: least squares matching (Gruen 1985).

A keypoint is found in each image separately, to a quarter of a pixel, and its error depends on the direction of view:
the errors of neighbouring images are therefore correlated, and the path bends. Once poses and points are approximately
known, the patch around each point, from the image whose direction of view is nearest to the mean, is projected into the
other images by the plane through the neighbouring points, and shifted until it fits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8
from scipy.spatial import cKDTree

from cuspid.model.reconstruction import Reconstruction, Tracks
from cuspid.motion.frontend.patches import AlignmentOptions, align_patches, cut_patches, smooth
from cuspid.runtime.options import Range
from cuspid.runtime.progress import Progress, silent
from cuspid.runtime.workers import map_in_threads

_NEIGHBOURS = 12
"""Number of points, including the point itself, that define the plane of a patch."""
_LEAST_COS = 0.35
"""Minimum cosine of the angle between a plane's normal and the ray of the patch; a plane seen more obliquely is not
trusted."""
_STEP_PX = 2.0
_STENCIL = _STEP_PX * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, -1], [1, -1], [-1, 1]])
"""The middle of a patch, and positions around it from which its warp is derived, to second order."""

_DECIMALS = 9
"""Decimals of the cosine that selects the image of a patch."""

Image = tuple[int, int]
"""Indices of a frame and of a camera."""
ReadGray = Callable[[str, str], UInt8[np.ndarray, "h w"]]
"""Reads the grey image of a frame and a camera, given their names."""


@dataclass(frozen=True, kw_only=True)
class LeastSquaresOptions(AlignmentOptions):
    """Accurate keypoint positions, from patches that are aligned once the poses are approximately known."""

    enabled: bool = True
    """Whether to refine keypoint positions at all."""
    radius_px: Annotated[int, Range(1, 100)] = 5
    """Half the width of a patch; the surface in a wide patch is not planar, which shifts it."""
    blur_px: Annotated[float, Range(0, 100)] = 0.8
    """Standard deviation of the Gaussian filter that is first applied to the images."""


@dataclass(frozen=True, eq=False)
class _Views:
    """Where all images were taken from."""

    found: Reconstruction
    rotations: Float[np.ndarray, "f c 3 3"]
    translations: Float[np.ndarray, "f c 3"]

    @staticmethod
    def of(found: Reconstruction) -> _Views:
        """``cam_from_world`` of every camera in every frame."""
        poses = [
            [each.cam_from_rig @ pose for each in found.rig.cameras.values()] for pose in found.rig_from_world.values()
        ]
        rotations = np.array([[pose.rotation for pose in row] for row in poses])
        return _Views(found, rotations, np.array([[pose.translation for pose in row] for row in poses]))

    def directions_to_cameras(self, tracks: Tracks) -> Float[np.ndarray, "o 3"]:
        """For each observation the unit vector from its point to the camera."""
        centres = -np.einsum("fcji,fcj->fci", self.rotations, self.translations)
        rays = centres[tracks.frame_index, tracks.camera_index] - tracks.points[tracks.point_index]
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def own_observations(tracks: Tracks, towards: Float[np.ndarray, "o 3"]) -> Int[np.ndarray, "p"]:
    """For each point that was seen, in the order of the points: the observation whose ray is nearest to the mean of its
    rays."""
    mean = np.zeros_like(tracks.points)
    np.add.at(mean, tracks.point_index, towards)
    along = np.einsum("oi,oi->o", towards, mean[tracks.point_index])
    # Two rays are as near to their mean as each other: the first is taken, not the one that rounding prefers.
    order = np.lexsort((tracks.camera_index, tracks.frame_index, -along.round(_DECIMALS), tracks.point_index))
    return np.asarray(order[np.unique(tracks.point_index[order], return_index=True)[1]])


def normals_of(points: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p 3"]:
    """Normals, of either sign, of the planes that best fit each point and its neighbours."""
    _, near = cKDTree(points).query(points, k=min(_NEIGHBOURS, len(points)))
    off = points[near.reshape(len(points), -1)]
    off = off - off.mean(axis=1, keepdims=True)
    return np.asarray(np.linalg.eigh(np.einsum("nki,nkj->nij", off, off))[1][:, :, 0])


class _Facets(NamedTuple):
    """What patches show."""

    own: Int[np.ndarray, "k"]
    """The observations that the patches are taken from, one for each point that was seen."""
    stencils: Float[np.ndarray, "p 9 3"]
    """The places of ``_STENCIL`` on the plane of the patch, in the world, mm."""


def _facets(views: _Views, tracks: Tracks) -> _Facets:
    own = own_observations(tracks, views.directions_to_cameras(tracks))
    normals, stencils = normals_of(tracks.points), np.zeros((len(tracks.points), len(_STENCIL), 3))
    for index, mounted in enumerate(views.found.rig.cameras.values()):
        mine = own[tracks.camera_index[own] == index]
        frame, point = tracks.frame_index[mine], tracks.point_index[mine]
        rotation, translation = views.rotations[frame, index], views.translations[frame, index]
        rays = mounted.camera.rays((tracks.pixels[mine, None] + _STENCIL).reshape(-1, 2)).reshape(-1, len(_STENCIL), 3)
        depth = np.einsum("ni,ni->n", rotation[:, 2], tracks.points[point]) + translation[:, 2]
        normal = np.einsum("nij,nj->ni", rotation, normals[point])
        middle = rays[:, 0] / np.linalg.norm(rays[:, 0], axis=1, keepdims=True)
        flat = np.abs(np.einsum("ni,ni->n", normal, middle)) < _LEAST_COS
        normal = np.where(flat[:, None], middle, normal)
        along = np.einsum("ni,nki->nk", normal, rays)
        inside = rays * (depth[:, None] * along[:, :1] / along)[..., None]
        stencils[point] = np.einsum("nji,nkj->nki", rotation, inside - translation[:, None])
    return _Facets(own, stencils)


def _group_by_image(tracks: Tracks, observations: Int[np.ndarray, "k"]) -> dict[Image, Int[np.ndarray, "_"]]:
    """Observations by their images."""
    frame, camera = tracks.frame_index[observations], tracks.camera_index[observations]
    order = np.lexsort((camera, frame))
    new = np.diff(frame[order], prepend=-1).astype(bool) | np.diff(camera[order], prepend=-1).astype(bool)
    parts = np.split(observations[order], np.flatnonzero(new)[1:])
    return {(int(tracks.frame_index[part[0]]), int(tracks.camera_index[part[0]])): part for part in parts if len(part)}


@dataclass(frozen=True, eq=False)
class _Matching:
    """What is laid over what."""

    views: _Views
    tracks: Tracks
    read: ReadGray
    options: AlignmentOptions

    def picture(self, image: Image) -> Float32[np.ndarray, "h w"]:
        """Of an image, smooth."""
        frame, camera = self.views.found.frames[image[0]], self.views.found.rig.names[image[1]]
        return smooth(self.read(frame, camera), self.options.blur_px)

    def patches(self, own: Int[np.ndarray, "k"]) -> Float32[np.ndarray, "p s s"]:
        """Of all points, from their own observations."""
        side = 2 * self.options.radius_px + 3
        patches = np.zeros((len(self.tracks.points), side, side), dtype=np.float32)
        parts = _group_by_image(self.tracks, own)

        def cut_part(part: tuple[Image, Int[np.ndarray, "_"]]) -> Float32[np.ndarray, "_ s s"]:
            return cut_patches(self.picture(part[0]), self.tracks.pixels[part[1]], self.options.radius_px)

        for mine, some in zip(parts.values(), map_in_threads(cut_part, parts.items()), strict=True):
            patches[self.tracks.point_index[mine]] = some
        return patches

    def lay(
        self,
        image: Image,
        others: Int[np.ndarray, "k"],
        patches: Float32[np.ndarray, "k s s"],
        stencils: Float[np.ndarray, "k 9 3"],
    ) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, "k"]]:
        """Where patches are in an image, and their correlation there."""
        inside = stencils @ self.views.rotations[image].T + self.views.translations[image]
        camera = tuple(self.views.found.rig.cameras.values())[image[1]].camera
        arms = camera.project(inside.reshape(-1, 3)).reshape(-1, len(_STENCIL), 2)
        warps = np.stack([arms[:, 1] - arms[:, 2], arms[:, 3] - arms[:, 4]], axis=-1) / (2 * _STEP_PX)
        bends = _perspective_bends(arms, self.options.radius_px)
        return align_patches(patches, self.picture(image), self.tracks.pixels[others], warps, self.options, bends)


def _perspective_bends(arms: Float[np.ndarray, "k 9 2"], radius_px: int) -> Float[np.ndarray, "k s 2"]:
    """What perspective adds to the linear warp at each pixel of a patch, to second order, px.

    Without it a patch is found where its pixels lie on the average, which between views that are tilted by an angle
    against each other is off by that angle times the mean square of the offsets over the focal length: 0.005 px at 12
    deg. That is always to the same side, and an arch opens.
    """
    middle, right, left, below, above, *diagonal = np.moveaxis(arms, 1, 0)
    both = (diagonal[0] + diagonal[1] - diagonal[2] - diagonal[3]) / 4
    second = np.stack([(right + left) / 2 - middle, both, (below + above) / 2 - middle], axis=1)
    y, x = np.mgrid[-radius_px : radius_px + 1, -radius_px : radius_px + 1].reshape(2, -1) / _STEP_PX
    return np.ascontiguousarray(np.einsum("kij,in->knj", second, np.stack([x * x, x * y, y * y])))


def match_patches(
    found: Reconstruction, read: ReadGray, options: AlignmentOptions, *, progress: Progress = silent
) -> Tracks:
    """The tracks of a reconstruction, which must have some, with positions where the patch of each point is found;
    observations in which it is not found, and points that are then seen nowhere else, are left out.

    ``read`` may be called twice for each image.
    """
    tracks = found.tracks
    assert tracks is not None
    matching = _Matching(_Views.of(found), tracks, read, options)
    facets = _facets(matching.views, tracks)
    patches = matching.patches(facets.own)

    def lay(part: tuple[Image, Int[np.ndarray, "_"]]) -> tuple[Float[np.ndarray, "_ 2"], Float[np.ndarray, "_"]]:
        point = tracks.point_index[part[1]]
        return matching.lay(*part, patches[point], facets.stencils[point])

    others = _group_by_image(tracks, np.setdiff1d(np.arange(len(tracks.point_index)), facets.own))
    laid = map_in_threads(lay, others.items(), stage="patches", progress=progress)
    pixels, correlation = tracks.pixels.copy(), np.ones(len(tracks.pixels))
    for observations, (places, alike) in zip(others.values(), laid, strict=True):
        pixels[observations], correlation[observations] = places, alike
    good = correlation > options.correlation
    good &= (np.bincount(tracks.point_index, weights=good) >= 2)[tracks.point_index]
    return replace(
        tracks,
        pixels=pixels[good],
        **{name: getattr(tracks, name)[good] for name in ("point_index", "frame_index", "camera_index")},
    )
