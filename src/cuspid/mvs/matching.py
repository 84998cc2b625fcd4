"""Depth maps of one frame, group by group: match, refine, check.

Frames: ``grid`` is the pinhole of a depth map, a coarser version of the camera's ideal pinhole.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from threading import Lock
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from cuspid.model.camera import Camera
from cuspid.model.pairing import PairingOptions, camera_groups, rank_sources, require_stereo, resolved_mm
from cuspid.model.reconstruction import DepthMap, Funnel
from cuspid.model.rig import MID_GREY_DN, Handpiece, Rig
from cuspid.mvs.confidence import (
    ConfidenceOptions,
    Measured,
    Resolution,
    agreement,
    confidence,
    is_certain,
    occlusion_borders,
    reject_speckle,
)
from cuspid.mvs.detail import find_bold_texture
from cuspid.mvs.initial_depth import initial_pairs, initial_points, semi_global
from cuspid.mvs.rectification import IdealView, RectifiedPair, rectify
from cuspid.mvs.refinement import SCORE, VARIANCE, GroupGeometry, Q, RefinementOptions, image_noise, refine
from cuspid.mvs.regularised import even_out, sweep
from cuspid.mvs.shading import ShadedView, ShadingOptions, brightness, correction, shaded_depths
from cuspid.runtime.errors import InputError
from cuspid.runtime.image_files import Pixels, as_8_bits, stretch_fine, visible_in_8_bits
from cuspid.runtime.options import Options, Range
from cuspid.runtime.workers import computed_once, map_in_threads

Levels = UInt8[np.ndarray, "h w *c"] | Float32[np.ndarray, "h w *c"]
"""An RGB or grey image, with fractions of digital numbers where more than 8 bits are stored."""

_SPACING_PX = 3
_BLUR_SHARE = 0.5
"""Standard deviation of the blur of images that only some pixels are sampled of, as a share of their distance."""
_SHADE_PX = 4.0
"""What is wider than this is shade."""
_WEAK_SIGMA_PX = 0.15
"""Standard deviation (px of disparity) that a depth from weak texture has at least: what looks alike need not be."""
_OUTLYING_SIGMAS = 4.0
"""Planes that lie so far from a smooth surface, in its standard deviations, are outliers."""
_LEAST_BOLD = 0.02
"""Share of a view with bold texture that makes it worth matching where shade is measured."""
_MOST_DISPARITIES = 800
"""Of the initial matching, px."""
MOST_AGREED, WEAKLY_AGREED = 0.8, 0.6
"""Shares of the pixels with an initial depth that views should agree on: with less than the first they are matched in
wider windows; where it is less than the second after that, the rest is made smooth."""
_LEAST_WEAK = 0.02
"""Share of a view with weak texture that makes it worth a smooth surface."""
_WEAK_WINDOW = 25
"""Side of the windows in which depths that agree are counted, in depths."""
WIDENINGS = (2, 3)
"""How many times wider these are, one after the other."""


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
class ViewSet:
    """Views that are matched with each other, with everything that is computed only once."""

    views: tuple[IdealView, ...]
    """Without distortion."""
    sources: tuple[tuple[int, ...], ...]
    """For each view the indices of those that it is matched with; none for one that is a source only."""
    pairs: tuple[RectifiedPair, ...]
    """Pairs that give the initial depths."""
    layers: tuple[tuple[int, ...], ...]
    """For each view the indices of the pairs whose depths it begins with."""
    geometry: tuple[GroupGeometry | None, ...]
    """Geometry with each view as the reference; None for one that is a source only."""
    grids: tuple[Camera, ...]
    """The pinhole camera of the depth map of each view."""
    corrections: tuple[Float32[np.ndarray, "_ _ 1"], ...] = ()
    """What makes the brightness of each view comparable (:func:`cuspid.mvs.shading.correction`); none where texture
    is matched."""

    @property
    def references(self) -> tuple[int, ...]:
        """Indices of the views that get a depth map."""
        return tuple(index for index, sources in enumerate(self.sources) if sources)


def prepare_views(
    rig: Rig,
    sources: Mapping[str, Sequence[str]],
    distance_mm: float,
    depth_range_mm: tuple[float, float],
    options: StereoOptions,
) -> ViewSet:
    """Views, given as cameras in a common frame, those of which ``sources`` names others being references.

    ``distance_mm`` is how far from them the surface lies, about, ``depth_range_mm`` at least and at most.
    """
    names = list(rig.names)
    index = {name: k for k, name in enumerate(names)}
    views = tuple(IdealView.of(name, rig[name]) for name in names)
    others = tuple(tuple(sorted(index[each] for each in sources.get(name, ()))) for name in names)
    chosen: dict[frozenset[str], tuple[str, str]] = {}
    for pair in initial_pairs(rig, sources, distance_mm).values():
        chosen.setdefault(frozenset(pair), pair)
    pairs = [(index[one], index[other]) for one, other in chosen.values()]
    return ViewSet(
        views=views,
        sources=others,
        pairs=tuple(
            rectify(pair, rig[pair[0]], rig[pair[1]], _initial_scale(rig, pair, depth_range_mm, options))
            for pair in chosen.values()
        ),
        layers=tuple(
            tuple(k for k, pair in enumerate(pairs) if set(pair) <= {reference, *others[reference]})
            for reference in range(len(names))
        ),
        geometry=tuple(
            group_geometry(views, reference, others[reference]) if others[reference] else None
            for reference in range(len(names))
        ),
        grids=tuple(coarser(view.camera, options.grid_px) for view in views),
    )


def _initial_scale(
    rig: Rig, pair: tuple[str, str], depth_range_mm: tuple[float, float], options: StereoOptions
) -> float:
    """Resolution of the initial matching of a pair relative to its images: less where there would be very many
    disparities."""
    near, far = depth_range_mm
    baseline_mm = float(np.linalg.norm(rig[pair[0]].centre_in_rig - rig[pair[1]].centre_in_rig))
    disparities = baseline_mm * float(rig[pair[0]].camera.focal_px.mean()) * (1 / near - 1 / far)
    return min(options.initial_scale, _MOST_DISPARITIES / max(disparities, 1))


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


def group_geometry(views: Sequence[IdealView], reference: int, sources: Sequence[int]) -> GroupGeometry:
    """How pixels of a reference view, with their inverse depth, map into its sources."""
    inverse_matrix = np.linalg.inv(views[reference].camera.opencv_matrix)
    rig_from_reference = views[reference].cam_from_rig.inverse()
    infinite, parallax = [], []
    for index in sources:
        other_from_reference = views[index].cam_from_rig @ rig_from_reference
        matrix = views[index].camera.opencv_matrix
        infinite.append(matrix @ other_from_reference.rotation @ inverse_matrix)
        parallax.append(matrix @ other_from_reference.translation)
    scale = max(float(np.linalg.norm(shift)) for shift in parallax)
    return GroupGeometry(np.array(infinite), np.array(parallax) / scale, scale, np.array(sources))


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
    images: Sequence[UInt8[np.ndarray, "_ _"] | Float32[np.ndarray, "_ _"]],
) -> tuple[Float[np.ndarray, "c h w"], Int[np.ndarray, "c 2"]]:
    """Grey images as one float32 array, padded to the largest, and their true sizes."""
    sizes = np.array([image.shape for image in images])
    stack = np.zeros((len(images), *sizes.max(axis=0)), dtype=np.float32)
    for slot, image in zip(stack, images, strict=True):
        slot[: image.shape[0], : image.shape[1]] = image
    return stack, sizes


_Map = Callable[[Callable[[Any], Any], Iterable[Any]], list[Any]]
"""Does some work on each item; the results, in order."""


def map_in_sequence(work: Callable[[Any], Any], items: Iterable[Any]) -> list[Any]:
    return [work(item) for item in items]


class DepthEstimator:
    """Measures depth in the frames of one handpiece. Depends only on the handpiece; safe to share between threads."""

    def __init__(
        self,
        handpiece: Handpiece,
        options: StereoOptions | None = None,
        *,
        signal: Signal = "texture",
        resolution_mm: float | None = None,
    ) -> None:
        """Raises InputError where no two cameras see the same surface.

        ``resolution_mm`` is the unit of limits and confidences, by default what the handpiece resolves.
        """
        self.handpiece = handpiece
        self.options, self.signal = options or StereoOptions(), signal
        self.checks = self.options.confidence if signal == "texture" else self.options.shading.confidence
        self.resolution = Resolution(resolution_mm or resolved_mm(handpiece), handpiece.working_distance_mm)
        self._prepared: dict[tuple[str, ...], tuple[ViewSet, ...]] = {}
        self._preparing = Lock()
        require_stereo(handpiece, self.options.pairing)

    def _view_sets(self, cameras: tuple[str, ...]) -> tuple[ViewSet, ...]:
        """The cameras in sets that can be measured one after the other, whatever their order."""
        if not cameras:
            return ()
        rig = Rig({name: self.handpiece.rig[name] for name in cameras}).in_own_order()
        with self._preparing:
            if rig.names not in self._prepared:
                self._prepared[rig.names] = self._prepare(rig)
            return self._prepared[rig.names]

    def _prepare(self, rig: Rig) -> tuple[ViewSet, ...]:
        distance_mm = self.handpiece.working_distance_mm
        sets = list[ViewSet]()
        for names in camera_groups(rig, distance_mm, self.options.pairing):
            if len(names) > 1:
                part = Rig({name: rig[name] for name in names})
                if self.signal == "texture":
                    sources = rank_sources(part, distance_mm, self.options.pairing)
                    sets.append(prepare_views(part, sources, distance_mm, self.handpiece.depth_range_mm, self.options))
                else:
                    sets.append(self._prepare_shading(part, distance_mm))
        return tuple(sets)

    def _prepare_shading(self, part: Rig, distance_mm: float) -> ViewSet:
        """Every view with all others."""
        sources = {name: tuple(other for other in part.names if other != name) for name in part.names}
        prepared = prepare_views(part, sources, distance_mm, self.handpiece.depth_range_mm, self.options)
        sensors = [self.handpiece.sensor_of(name) for name in part.names]
        return replace(
            prepared,
            corrections=tuple(
                correction(part[name].camera, sensor) for name, sensor in zip(part.names, sensors, strict=True)
            ),
        )

    def measure(
        self,
        images: Mapping[str, Levels],
        frame: str,
        lighting: str | None = None,
        *,
        masks: Mapping[str, UInt8[np.ndarray, "h w"]] | None = None,
        alone: bool = False,
    ) -> tuple[DepthMap, ...]:
        """Depth maps of a frame, one for each camera with a stereo partner, from RGB or grey images by camera name,
        taken under a lighting pattern of the handpiece.

        A camera of the handpiece that is not among them, or whose image is blank, saw nothing of the frame. ``masks``
        are zero where an image shows what is not to be measured. ``alone``: no other frame is measured meanwhile, so
        that the views are measured side by side.

        Raises InputError where shading is to be matched and it is unknown which of several patterns was on.
        """
        if self.signal == "shading" and lighting is None and len(self.handpiece.lightings) > 1:
            known = ", ".join(each.name for each in self.handpiece.lightings)
            raise InputError(
                f"frame {frame}: which lights were on is unknown, but plain surfaces are matched by them; give each "
                f"frame's lighting in capture.json ({known}), or import the footage with --lightings"
            )
        names = self.handpiece.rig.names
        work = map_in_threads if alone else map_in_sequence
        found = list[DepthMap]()
        for views in self._view_sets(tuple(name for name in names if name in images and not _is_blank(images[name]))):
            if self.signal == "shading":
                measured = self._measure_shading(views, images, lighting)
            else:
                measured = measure_views(
                    views,
                    images,
                    self.handpiece.depth_range_mm,
                    self.resolution,
                    self.options,
                    work,
                    widenings=() if self.handpiece.lights else WIDENINGS,
                )
            maps = depth_maps_of(
                views, measured, images, masks or {}, frame, self.resolution, self.checks, self.options.grid_px
            )
            if self.signal == "shading":
                maps = self._add_bold_texture(views, maps, images, masks or {}, frame)
            found += maps
        return tuple(sorted(found, key=lambda depth_map: names.index(depth_map.camera_name)))

    def _add_bold_texture(
        self,
        views: ViewSet,
        shaded: Sequence[DepthMap],
        images: Mapping[str, Levels],
        masks: Mapping[str, UInt8[np.ndarray, "h w"]],
        frame: str,
    ) -> list[DepthMap]:
        """What shade tells of some views, with what texture tells where it is bold: several times as exact."""
        bold = {view.name: self._bold_on_grid(view, images[view.name]) for view in views.views}
        if max(where.mean() for where in bold.values()) < _LEAST_BOLD:
            return list(shaded)
        found = self._texture_estimator.measure({name: images[name] for name in bold}, frame, masks=masks)
        textured = {each.camera_name: each for each in found}
        return [
            merge_depths(each, textured[each.camera_name], bold[each.camera_name])
            if each.camera_name in textured
            else each
            for each in shaded
        ]

    def _bold_on_grid(self, view: IdealView, image: Levels) -> Bool[np.ndarray, "r s"]:
        bold = view.resample_mask(find_bold_texture(as_8_bits(gray(image))).astype(np.uint8))
        return np.asarray(_grid_of(bold, self.options.grid_px) > 0)

    @computed_once
    def _texture_estimator(self) -> DepthEstimator:
        return DepthEstimator(self.handpiece, self.options, resolution_mm=self.resolution.mm)

    def _measure_shading(
        self, views: ViewSet, images: Mapping[str, Levels], lighting: str | None
    ) -> Mapping[int, Measured]:
        stack = brightness(views.views, [_rgb(images[view.name]) for view in views.views], views.corrections)
        shaded = [
            ShadedView(
                grid=grid,
                size=(view.camera.height, view.camera.width),
                geometry=geometry,
                lights=[light.in_frame(view.cam_from_rig) for light in self.handpiece.lights_on(lighting)],
                gamma=self.handpiece.sensor_of(view.name).gamma,
            )
            for view, grid, geometry in zip(views.views, views.grids, views.geometry, strict=True)
            if geometry is not None
        ]
        options = self.options
        depths = shaded_depths(stack, shaded, self.handpiece.depth_range_mm, options.grid_px, options.shading)
        return {
            index: Measured(grid, view.cam_from_rig, *found)
            for index, (view, grid, found) in enumerate(zip(views.views, views.grids, depths, strict=True))
        }


class Match:
    """The images of a set of views, ready to be matched by texture."""

    def __init__(
        self,
        views: ViewSet,
        images: Mapping[str, Levels],
        depth_range_mm: tuple[float, float],
        options: StereoOptions,
        work: _Map = map_in_sequence,
        *,
        shaded: bool = False,
    ) -> None:
        """RGB or grey images by the names of the views. ``shaded``: their brightness may be shade that does not stay
        on the surface, since lights move with the camera, or stand close by: wide windows must not gather it."""
        self._shaded, self._blurred = shaded, dict[int, Float[np.ndarray, "c h w"]]()
        grays = {view.name: stretch_fine(gray(images[view.name])) for view in views.views}
        self._views, self._range_mm, self._options = views, depth_range_mm, options
        self._grays, self._work = {name: visible_in_8_bits(image) for name, image in grays.items()}, work
        self._stack, self._sizes = stack_images([view.resample(grays[view.name]) for view in views.views])

    @computed_once
    def _detail(self) -> Float[np.ndarray, "c h w"]:
        """What wide windows see: the images, without what changes slowly where that may be shade."""
        if not self._shaded:
            return self._stack
        return np.stack([image - cv2.GaussianBlur(image, (0, 0), _SHADE_PX) + MID_GREY_DN for image in self._stack])

    def _views_for_widening(self, widening: int) -> Float[np.ndarray, "c h w"]:
        """The images for windows that are so many times wider, of which as many fewer pixels are sampled."""
        if widening == 1:
            return self._stack
        if widening not in self._blurred:
            blurs = [cv2.GaussianBlur(image, (0, 0), _BLUR_SHARE * widening) for image in self._detail]
            self._blurred[widening] = np.stack(blurs)
        return self._blurred[widening]

    @computed_once
    def _initial(self) -> list[Float[np.ndarray, "_ 3"]]:
        """Points that each pair of views finds."""
        find = partial(initial_points, images=self._grays, matcher=semi_global, depth_range_mm=self._range_mm)
        return self._work(find, self._views.pairs)

    def measure(self, index: int) -> Measured:
        """Depth of a reference view before the checks."""
        view, grid = self._views.views[index], self._views.grids[index]
        layers = np.stack([initial_layer(self._initial[pair], view, grid) for pair in self._views.layers[index]])
        return self._refine_layer(index, layers, begun=np.isfinite(layers).any(axis=0))

    def widen(self, index: int, one: Measured, agreed: Float[np.ndarray, "h w 6"], widening: int) -> Measured:
        """What was measured of a view where other views agree with it (planes), and what these planes, carried on to
        the rest of it, lead to in wider windows."""
        none = np.full((1, *one.depth_mm.shape), np.nan)
        return self._refine_layer(index, none, begun=one.begun, known=agreed, widening=widening)

    def _refine_layer(
        self,
        index: int,
        layers: Float[np.ndarray, "l h w"],
        *,
        begun: Bool[np.ndarray, "h w"] | None,
        known: Float[np.ndarray, "h w 6"] | None = None,
        widening: int = 1,
    ) -> Measured:
        geometry, (height, width) = self._views.geometry[index], self._sizes[index]
        assert geometry is not None
        seen = self._views_for_widening(widening)
        planes = refine(
            seen,
            self._sizes,
            index,
            geometry,
            layers,
            self._range_mm,
            self._options.grid_px,
            image_noise(seen[index, :height, :width]),
            self._options.refinement,
            known=known,
            widening=widening,
        )
        found = planes[..., SCORE] > 0
        depth = geometry.scale / np.where(found, planes[..., Q], np.nan)
        sigma = np.sqrt(np.maximum(planes[..., VARIANCE], 0)) * depth**2 / geometry.scale
        cam_from_rig = self._views.views[index].cam_from_rig
        return Measured(self._views.grids[index], cam_from_rig, depth, sigma, begun, planes.astype(np.float32))

    def regularise(
        self, index: int, one: Measured, agreed: Float[np.ndarray, "h w 6"], weak: Bool[np.ndarray, "h w"]
    ) -> Measured:
        """What was measured of a view where other views agree with it (planes) and a smooth surface through the same
        images does, too (:mod:`cuspid.mvs.regularised`); elsewhere that surface: where texture is ``weak``, much
        agrees by chance. What is not weak stays as it is."""
        geometry = self._views.geometry[index]
        assert geometry is not None
        near, far = self._range_mm
        height, width = self._sizes[index]
        q, sigma_q = sweep(
            self._detail,
            self._sizes,
            index,
            geometry,
            (geometry.scale / far, geometry.scale / near),
            self._options.grid_px,
            image_noise(self._stack[index, :height, :width]),
        )
        with np.errstate(invalid="ignore"):
            smooth = (agreed[..., SCORE] == 0) | (np.abs(agreed[..., Q] - q) > _OUTLYING_SIGMAS * sigma_q)
        smooth &= weak
        depth = np.where(smooth, geometry.scale / q, one.depth_mm)
        step_mm = depth**2 / geometry.scale
        sigma = np.where(smooth, sigma_q * step_mm, np.maximum(one.sigma_mm, _WEAK_SIGMA_PX * step_mm))
        even = even_out(depth, sigma, float(one.camera.focal_px.mean()))
        return replace(
            one,
            depth_mm=np.where(weak, even, depth),
            sigma_mm=np.where(weak, sigma, one.sigma_mm),
            smooth=smooth & np.isfinite(even),
        )


def measure_views(
    views: ViewSet,
    images: Mapping[str, Levels],
    depth_range_mm: tuple[float, float],
    resolution: Resolution,
    options: StereoOptions,
    work: _Map = map_in_sequence,
    *,
    widenings: Sequence[int] = WIDENINGS,
) -> Mapping[int, Measured]:
    """Depth of each reference of a set of views by texture, before the last checks, by its index.

    Where other views contradict much of what was matched, as with weak texture, the rest of the view is matched again
    in windows that are so many times wider (``widenings``), from the planes that others agree with, and then made
    smooth. That is not for surfaces under close lights that are known: what is weak there may be their shade, which
    is another matter (:mod:`cuspid.mvs.shading`).
    """
    match = Match(views, images, depth_range_mm, options, work)
    measured = dict(zip(views.references, work(match.measure, views.references), strict=True))
    for widening in widenings:
        before = dict(measured)

        def again(index: int, widening: int = widening, before: Mapping[int, Measured] = before) -> Measured:
            agreed = consistent_planes(before[index], sources_of(views, index, before), resolution, options.confidence)
            return before[index] if agreed is None else match.widen(index, before[index], agreed, widening)

        measured = dict(zip(views.references, work(again, views.references), strict=True))
    if not widenings:
        return measured
    matched = measured

    def regularise(index: int) -> Measured:
        one = matched[index]
        agreed = are_consistent(one, sources_of(views, index, matched), resolution, options.confidence)
        weak = find_weak_texture(agreed, one.begun)
        return match.regularise(index, one, planes_of(one, agreed), weak) if weak.mean() > _LEAST_WEAK else one

    return dict(zip(views.references, work(regularise, views.references), strict=True))


def sources_of(views: ViewSet, index: int, measured: Mapping[int, Measured]) -> list[Measured]:
    """What was measured of the sources of a view."""
    return [measured[source] for source in views.sources[index] if source in measured]


def consistent_planes(
    one: Measured, others: Sequence[Measured], resolution: Resolution, checks: ConfidenceOptions
) -> Float[np.ndarray, "h w 6"] | None:
    """The planes of a view that others agree with; None where these are most of what it began with, so that another
    search would not pay."""
    assert one.begun is not None
    agreed = are_consistent(one, others, resolution, checks)
    return None if agreed.sum() >= MOST_AGREED * one.begun.sum() else planes_of(one, agreed)


def planes_of(one: Measured, where: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 6"]:
    """The planes of a view in some places; 0 elsewhere."""
    assert one.planes is not None
    return np.asarray(one.planes * where[..., None], dtype=np.float64)


def are_consistent(
    one: Measured, others: Sequence[Measured], resolution: Resolution, checks: ConfidenceOptions
) -> Bool[np.ndarray, "h w"]:
    """Where other views agree with the depth of a view, and it is sure enough of it."""
    return (agreement(one, others, resolution, checks) > 0) & is_certain(one, resolution, checks)


def find_weak_texture(
    agreed: Bool[np.ndarray, "h w"], begun: Bool[np.ndarray, "h w"] | None
) -> Bool[np.ndarray, "h w"]:
    """Where other views agree with few of the depths that a view began with: in wide windows around each pixel, or
    everywhere, if they do so in the view as a whole."""
    assert begun is not None
    if agreed.sum() < WEAKLY_AGREED * begun.sum():
        return np.ones_like(agreed)
    window = (_WEAK_WINDOW, _WEAK_WINDOW)
    count, tried = (cv2.boxFilter(each.astype(np.float32), -1, window) for each in (agreed & begun, begun))
    return np.asarray((count < WEAKLY_AGREED * tried) & (tried > 0.5))


def depth_maps_of(
    views: ViewSet,
    measured: Mapping[int, Measured],
    images: Mapping[str, Levels],
    masks: Mapping[str, UInt8[np.ndarray, "h w"]],
    frame: str,
    resolution: Resolution,
    checks: ConfidenceOptions,
    grid_px: int,
) -> list[DepthMap]:
    """The depth maps of the references of a set, all of which were measured."""
    return [
        filter_depth_map(
            measured[index],
            sources_of(views, index, measured),
            images[view.name],
            masks.get(view.name),
            view,
            frame,
            resolution,
            checks,
            grid_px,
        )
        for index, view in ((index, views.views[index]) for index in views.references)
    ]


def filter_depth_map(
    one: Measured,
    others: Sequence[Measured],
    image: Levels,
    mask: UInt8[np.ndarray, "h w"] | None,
    view: IdealView,
    frame: str,
    resolution: Resolution,
    checks: ConfidenceOptions,
    grid_px: int,
) -> DepthMap:
    """The depths of a view that those of its sources agree with.

    ``image`` is the view's, as it was taken; its ``mask`` is zero where it shows what is not to be measured.
    """
    counts = np.ones(one.depth_mm.shape, dtype=bool)
    if mask is not None:
        counts = _grid_of(view.resample_mask(mask), grid_px) > 0
    agreed = counts & are_consistent(one, others, resolution, checks)
    if len(others) == 1:
        agreed &= ~occlusion_borders(one, others[0], -(-checks.border_px // grid_px), resolution, checks)
    speckle = replace(
        checks, speckle_px=min(checks.speckle_px, round(checks.speckle_px * (_SPACING_PX / grid_px) ** 2))
    )
    keep = reject_speckle(np.where(agreed, one.depth_mm, np.nan), resolution, speckle, one.smooth)
    matched = counts & np.isfinite(one.depth_mm)
    funnel = Funnel(
        pixels=int(counts.sum()),
        begun=int((matched if one.begun is None else counts & (matched | one.begun)).sum()),
        matched=int(matched.sum()),
        agreed=int(agreed.sum()),
        kept=int(keep.sum()),
    )
    return DepthMap(
        frame=frame,
        camera_name=view.name,
        camera=one.camera,
        cam_from_rig=one.cam_from_rig,
        depth_mm=np.where(keep, one.depth_mm, np.nan).astype(np.float32),
        confidence=confidence(one, keep, resolution, checks),
        color=_rgb(_grid_of(view.resample(as_8_bits(image)), grid_px)),
        funnel=funnel,
        best_mm=resolution.mm * checks.best_sigma,
    )


def merge_depths(one: DepthMap, other: DepthMap, where: Bool[np.ndarray, "h w"]) -> DepthMap:
    """A depth map with the depths that another one of the same view has in some places."""
    assert one.best_mm is not None
    taken = where & other.known
    sigma_mm = np.where(taken, other.sigma_mm, one.sigma_mm)
    weight = np.minimum((one.best_mm / sigma_mm) ** 2, 1)
    kept = int(np.isfinite(sigma_mm).sum())
    return replace(
        one,
        depth_mm=np.where(taken, other.depth_mm, one.depth_mm),
        confidence=np.nan_to_num(weight).astype(np.float32),
        funnel=None if one.funnel is None else one.funnel.with_kept(kept),
    )


def gray(image: Levels) -> UInt8[np.ndarray, "h w"] | Float32[np.ndarray, "h w"]:
    """Grey levels of an RGB or grey image."""
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))


def _rgb(image: Levels) -> Pixels:
    return np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image


_BLANK_DN, _BLANK_FINE_DN = 2.0, 0.1
"""RMS contrast of images of 8 and of more bits."""


def _is_blank(image: Levels) -> bool:
    """Whether an image shows no more than noise."""
    return bool(cv2.meanStdDev(image)[1].max() < (_BLANK_DN if image.dtype == np.uint8 else _BLANK_FINE_DN))


def _grid_of(image: Levels, spacing_px: int) -> UInt8[np.ndarray, "r s *c"]:
    """The pixels of the grid."""
    start = spacing_px // 2
    return np.ascontiguousarray(image[start::spacing_px, start::spacing_px])
