"""Depth maps to one mesh, in two passes over the maps.

The first pass blends signed distances in a sparse volume, whose zero level gives the topology. The second evaluates
every depth map at every vertex and moves the vertex along its normal to the robust weighted mean of the surfaces that
were seen, which removes the rounding by the voxels; it also counts the maps that saw the vertex, and averages its
colour. Where the surface bends, as at edges, the mesh gets vertices at half the spacing before. A vertex that too few
maps confirm from its outer side, or for which none has a depth, is dropped: this removes ghosts, back walls, and what
is only extrapolated past the borders of all maps.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from cuspid.fusion.bends import find_bends, subdivide_edges
from cuspid.fusion.cleaning import hole_rims
from cuspid.fusion.evidence import Evidence, colors_of, observe
from cuspid.fusion.meshing import extract
from cuspid.fusion.volume import SparseVolume, VolumeUpdate
from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.mesh import Mesh, used_vertices
from cuspid.model.reconstruction import DepthMap, SurfacePoints
from cuspid.runtime.kernels import kernel
from cuspid.runtime.options import Options, Range
from cuspid.runtime.progress import Progress, silent
from cuspid.runtime.workers import map_batches, run_in_shares


@dataclass(frozen=True, eq=False)
class Fused:
    """A mesh, and the uncertainty of its depth."""

    mesh: Mesh
    """In the world frame, coloured."""
    sigma_mm: Float[np.ndarray, "v"]
    """Standard deviation of each vertex along its normal, from the scatter of the depth maps about it or, where no
    surface is seen in several frames, from what the maps state. The maps of one frame share its images, so they count
    as one. Errors common to all frames are not included."""


@dataclass(frozen=True, kw_only=True)
class FusionOptions(Options):
    """Fusion of depth maps into a mesh."""

    voxel_mm: Annotated[float | None, Range(0.001, 1000)] = None
    """Spacing of the grid, about the spacing of the mesh's vertices; default: 4.16 times the detail that the
    handpiece shows, 0.05 mm for the built-in ones."""
    truncation_voxels: Annotated[float, Range(1, 100)] = 3.0
    """Distance from a surface, in voxels, up to which depth maps are blended."""
    max_jump: Annotated[float, Range(0.01, 10_000)] = 12.5
    """Neighbouring depths that differ by more than this many times the detail (0.15 mm at 12 um) do not belong to the
    same surface."""
    min_weight: Annotated[float | None, Range(0, 1_000_000)] = None
    """Minimum weight (sum of confidences) for a voxel to count as observed. Default: 0.001 for each frame, at most
    0.01: what many frames see is seen well by some of them."""
    agreement: Annotated[float, Range(0.01, 10_000)] = 6.65
    """A depth map confirms a vertex within this many times the detail (0.08 mm at 12 um); nearer ones have more
    weight."""
    min_maps: Annotated[int, Range(1, 10_000)] = 2
    """Number of depth maps that must confirm a vertex."""
    finer_bends: bool | None = None
    """Vertices at half the spacing where the surface bends by more than 20 degrees from vertex to vertex, as at edges.
    Default: yes, but not for a draft."""

    def voxel_for(self, detail_mm: float) -> float:
        """Spacing of the grid for a handpiece, mm."""
        return 4.16 * detail_mm if self.voxel_mm is None else self.voxel_mm

    def least_weight_for(self, frames: int) -> float:
        """Minimum weight of a voxel where there are so many frames."""
        return min(0.001 * frames, 0.01) if self.min_weight is None else self.min_weight

    def resolve(self, detail_mm: float, footprint_mm: float) -> FusionOptions:
        """The options with the voxel size for a handpiece, whose footprint may be less than its detail.

        Depths that scatter determine a slope to scatter / distance, averaged over (distance / footprint)**2 pixels:
        with a spacing like the square root of both the mesh is not rougher than one whose detail is the footprint. They
        are blended as far from the surface as they scatter.
        """
        if self.voxel_mm is not None or detail_mm <= footprint_mm:
            return self
        finer = float(np.sqrt(footprint_mm / detail_mm))
        return replace(
            self, voxel_mm=finer * self.voxel_for(detail_mm), truncation_voxels=self.truncation_voxels / finer
        )


def fuse(
    depth_maps: Iterable[DepthMap],
    rig_from_world: Mapping[str, Rigid3],
    detail_mm: float,
    options: FusionOptions | None = None,
    *,
    progress: Progress = silent,
) -> Fused:
    """One coloured mesh in the world frame from the depth maps of located frames; without faces if they contain
    nothing.

    ``detail_mm`` is the detail that the handpiece shows (:func:`cuspid.model.pairing.detail_mm`), the unit of lengths.
    ``depth_maps`` is iterated twice and may read its items lazily, so it must not be a generator, which is exhausted
    after the first pass. The maps of a frame must be consecutive. The same maps in the same order give the same mesh.
    """
    options = options or FusionOptions()
    return _votes(depth_maps, rig_from_world, detail_mm, options, "fusion", progress).outcome(options.min_maps)


def find_holes(
    depth_maps: Iterable[DepthMap],
    rig_from_world: Mapping[str, Rigid3],
    detail_mm: float,
    options: FusionOptions | None = None,
    *,
    progress: Progress = silent,
) -> SurfacePoints:
    """Places on the rims of the holes of the mesh that :func:`fuse` would give on a grid of twice the spacing. Same
    arguments as there."""
    options = options or FusionOptions()
    coarse = replace(options, voxel_mm=2 * options.voxel_for(detail_mm), finer_bends=False)
    votes = _votes(depth_maps, rig_from_world, detail_mm, coarse, "holes", progress)
    mesh = votes.outcome(options.min_maps).mesh
    rims = hole_rims(mesh)
    return SurfacePoints(mesh.vertices[rims], mesh.vertex_normals[rims])


def _votes(
    depth_maps: Iterable[DepthMap],
    rig_from_world: Mapping[str, Rigid3],
    detail_mm: float,
    options: FusionOptions,
    stage: str,
    progress: Progress,
) -> Votes:
    """What the depth maps say about the rough mesh that they blend to."""
    voxel_mm = options.voxel_for(detail_mm)
    jump_mm, agreement_mm = options.max_jump * detail_mm, options.agreement * detail_mm
    volume = SparseVolume(voxel_mm, options.truncation_voxels * voxel_mm)
    half = len(rig_from_world)

    def prepare(one: _Located) -> tuple[int, VolumeUpdate]:
        evidence = Evidence.of(one.depth_map, jump_mm)
        return one.number, volume.prepare_update(evidence, one.cam_from_world, one.points_in_world())

    for batch in map_batches(prepare, _select_located(depth_maps, rig_from_world)):
        volume.integrate([where for _, where in batch])
        progress(stage, batch[-1][0], 2 * half)
    rough = extract(volume, options.least_weight_for(half))
    votes = Votes.empty(
        subdivide_edges(rough, find_bends(rough, _RINGS)) if options.finer_bends is not False else rough
    )
    del volume

    def in_view(one: _Located) -> Voter:
        return votes.in_view(Evidence.of(one.depth_map, jump_mm), one.depth_map, one.cam_from_world, one.number)

    for voters in map_batches(in_view, _select_located(depth_maps, rig_from_world)):
        votes.collect(voters, agreement_mm)
        progress(stage, half + voters[-1].frame, 2 * half)
    return votes


@dataclass(frozen=True, eq=False)
class _Located:
    """A depth map of a located frame."""

    depth_map: DepthMap
    rig_from_world: Rigid3
    number: int
    """Of its frame, from 1 on."""

    @property
    def cam_from_world(self) -> Rigid3:
        """Where its camera was."""
        return self.depth_map.cam_from_rig @ self.rig_from_world

    def points_in_world(self) -> Float[np.ndarray, "n 3"]:
        """What it measured, mm."""
        return self.rig_from_world.inverse().apply(self.depth_map.points_in_rig()[0])


def _select_located(depth_maps: Iterable[DepthMap], rig_from_world: Mapping[str, Rigid3]) -> Iterator[_Located]:
    """Depth maps of located frames."""
    begun: set[str] = set()
    for depth_map in depth_maps:
        if depth_map.frame in rig_from_world:
            begun.add(depth_map.frame)
            yield _Located(depth_map, rig_from_world[depth_map.frame], len(begun))


_USUAL = 3
"""The scatter of a vertex is estimated as if this many more frames had the usual one, because few frames see it."""
_SEVERAL = 1.5
"""The usual scatter is that of vertices with more frames than this."""
_RINGS = 1
"""So many vertices beside a place where the surface bends get finer faces, too."""
_LEAST_FACING = 0.7
"""A depth map that sees a surface turned farther away than this from a vertex (cosine between their normals) sees
another one, as beyond an edge."""
_LEAST_TAN = float(np.sqrt(1 / _LEAST_FACING**2 - 1))
_STEEP = 0.3
"""Depths with a larger standard deviation, in distances of their pixels, have slopes by chance: they may be turned away
by as much more."""
_SIGMAS = 2.0
"""Such depths confirm vertices within so many of their standard deviations."""
_LEAST_FRONTAL = 0.02
"""Votes count as if the camera looked along the surface no more than this (cosine)."""
CHUNK = 256
"""Number of vertices that are tested together for being in the view of a depth map."""


class Voter(NamedTuple):
    """A depth map, and the vertices that it may see, for a kernel."""

    evidence: Evidence
    """What it says."""
    rotation: Float[np.ndarray, "3 3"]
    """Of ``cam_from_world``, as ``translation``."""
    translation: Float[np.ndarray, "3"]
    chunks: Int[np.ndarray, "k"]
    """Numbers of the chunks of vertices in its view."""
    colors: UInt8[np.ndarray, "p 3"]
    """RGB by flat pixel index."""
    sigma_mm: Float[np.ndarray, "p"]
    """Standard deviation of its depth, by flat pixel index; 0 if it states none, NaN where it has no depth itself."""
    frame: int
    """Number of its frame, starting from 1."""


class _Tally(NamedTuple):
    """Sums of what depth maps say about each vertex, which a kernel adds to."""

    moment: Float[np.ndarray, "v 3"]
    """Sum of weights, and of weights times distance along the vertex normal (mm) and its square."""
    color: Float[np.ndarray, "v 3"]
    """Sum of weights times RGB."""
    maps: Int[np.ndarray, "v"]
    """Number of depth maps that confirm the vertex."""
    measured: Bool[np.ndarray, "v"]
    """Whether one of them has a depth there itself; others may only extrapolate from nearby depths."""
    last: Int[np.ndarray, "v"]
    """The last frame that confirms it: the maps of a frame are consecutive."""
    frames: Float[np.ndarray, "v 2"]
    """Sum of the weights of that frame, and the sum of the squares of such sums of all frames."""
    stated: Float[np.ndarray, "v"]
    """Largest inverse variance (1/mm^2) that one of them states; 0 where none states any."""

    @staticmethod
    def empty(count: int) -> _Tally:
        """Of so many vertices."""
        maps, last = np.zeros((2, count), dtype=np.int64)
        return _Tally(
            moment=np.zeros((count, 3)),
            color=np.zeros((count, 3)),
            maps=maps,
            measured=np.zeros(count, dtype=bool),
            last=last,
            frames=np.zeros((count, 2)),
            stated=np.zeros(count),
        )


@dataclass(eq=False)
class Votes:
    """What the depth maps say about each vertex of a rough mesh. Not frozen: it is an accumulator."""

    rough: Mesh
    """The zero level of the volume."""
    balls: Float[np.ndarray, "c 4"]
    """Centre and radius (mm) of a ball around each chunk of consecutive vertices, which lie close together."""
    tally: _Tally
    """The votes so far."""

    @staticmethod
    def empty(rough: Mesh) -> Votes:
        """An empty tally for a mesh."""
        count = len(rough.vertices)
        chunks = [rough.vertices[start : start + CHUNK] for start in range(0, count, CHUNK)]
        balls = np.zeros((len(chunks), 4))
        for ball, chunk in zip(balls, chunks, strict=True):
            ball[:3] = (chunk.min(axis=0) + chunk.max(axis=0)) / 2
            ball[3] = np.linalg.norm(chunk - ball[:3], axis=1).max()
        return Votes(rough, balls, _Tally.empty(count))

    def in_view(self, evidence: Evidence, depth_map: DepthMap, cam_from_world: Rigid3, frame: int) -> Voter:
        """A depth map with the vertices that it may see; ``frame`` is the number of its frame, starting from 1."""
        chunks = self._chunks_in_view(depth_map.camera, cam_from_world)
        colors, sigma_mm = colors_of(depth_map), depth_map.sigma_mm.ravel()
        return Voter(evidence, cam_from_world.rotation, cam_from_world.translation, chunks, colors, sigma_mm, frame)

    def collect(self, voters: Sequence[Voter], agreement_mm: float) -> None:
        """Let depth maps vote, one after the other, on the vertices that they see."""
        vertices, normals = self.rough.vertices, self.rough.vertex_normals

        def work(share: int, shares: int) -> None:
            for voter in voters:
                _vote(voter, vertices, normals, agreement_mm, self.tally, share, shares)

        run_in_shares(work)

    def _chunks_in_view(self, camera: Camera, cam_from_world: Rigid3) -> Int[np.ndarray, "k"]:
        """Chunks whose ball meets the pyramid of view (a few more, never less)."""
        centres, radii = cam_from_world.apply(self.balls[:, :3]), self.balls[:, 3]
        corners = camera.rays(
            np.array([[0.0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]])
        )
        inward = np.cross(corners, np.roll(corners, -1, axis=0))
        inward /= np.linalg.norm(inward, axis=1, keepdims=True)
        return np.flatnonzero((centres @ inward.T > -radii[:, None]).all(axis=1))

    def outcome(self, min_maps: int) -> Fused:
        """The mesh with its vertices at the mean of the depth maps, coloured, without what too few maps confirm."""
        tally = self.tally
        total = np.maximum(tally.moment[:, :1], 1e-12)
        vertices = self.rough.vertices + self.rough.vertex_normals * tally.moment[:, 1:2] / total
        colors: UInt8[np.ndarray, "v 3"] = np.rint(tally.color / total).clip(0, 255).astype(np.uint8)
        confirmed = (tally.maps >= min_maps) & tally.measured
        kept = confirmed[self.rough.faces].all(axis=1)
        used = used_vertices(self.rough.faces[kept], len(self.rough.vertices))
        return Fused(Mesh(vertices, self.rough.faces, colors).submesh(kept), self._sigma_mm()[used])

    def _sigma_mm(self) -> Float[np.ndarray, "v"]:
        moment, stated = self.tally.moment, self.tally.stated
        mean, square = (moment[:, 1:] / np.maximum(moment[:, :1], 1e-12)).T
        variance = np.maximum(square - mean**2, 0)
        # As many frames of equal weight (L. Kish, Survey Sampling, 1965).
        frames = np.maximum(moment[:, 0] ** 2 / np.maximum(self.tally.frames[:, 1], 1e-24), 1)
        several = frames > _SEVERAL
        observed = variance[several] * frames[several] / (frames[several] - 1)
        usual = np.median(observed) if len(observed) else np.where(stated > 0, 1 / np.maximum(stated, 1e-24), 0)
        return np.asarray(np.sqrt((frames * variance + _USUAL * usual) / (frames - 1 + _USUAL) / frames))


@kernel
@no_type_check
def _vote(voter, vertices, normals, agreement, tally, share, shares):
    """Each vertex of a share of the chunks that a depth map sees from its outer side and near its surface gets the
    map's vote."""
    evidence, rotation, translation, chunks, colors, sigma, frame = voter
    moment, color, maps, measured, last, frames, stated = tally
    seen, x, normal = np.zeros(6), np.zeros(3), np.zeros(3)
    for chunk in chunks:
        if chunk % shares != share:
            continue
        for n in range(chunk * CHUNK, min((chunk + 1) * CHUNK, vertices.shape[0])):
            for k in range(3):
                x[k], normal[k] = translation[k], 0
                for m in range(3):
                    x[k] += rotation[k, m] * vertices[n, m]
                    normal[k] += rotation[k, m] * normals[n, m]
            if x[2] <= 0 or not observe(evidence, x[0], x[1], x[2], seen):
                continue
            distance = seen[0]
            facing = normal[0] * seen[2] + normal[1] * seen[3] + normal[2] * seen[4]
            scatter, within, least_facing = sigma[int(seen[5])], agreement, _LEAST_FACING
            steep = scatter * evidence.intrinsics[0] / (x[2] * _STEEP)
            if steep > 1:  # false where it is not known
                within = max(agreement, _SIGMAS * scatter)
                least_facing = 1 / np.hypot(1.0, steep * _LEAST_TAN)
            if abs(distance) >= within or facing < least_facing:
                continue
            closeness = 1 - (distance / within) ** 2
            # Seen along the surface, the pixel of a vertex beside an edge shows mostly the other side of the edge.
            frontal = -(x[0] * normal[0] + x[1] * normal[1] + x[2] * normal[2])
            frontal = max(frontal / np.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2]), _LEAST_FRONTAL)
            weight = seen[1] * frontal * (facing * facing * closeness) ** 2
            moment[n, 0] += weight
            # A vertex outside of the surface moves against its normal.
            moment[n, 1] -= weight * distance / facing
            moment[n, 2] += weight * (distance / facing) ** 2
            for channel in range(3):
                color[n, channel] += weight * colors[int(seen[5]), channel]
            maps[n] += 1
            if not np.isnan(scatter):
                measured[n] = True
                if scatter > 0:
                    stated[n] = max(stated[n], 1 / (scatter * scatter))
            if last[n] != frame:
                last[n], frames[n, 0] = frame, 0
            frames[n, 1] += (2 * frames[n, 0] + weight) * weight
            frames[n, 0] += weight
