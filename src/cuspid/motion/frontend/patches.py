"""Tracks of one camera, followed by patch alignment into the frames where none of their keypoints was found.

Keypoints on plain enamel come and go: their tracks are short and their positions uncertain by about a pixel, so an arch
bends. Once the poses are known, the patch around each point, from the frame that shows it nearest to the image centre,
is projected into the neighbouring frames where it should be seen, and shifted until it fits (Lucas and Kanade 1981,
with the template's gradients, Baker and Matthews 2004; gain, offset and slope of the light are free). It is projected
as a plane that faces its camera, or, once the surface is known, as that: crowns turn away from the camera within a
patch, and what is laid over them as a plane slides.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import Annotated, NamedTuple, no_type_check

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from cuspid.geometry import Rigid3, unit
from cuspid.model.camera import OPENCV_PIXEL_OFFSET, Camera
from cuspid.model.mesh import Mesh
from cuspid.model.reconstruction import Reconstruction, Tracks, concatenate_tracks, select_tracks
from cuspid.model.sparse_model import SparseModel
from cuspid.motion.frontend.tracks import points_across
from cuspid.runtime.kernels import kernel
from cuspid.runtime.options import Options, Range
from cuspid.runtime.progress import Progress, silent
from cuspid.runtime.workers import map_in_threads

_LEAST_CONTRAST = 0.5
"""Standard deviation of the grey levels of a patch, below which it carries no information."""
_LEAST_AREA = 1e-3
"""Smallest area of the image of a patch, as a share of its own, that can be aligned."""
_STILL_PX = 0.003
"""The alignment ends when a step is shorter than this."""
_FLAT = np.zeros((0, 0, 2))
"""No bends."""
_BLOCK = 8
"""Images whose points are followed at a time."""
_HIDDEN = 0.01
"""A place is occluded where something stands before it by more than this share of its distance."""


@dataclass(frozen=True, kw_only=True)
class AlignmentOptions(Options):
    """How patches are aligned, and what counts as found."""

    radius_px: Annotated[int, Range(1, 100)] = 7
    """Half the width of a patch."""
    blur_px: Annotated[float, Range(0, 100)] = 1.0
    """Standard deviation of the Gaussian filter that is first applied to the images."""
    limit_px: Annotated[float, Range(0.01, 1000)] = 3.0
    """Largest distance from the predicted position."""
    correlation: Annotated[float, Range(-1, 1)] = 0.85
    """Minimum correlation (-1 to 1) between the patch and the place where it is found."""
    iterations: Annotated[int, Range(1, 10_000)] = 15
    """Maximum number of steps of an alignment."""


@dataclass(frozen=True, kw_only=True)
class PatchOptions(AlignmentOptions):
    """Which patches are followed, and what counts as found."""

    reach: Annotated[int, Range(1, 10_000)] = 12
    """A patch is searched for in this many frames before and after its own."""
    turn_deg: Annotated[float, Range(0, 180)] = 40.0
    """Frames whose direction of view differs by more than this are skipped."""
    min_views: Annotated[int, Range(2, 1000)] = 4
    """Points that are found in fewer frames are left unchanged."""


def smooth(picture: UInt8[np.ndarray, "h w"], sigma_px: float) -> Float32[np.ndarray, "h w"]:
    """Grey levels, smoothed against the noise of single pixels."""
    levels = picture.astype(np.float32)
    return levels if sigma_px == 0 else np.asarray(cv2.GaussianBlur(levels, (0, 0), sigma_px))


@kernel
@no_type_check
def _sample_bilinear(image, x, y):
    """Bilinear; NaN outside."""
    height, width = image.shape
    if not (0 <= x < width - 1 and 0 <= y < height - 1):
        return np.nan
    i, j = int(x), int(y)
    a, b = x - i, y - j
    top = (1 - a) * image[j, i] + a * image[j, i + 1]
    return (1 - b) * top + b * ((1 - a) * image[j + 1, i] + a * image[j + 1, i + 1])


@kernel
@no_type_check
def _cut_patch(image, places, patches):
    """Fill in the levels around places; NaN outside."""
    side = patches.shape[1]
    for n in range(len(places)):
        for j in range(side):
            for i in range(side):
                patches[n, j, i] = _sample_bilinear(image, places[n, 0] + i - side // 2, places[n, 1] + j - side // 2)


@kernel
@no_type_check
def _flatten(levels, radius):
    """Take the plane that fits the levels of a patch best out of them: offset and slope of the light."""
    total = across = down = square = 0.0
    k = 0
    for dy in range(-radius, radius + 1):
        for dx in range(-radius, radius + 1):
            total += levels[k]
            across += dx * levels[k]
            down += dy * levels[k]
            square += dx * dx
            k += 1
    total, across, down = total / k, across / square, down / square
    k = 0
    for dy in range(-radius, radius + 1):
        for dx in range(-radius, radius + 1):
            levels[k] -= total + across * dx + down * dy
            k += 1


@kernel
@no_type_check
def _template(patch, levels, slopes):
    """Fill in the levels of a patch less the plane through them, and their slopes; their standard deviation, NaN where
    it reaches over the border."""
    k, side = 0, len(patch)
    for j in range(1, side - 1):
        for i in range(1, side - 1):
            levels[k] = patch[j, i]
            slopes[k, 0] = (patch[j, i + 1] - patch[j, i - 1]) / 2
            slopes[k, 1] = (patch[j + 1, i] - patch[j - 1, i]) / 2
            k += 1
    _flatten(levels, side // 2 - 1)
    _flatten(slopes[:, 0], side // 2 - 1)
    _flatten(slopes[:, 1], side // 2 - 1)
    return np.sqrt((levels**2).mean()) + 0 * slopes.sum()


@kernel
@no_type_check
def _align(patches, image, start, warps, bends, limit, iterations, shifts, correlations):
    """Fill in for every patch its shift from where it should be, and the correlation there; NaN where it is lost.
    ``bends`` are empty where the warps are all."""
    radius = patches.shape[1] // 2 - 1
    count = (2 * radius + 1) ** 2
    levels, slopes, found = np.empty(count), np.empty((count, 2)), np.empty(count)
    for n in range(len(start)):
        shifts[n] = 0.0
        correlations[n] = np.nan
        spread = _template(patches[n], levels, slopes)
        if not spread > _LEAST_CONTRAST:
            continue
        warp = warps[n]
        area = warp[0, 0] * warp[1, 1] - warp[0, 1] * warp[1, 0]
        if not abs(area) > _LEAST_AREA:
            continue
        slopes_there = slopes @ np.linalg.inv(warp)
        square = slopes_there.T @ slopes_there
        determinant = square[0, 0] * square[1, 1] - square[0, 1] ** 2
        if determinant <= 1e-6 * (square[0, 0] + square[1, 1]) ** 2:
            continue
        x, y = start[n, 0], start[n, 1]
        for _ in range(iterations):
            k = 0
            for dy in range(-radius, radius + 1):
                for dx in range(-radius, radius + 1):
                    off_x = warp[0, 0] * dx + warp[0, 1] * dy
                    off_y = warp[1, 0] * dx + warp[1, 1] * dy
                    if len(bends) > 0:
                        off_x += bends[n, k, 0]
                        off_y += bends[n, k, 1]
                    found[k] = _sample_bilinear(image, x + off_x, y + off_y)
                    k += 1
            _flatten(found, radius)
            power, common = (found**2).sum(), (found * levels).sum()
            correlations[n] = common / (np.sqrt(power * count) * spread + 1e-9)
            off = slopes_there.T @ (levels - common / (power + 1e-9) * found)
            step_x = (square[1, 1] * off[0] - square[0, 1] * off[1]) / determinant
            step_y = (square[0, 0] * off[1] - square[0, 1] * off[0]) / determinant
            x, y = x + step_x, y + step_y
            if not (x - start[n, 0]) ** 2 + (y - start[n, 1]) ** 2 <= limit**2:
                correlations[n] = np.nan
                break
            if step_x**2 + step_y**2 < _STILL_PX**2:
                break
        shifts[n, 0], shifts[n, 1] = x - start[n, 0], y - start[n, 1]


def cut_patches(
    picture: Float32[np.ndarray, "h w"], places_px: Float[np.ndarray, "n 2"], radius_px: int
) -> Float32[np.ndarray, "n s s"]:
    """The patches around positions in an image, one px larger on each side, for their gradients; NaN outside."""
    patches = np.empty((len(places_px), 2 * radius_px + 3, 2 * radius_px + 3), dtype=np.float32)
    _cut_patch(picture, np.ascontiguousarray(places_px - OPENCV_PIXEL_OFFSET), patches)
    return patches


def align_patches(
    patches: Float32[np.ndarray, "n s s"],
    picture: Float32[np.ndarray, "h w"],
    there_px: Float[np.ndarray, "n 2"],
    warps: Float[np.ndarray, "n 2 2"],
    options: AlignmentOptions,
    bends_px: Float[np.ndarray, "m k 2"] = _FLAT,
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n"]]:
    """Positions of patches (:func:`cut_patches`) in another image, px, and their correlation there (NaN where they are
    not found).

    ``warps`` map an offset from the middle of a patch to the one in the other image; ``there_px`` are the starting
    positions. ``bends_px`` is what is added for each pixel of each patch, row by row, where the warps are not all.
    """
    shifts, correlations = np.empty_like(there_px), np.empty(len(there_px))
    start = np.ascontiguousarray(there_px - OPENCV_PIXEL_OFFSET)
    warps, bends_px = np.ascontiguousarray(warps), np.ascontiguousarray(bends_px)
    _align(patches, picture, start, warps, bends_px, options.limit_px, options.iterations, shifts, correlations)
    return there_px + shifts, correlations


class _Views(NamedTuple):
    """The images in which points are followed, those of a frame beside each other."""

    names: tuple[str, ...]
    """By which they are read."""
    frames: Int[np.ndarray, "i"]
    """The frame of each, in order."""
    cameras: tuple[Camera, ...]
    rotations: Float[np.ndarray, "i 3 3"]
    shifts: Float[np.ndarray, "i 3"]

    @staticmethod
    def of(
        names: Sequence[str], frames: Int[np.ndarray, "i"], cameras: Sequence[Camera], cam_from_world: Sequence[Rigid3]
    ) -> _Views:
        """Images with their poses."""
        rotations = np.stack([pose.rotation for pose in cam_from_world])
        shifts = np.array([pose.translation for pose in cam_from_world])
        return _Views(tuple(names), frames, tuple(cameras), rotations, shifts)

    def to_camera(self, image: int, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Points in the camera of an image."""
        return np.asarray(points @ self.rotations[image].T + self.shifts[image])

    def to_world(self, image: int, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Points of the camera of an image in the world."""
        return np.asarray((points - self.shifts[image]) @ self.rotations[image])

    def centre(self, image: int) -> Float[np.ndarray, "3"]:
        """Where an image was taken from."""
        return np.asarray(-self.rotations[image].T @ self.shifts[image])

    def directions(self, image: int, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Unit vectors from points to the camera."""
        return unit(self.centre(image) - points)

    def neighbours(self, first: int, last: int, reach: int) -> Int[np.ndarray, "n"]:
        """The images from the frame of one to that of another, and of so many frames before and after them."""
        return np.flatnonzero((self.frames >= self.frames[first] - reach) & (self.frames <= self.frames[last] + reach))


class _Facets(NamedTuple):
    """The patches of one image, and what they show."""

    image: int
    points: Int[np.ndarray, "k"]
    """The points in their middle."""
    levels: Float32[np.ndarray, "k s s"]
    """As :func:`cut_patches` gives them."""
    places: Float[np.ndarray, "k p 3"]
    """What each of their pixels shows, row by row, in the world."""

    @property
    def middles(self) -> Float[np.ndarray, "k 3"]:
        """What their middles show."""
        return self.places[:, self.places.shape[1] // 2]

    def some(self, which: Bool[np.ndarray, "k"]) -> _Facets:
        """Some of them."""
        return _Facets(self.image, self.points[which], self.levels[which], self.places[which])


class _Scene(NamedTuple):
    """What is followed."""

    views: _Views
    tracks: Tracks
    image_index: Int[np.ndarray, "o"]
    """For each observation: the image."""
    surface: Mesh | None
    options: PatchOptions

    def own_observations(self) -> Int[np.ndarray, "p"]:
        """The observation of each point that is nearest to the middle of its image."""
        middles = np.array([[camera.width, camera.height] for camera in self.views.cameras]) / 2
        off = np.linalg.norm(self.tracks.pixels - middles[self.image_index], axis=1)
        order = np.lexsort((off, self.tracks.point_index))
        return np.asarray(order[np.unique(self.tracks.point_index[order], return_index=True)[1]])

    def facets(self, image: int, own: Int[np.ndarray, "k"], picture: Float32[np.ndarray, "h w"]) -> _Facets:
        """The patches around observations in an image that show something known."""
        tracks, camera, radius = self.tracks, self.views.cameras[image], self.options.radius_px
        middles, points = tracks.pixels[own], tracks.point_index[own]
        rays = camera.rays(middles[:, None] + _patch_offsets(radius))
        if self.surface is None:
            depths = self.views.to_camera(image, tracks.points[points])[:, 2:]
        else:
            centre = self.views.centre(image)
            towards = (rays @ self.views.rotations[image]).reshape(-1, 3)
            hits = self.surface.cast(np.broadcast_to(centre, towards.shape), towards)
            depths = hits.distances.reshape(rays.shape[:2])
        levels = cut_patches(picture, middles, radius)
        known = np.isfinite(depths).all(axis=1)
        places = self.views.to_world(image, rays * np.where(known[:, None], depths, 1.0)[..., None])
        return _Facets(image, points, levels, places).some(known)

    def visible(self, image: int, places: Float[np.ndarray, "k 3"]) -> Bool[np.ndarray, "k"]:
        """Whether the surface occludes no place from an image."""
        if self.surface is None:
            return np.ones(len(places), bool)
        centre = np.broadcast_to(self.views.centre(image), places.shape)
        return np.asarray(self.surface.cast(centre, places - centre).distances > 1 - _HIDDEN)

    def follow(
        self, facets: _Facets, pictures: Mapping[int, Float32[np.ndarray, "h w"]], image: int
    ) -> tuple[Int[np.ndarray, "m"], Int[np.ndarray, "m"], Float[np.ndarray, "m 2"]]:
        """Of the points of one image those found in another: points, images, pixels."""
        views, camera, options, middles = self.views, self.views.cameras[image], self.options, facets.middles
        turn = np.sum(views.directions(facets.image, middles) * views.directions(image, middles), axis=1)
        expected = camera.project(views.to_camera(image, middles))
        seen = camera.contains(expected, 2.0 * options.radius_px) & (turn > np.cos(np.deg2rad(options.turn_deg)))
        seen[seen] = self.visible(image, middles[seen])
        facets, expected = facets.some(seen), expected[seen]
        offsets = camera.project(views.to_camera(image, facets.places)) - expected[:, None]
        warps, bends = _residual_offsets(offsets, options.radius_px)
        pixels, correlation = align_patches(facets.levels, pictures[image], expected, warps, options, bends)
        good = correlation > options.correlation
        return facets.points[good], np.full(int(good.sum()), image), pixels[good]

    def follow_from(
        self, pictures: Mapping[int, Float32[np.ndarray, "h w"]], start: tuple[int, Int[np.ndarray, "k"]]
    ) -> list[tuple[Int[np.ndarray, "_"], Int[np.ndarray, "_"], Float[np.ndarray, "_ 2"]]]:
        """Of an image some observations, and where their points are found in those near it: points, images, pixels."""
        image, own = start
        facets = self.facets(image, own, pictures[image])
        near = self.views.neighbours(image, image, self.options.reach)
        return [
            (self.tracks.point_index[own], np.full(len(own), image), self.tracks.pixels[own]),
            *(self.follow(facets, pictures, other) for other in near.tolist() if other != image),
        ]

    def follow_all(
        self, read: Callable[[str], UInt8[np.ndarray, "h w"]], progress: Progress
    ) -> tuple[Int[np.ndarray, "m"], Int[np.ndarray, "m"], Float[np.ndarray, "m 2"]]:
        """All points where they are found, and in their own images: points, images, pixels. Only images within reach
        are in memory at a time."""
        own, views, pictures = self.own_observations(), self.views, dict[int, np.ndarray]()
        found: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        count = len(views.names)
        for start in range(0, count, _BLOCK):
            block = range(start, min(start + _BLOCK, count))
            near = views.neighbours(block[0], block[-1], self.options.reach).tolist()
            new = [image for image in near if image not in pictures]
            read_now = map_in_threads(lambda image: smooth(read(views.names[image]), self.options.blur_px), new)
            pictures |= dict(zip(new, read_now, strict=True))
            pictures = {image: pictures[image] for image in near}
            mine = [own[self.image_index[own] == image] for image in block]
            follow = partial(self.follow_from, pictures)
            found += chain.from_iterable(map_in_threads(follow, zip(block, mine, strict=True)))
            progress("patches", block[-1] + 1, count)
        point, image_index, pixels = (np.concatenate(each) for each in zip(*found, strict=True))
        often = np.bincount(point, minlength=len(self.tracks.points))[point] >= self.options.min_views
        return point[often], image_index[often], pixels[often]


def _patch_offsets(radius_px: int) -> Float[np.ndarray, "p 2"]:
    """Offsets of the pixels of a patch from its middle, row by row."""
    steps = np.arange(-radius_px, radius_px + 1.0)
    return np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)


def _residual_offsets(
    offsets: Float[np.ndarray, "k p 2"], radius_px: int
) -> tuple[Float[np.ndarray, "k 2 2"], Float[np.ndarray, "k p 2"]]:
    """Offsets of the pixels of patches in another image: the linear maps that fit them best, and what is left."""
    around = _patch_offsets(radius_px)
    warps = np.einsum("kpi,pj->kij", offsets, around) / np.sum(around[:, 0] ** 2)
    return warps, offsets - around @ warps.swapaxes(1, 2)


def follow_points(
    model: SparseModel,
    read: Callable[[str], UInt8[np.ndarray, "h w"]],
    options: PatchOptions,
    *,
    surface: Mesh | None = None,
    progress: Progress = silent,
) -> Tracks:
    """Tracks of the points of a model of one camera whose patches are found in enough frames.

    ``read`` returns the image of a frame, given its name. ``surface``: what the patches show, in the world of the
    model; otherwise each is taken to face its camera.
    """
    names, tracks = model.frames, model.tracks
    views = _Views.of(names, np.arange(len(names)), (model.camera,) * len(names), tuple(model.cam_from_world.values()))
    scene = _Scene(views, tracks, tracks.frame_index, surface, options)
    point, frame, pixels = scene.follow_all(read, progress)
    return _replace_observations(tracks, point, frame, np.zeros_like(frame), pixels)


def follow_rig_points(
    found: Reconstruction,
    read: Callable[[str, str], UInt8[np.ndarray, "h w"]],
    options: PatchOptions,
    *,
    surface: Mesh,
    progress: Progress = silent,
) -> Tracks:
    """As :func:`follow_points`, for a handpiece, into the images that have observations already; ``read`` returns the
    image of a frame and a camera, given their names."""
    tracks, cameras = found.tracks, tuple(found.rig.cameras.values())
    assert tracks is not None
    images, image_index = np.unique(
        np.stack([tracks.frame_index, tracks.camera_index], axis=1), axis=0, return_inverse=True
    )
    frame_of, camera_of = images.T
    poses = tuple(found.rig_from_world.values())
    views = _Views.of(
        [f"{found.rig.names[c]}/{found.frames[f]}" for f, c in images],
        frame_of,
        [cameras[c].camera for c in camera_of],
        [cameras[c].cam_from_rig @ poses[f] for f, c in images],
    )

    def image(name: str) -> UInt8[np.ndarray, "h w"]:
        camera, _, frame = name.partition("/")
        return read(frame, camera)

    scene = _Scene(views, tracks, image_index.reshape(-1), surface, options)
    point, seen_in, pixels = scene.follow_all(image, progress)
    return _replace_observations(tracks, point, frame_of[seen_in], camera_of[seen_in], pixels)


def _replace_observations(
    tracks: Tracks,
    point: Int[np.ndarray, "m"],
    frame: Int[np.ndarray, "m"],
    camera: Int[np.ndarray, "m"],
    pixels: Float[np.ndarray, "m 2"],
) -> Tracks:
    """The points of tracks with other observations, if they have any."""
    other = replace(tracks, point_index=point, frame_index=frame, camera_index=camera, pixels=pixels)
    return select_tracks(other, np.ones(len(point), bool))


def are_connected(tracks: Tracks, frames: int, least: int) -> bool:
    """Whether at least so many points hold each of the frames, and what lies before it and behind."""
    observations = np.bincount(tracks.frame_index, minlength=frames)
    across = points_across(tracks.point_index, tracks.frame_index, frames)
    return bool(min(observations.min(), across.min(initial=least)) >= least)


def lengthen(
    model: SparseModel,
    read: Callable[[str], UInt8[np.ndarray, "h w"]],
    options: PatchOptions,
    *,
    progress: Progress = silent,
) -> SparseModel:
    """The model of one camera with a second track (:func:`follow_points`) for each point whose patch was found."""
    second = follow_points(model, read, options, progress=progress)
    return replace(model, tracks=concatenate_tracks(model.tracks, second))
