"""Depth maps of one frame, group by group: match, refine, check.

Frames: ``grid`` is the pinhole of a depth map, a coarser version of the camera's ideal pinhole.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from threading import Lock
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from cuspid.camera import Camera
from cuspid.errors import InputError
from cuspid.options import Options, Range
from cuspid.pairing import PairingOptions, camera_groups, require_stereo, resolved_mm, stereo_pairs
from cuspid.reconstruction import DepthMap
from cuspid.rig import Handpiece, Rig
from cuspid.stereo.confidence import (
    ConfidenceOptions,
    Measured,
    Resolution,
    agreement,
    at_near_borders,
    confidence,
    sure_enough,
    without_speckle,
)
from cuspid.stereo.initial_depth import PairMatcher, initial_pairs, initial_points, semi_global
from cuspid.stereo.rectification import IdealView, RectifiedPair, rectify
from cuspid.stereo.refinement import SCORE, VARIANCE, GroupGeometry, Q, RefinementOptions, image_noise, refine
from cuspid.stereo.shading import ShadedView, ShadingOptions, brightness, correction, shaded_depths
from cuspid.workers import map_in_threads

_SPACING_PX = 3


@dataclass(frozen=True, kw_only=True)
class StereoOptions(Options):
    """Depth within one frame."""

    spacing_px: Annotated[int | None, Range(1, 100)] = None
    """Depth is measured at every n-th pixel, in each direction. Default: 3, for fine 2."""
    initial_scale: Annotated[float, Range(0.05, 1)] = 0.5
    """Resolution of the initial matching relative to the images."""
    pairing: PairingOptions = field(default_factory=PairingOptions)
    """Which cameras form a group."""
    refinement: RefinementOptions = field(default_factory=RefinementOptions)
    """Multi-camera refinement."""
    confidence: ConfidenceOptions = field(default_factory=ConfidenceOptions)
    """Checks and weights."""
    shading: ShadingOptions = field(default_factory=ShadingOptions)
    """Depth of plain surfaces, where it is their light and shade that is matched."""

    @property
    def grid_px(self) -> int:
        """The spacing that is used."""
        return _SPACING_PX if self.spacing_px is None else self.spacing_px


Signal = Literal["texture", "shading"]
"""What is matched: fine detail, whatever its brightness, or the brightness of plain surfaces under common lights."""


@dataclass(frozen=True, eq=False)
class Group:
    """Cameras that see the same surface, with everything that is computed only once."""

    views: tuple[IdealView, ...]
    """The cameras, without distortion."""
    pairs: tuple[RectifiedPair, ...]
    """Pairs that give the initial depths."""
    geometry: tuple[GroupGeometry, ...]
    """Geometry with each camera as the reference."""
    grids: tuple[Camera, ...]
    """The pinhole camera of the depth map of each camera."""
    corrections: tuple[Float32[np.ndarray, "_ _ 1"], ...]
    """What makes the brightness of each camera comparable (:func:`cuspid.stereo.shading.correction`); none where
    texture is matched."""


def coarser(camera: Camera, spacing_px: int) -> Camera:
    """The pinhole camera with every ``spacing_px``-th pixel centre, starting from ``spacing_px // 2``."""
    first = spacing_px // 2 + 0.5
    return replace(
        camera,
        width=len(range(spacing_px // 2, camera.width, spacing_px)),
        height=len(range(spacing_px // 2, camera.height, spacing_px)),
        focal_px=camera.focal_px / spacing_px,
        principal_point_px=(camera.principal_point_px - first) / spacing_px + 0.5,
    )


def group_geometry(views: Sequence[IdealView], reference: int) -> GroupGeometry:
    """How pixels of a reference view, with their inverse depth, map into the other views."""
    others = [index for index in range(len(views)) if index != reference]
    inverse_matrix = np.linalg.inv(views[reference].camera.opencv_matrix)
    rig_from_reference = views[reference].cam_from_rig.inverse()
    infinite, parallax = [], []
    for index in others:
        other_from_reference = views[index].cam_from_rig @ rig_from_reference
        matrix = views[index].camera.opencv_matrix
        infinite.append(matrix @ other_from_reference.rotation @ inverse_matrix)
        parallax.append(matrix @ other_from_reference.translation)
    scale = max(float(np.linalg.norm(shift)) for shift in parallax)
    return GroupGeometry(np.array(infinite), np.array(parallax) / scale, scale, np.array(others))


def initial_layer(points_in_rig: Float[np.ndarray, "n 3"], view: IdealView, grid: Camera) -> Float[np.ndarray, "h w"]:
    """Depth of the nearest point in each pixel of the grid, NaN where there is none."""
    in_cam = view.cam_from_rig.apply(points_in_rig)
    pixels = grid.project(in_cam)
    seen = grid.contains(pixels, 1e-6)
    column, row = pixels[seen].astype(int).T
    layer = np.full(grid.height * grid.width, np.inf)
    np.minimum.at(layer, row * grid.width + column, in_cam[seen, 2])
    return np.where(np.isfinite(layer), layer, np.nan).reshape(grid.height, grid.width)


def stack_images(
    images: Sequence[UInt8[np.ndarray, "_ _"]],
) -> tuple[Float[np.ndarray, "c h w"], Int[np.ndarray, "c 2"]]:
    """Grey images as one float32 array, padded to the largest, and their true sizes."""
    sizes = np.array([image.shape for image in images])
    stack = np.zeros((len(images), *sizes.max(axis=0)), dtype=np.float32)
    for slot, image in zip(stack, images, strict=True):
        slot[: image.shape[0], : image.shape[1]] = image
    return stack, sizes


_Map = Callable[[Callable[[Any], Any], Iterable[Any]], list[Any]]
"""Does some work on each item; the results, in order."""


def _one_by_one(work: Callable[[Any], Any], items: Iterable[Any]) -> list[Any]:
    return [work(item) for item in items]


class DepthEstimator:
    """Measures depth in the frames of one handpiece. Depends only on the handpiece; safe to share between threads."""

    def __init__(
        self,
        handpiece: Handpiece,
        options: StereoOptions | None = None,
        matcher: PairMatcher = semi_global,
        *,
        signal: Signal = "texture",
        resolution_mm: float | None = None,
    ) -> None:
        """Prepare the groups. Raises InputError where no two cameras see the same surface.

        ``resolution_mm`` is the unit of limits and confidences, by default what the handpiece resolves.
        """
        self.handpiece = handpiece
        self.options = options or StereoOptions()
        self.matcher, self.signal = matcher, signal
        self.confidence = self.options.confidence if signal == "texture" else self.options.shading.confidence
        self.resolution = Resolution(resolution_mm or resolved_mm(handpiece), handpiece.working_distance_mm)
        self._prepared: dict[tuple[str, ...], Group] = {}
        self._preparing = Lock()
        require_stereo(handpiece, self.options.pairing)

    def _groups(self, cameras: tuple[str, ...]) -> list[Group]:
        """The groups that some of the cameras make, whatever their order."""
        if not cameras:
            return []
        rig = Rig({name: self.handpiece.rig[name] for name in cameras}).in_own_order()
        groups = camera_groups(rig, self.handpiece.working_distance_mm, self.options.pairing)
        return [self._group(rig, names) for names in groups if len(names) > 1]

    def _group(self, rig: Rig, names: tuple[str, ...]) -> Group:
        with self._preparing:
            if names not in self._prepared:
                self._prepared[names] = self._prepare(rig, names)
            return self._prepared[names]

    def _prepare(self, rig: Rig, names: tuple[str, ...]) -> Group:
        views = tuple(IdealView.of(name, rig[name]) for name in names)
        possible = stereo_pairs(rig, self.handpiece.working_distance_mm, self.options.pairing)
        pairs = initial_pairs(rig, names, possible)
        lit = names if self.signal == "shading" else ()
        return Group(
            views=views,
            pairs=tuple(rectify(pair, rig[pair[0]], rig[pair[1]], self.options.initial_scale) for pair in pairs),
            geometry=tuple(group_geometry(views, index) for index in range(len(views))),
            grids=tuple(coarser(view.camera, self.options.grid_px) for view in views),
            corrections=tuple(correction(rig[name].camera, self.handpiece.sensor_of(name)) for name in lit),
        )

    def measure(
        self,
        images: Mapping[str, UInt8[np.ndarray, "h w *c"]],
        frame: str,
        lighting: str | None = None,
        *,
        alone: bool = False,
    ) -> tuple[DepthMap, ...]:
        """Depth maps of a frame, one for each camera with a stereo partner, from RGB or grey images by camera name,
        taken under a lighting pattern of the handpiece.

        A camera of the handpiece that is not among them, or whose image is blank, saw nothing of the frame. ``alone``:
        no other frame is measured meanwhile, so that the cameras of a group are measured side by side.

        Raises InputError where shading is to be matched and it is not told which of several patterns was on.
        """
        if self.signal == "shading" and lighting is None and len(self.handpiece.lightings) > 1:
            known = ", ".join(each.name for each in self.handpiece.lightings)
            raise InputError(
                f"frame {frame}: which lights were on is not told, and plain surfaces are matched by them; give each "
                f"frame's lighting in capture.json ({known}), or import the footage with --lightings"
            )
        names = self.handpiece.rig.names
        groups = self._groups(tuple(name for name in names if name in images and not _is_blank(images[name])))
        work = map_in_threads if alone else _one_by_one
        found = [each for group in groups for each in self._measure_group(group, images, frame, lighting, work)]
        return tuple(sorted(found, key=lambda depth_map: names.index(depth_map.camera_name)))

    def _measure_group(
        self,
        group: Group,
        images: Mapping[str, UInt8[np.ndarray, "h w *c"]],
        frame: str,
        lighting: str | None,
        work: _Map,
    ) -> list[DepthMap]:
        by_shading = self.signal == "shading"
        measured = self._by_shading(group, images, lighting) if by_shading else self._by_texture(group, images, work)
        return [
            self._depth_map(measured, index, view, images[view.name], frame) for index, view in enumerate(group.views)
        ]

    def _by_texture(
        self, group: Group, images: Mapping[str, UInt8[np.ndarray, "h w *c"]], work: _Map
    ) -> list[Measured]:
        grays = {view.name: gray(images[view.name]) for view in group.views}
        depth_range = self.handpiece.depth_range_mm
        initial = work(lambda pair: initial_points(pair, grays, self.matcher, depth_range), group.pairs)
        stack, sizes = stack_images([view.resample(grays[view.name]) for view in group.views])
        return work(lambda index: self._measure_reference(group, index, initial, stack, sizes), range(len(group.views)))

    def _by_shading(
        self, group: Group, images: Mapping[str, UInt8[np.ndarray, "h w *c"]], lighting: str | None
    ) -> list[Measured]:
        stack = brightness(group.views, [_rgb(images[view.name]) for view in group.views], group.corrections)
        views = [
            ShadedView(
                grid=grid,
                size=(view.camera.height, view.camera.width),
                geometry=geometry,
                lights=[light.in_frame(view.cam_from_rig) for light in self.handpiece.lights_on(lighting)],
                gamma=self.handpiece.sensor_of(view.name).gamma,
            )
            for view, grid, geometry in zip(group.views, group.grids, group.geometry, strict=True)
        ]
        options = self.options
        depths = shaded_depths(stack, views, self.handpiece.depth_range_mm, options.grid_px, options.shading)
        return [
            Measured(grid, view.cam_from_rig, *found)
            for view, grid, found in zip(group.views, group.grids, depths, strict=True)
        ]

    def _measure_reference(
        self,
        group: Group,
        index: int,
        initial: Sequence[Float[np.ndarray, "_ 3"]],
        stack: Float[np.ndarray, "c h w"],
        sizes: Int[np.ndarray, "c 2"],
    ) -> Measured:
        view, grid, geometry = group.views[index], group.grids[index], group.geometry[index]
        layers = np.stack([initial_layer(points, view, grid) for points in initial])
        planes = refine(
            stack,
            sizes,
            index,
            geometry,
            layers,
            self.handpiece.depth_range_mm,
            self.options.grid_px,
            image_noise(stack[index, : sizes[index, 0], : sizes[index, 1]]),
            self.options.refinement,
        )
        found = planes[..., SCORE] > 0
        depth = geometry.scale / np.where(found, planes[..., Q], np.nan)
        sigma = np.sqrt(planes[..., VARIANCE]) * depth**2 / geometry.scale
        return Measured(grid, view.cam_from_rig, depth, sigma)

    def _depth_map(
        self,
        measured: Sequence[Measured],
        index: int,
        view: IdealView,
        image: UInt8[np.ndarray, "h w *c"],
        frame: str,
    ) -> DepthMap:
        one, resolution, options = measured[index], self.resolution, self.confidence
        keep = (agreement(measured, index, resolution, options) > 0) & sure_enough(one, resolution, options)
        if len(measured) == 2:
            radius = -(-options.border_px // self.options.grid_px)
            keep &= ~at_near_borders(measured, index, radius, resolution, options)
        keep = without_speckle(np.where(keep, one.depth_mm, np.nan), resolution, options)
        return DepthMap(
            frame=frame,
            camera_name=view.name,
            camera=one.camera,
            cam_from_rig=one.cam_from_rig,
            depth_mm=np.where(keep, one.depth_mm, np.nan).astype(np.float32),
            confidence=confidence(one.sigma_mm, keep, resolution, options),
            color=_color_grid(view.resample(image), self.options.grid_px),
        )


def gray(image: UInt8[np.ndarray, "h w *c"]) -> UInt8[np.ndarray, "h w"]:
    """Grey levels of an RGB or grey image."""
    if image.ndim == 2:
        return image
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def _rgb(image: UInt8[np.ndarray, "h w *c"]) -> UInt8[np.ndarray, "h w 3"]:
    return np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image


_BLANK_DN = 2.0


def _is_blank(image: UInt8[np.ndarray, "h w *c"]) -> bool:
    """Whether an image shows no more than noise."""
    return bool(cv2.meanStdDev(image)[1].max() < _BLANK_DN)


def _color_grid(image: UInt8[np.ndarray, "h w *c"], spacing_px: int) -> UInt8[np.ndarray, "r s 3"]:
    """RGB at the pixels of the grid."""
    start = spacing_px // 2
    picked = image[start::spacing_px, start::spacing_px]
    return np.ascontiguousarray(_rgb(picked))
