"""What is recovered from the images: depth maps and located frames."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import reduce
from itertools import pairwise
from operator import add
from types import MappingProxyType

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import cKDTree

from cuspid.geometry import Rigid3, read_only
from cuspid.model.camera import Camera
from cuspid.model.capture import Dropped
from cuspid.model.rig import Rig
from cuspid.runtime.workers import map_slices

_NEAREST = 4
"""Number of nearest points from which a vertex is judged."""
_AT_ONCE = 50_000
"""Vertices that are judged together; the nearest points of millions would take gigabytes."""


@dataclass(frozen=True, kw_only=True)
class Funnel:
    """How many pixels of depth maps are left from step to step."""

    pixels: int
    """Those of the images that are not masked out, on the grid."""
    begun: int
    """Of these, with an initial depth from a pair of views."""
    matched: int
    """With a depth from all views."""
    agreed: int
    """With a depth that is certain enough, and that other views agree with."""
    kept: int
    """In connected pieces that are large enough."""

    def __add__(self, other: Funnel) -> Funnel:
        return Funnel(**{each.name: getattr(self, each.name) + getattr(other, each.name) for each in fields(Funnel)})

    def with_kept(self, kept: int) -> Funnel:
        """Where so many have a depth in the end, some of them from elsewhere."""
        at_least = {name: max(getattr(self, name), kept) for name in ("begun", "matched", "agreed")}
        return replace(self, **at_least, kept=kept)

    @property
    def shares_pct(self) -> dict[str, float]:
        """What is left at each step, % of the pixels."""
        whole = max(self.pixels, 1)
        return {name: round(100 * getattr(self, name) / whole, 2) for name in ("begun", "matched", "agreed", "kept")}

    @property
    def narrowest(self) -> str:
        """The step that takes the largest share of what the one before left."""
        steps = [each.name for each in fields(Funnel)]
        left = [getattr(self, after) / max(getattr(self, before), 1) for before, after in pairwise(steps)]
        return steps[1 + left.index(min(left))]

    @property
    def summary(self) -> str:
        """One line for the user."""
        begun, matched, agreed, kept = self.shares_pct.values()
        return (
            f"of the pixels, {begun:.3g} % have an initial depth, {matched:.3g} % a matched one, {agreed:.3g} % one "
            f"that other views agree with, {kept:.3g} % one in a large enough piece"
        )


def sum_funnels(funnels: Iterable[Funnel | None]) -> Funnel | None:
    """Sum of the funnels of several depth maps; None if none of them has one."""
    known = [funnel for funnel in funnels if funnel is not None]
    return reduce(add, known) if known else None


@dataclass(frozen=True, eq=False, kw_only=True)
class DepthMap:
    """Depth along the axis of a (virtual, distortion-free) camera that is fixed in the rig."""

    frame: str
    """Name of the frame."""
    camera_name: str
    """Name of the reference camera in the rig (for messages and file names)."""
    camera: Camera
    """Distortion-free pinhole camera whose pixels ``depth_mm`` has; may be coarser than the image."""
    cam_from_rig: Rigid3
    """Its pose in the rig."""
    depth_mm: Float[np.ndarray, "h w"]
    """Z of the surface at each pixel centre, NaN where unknown. float32."""
    confidence: Float[np.ndarray, "h w"]
    """0 (unknown) to 1: a weight like an inverse variance, relative to the best pixels. float32."""
    color: UInt8[np.ndarray, "h w 3"] | None = None
    """RGB seen at each pixel."""
    funnel: Funnel | None = None
    """How many of its pixels were left from step to step."""
    best_mm: float | None = None
    """Standard deviation of a depth that has confidence 1; None where none is stated."""

    def __repr__(self) -> str:
        height, width = self.depth_mm.shape
        share = f"{self.known.mean():.0%} known"
        return f"DepthMap(frame {self.frame}, camera {self.camera_name}, {width} x {height} px, {share})"

    @property
    def known(self) -> Bool[np.ndarray, "h w"]:
        """The pixels that have a depth."""
        return np.asarray(np.isfinite(self.depth_mm) & (self.confidence > 0))

    @property
    def sigma_mm(self) -> Float[np.ndarray, "h w"]:
        """Standard deviation of each depth, 0 if none is stated; NaN where the depth is unknown. float32."""
        best_mm = np.float32(self.best_mm or 0)
        return np.where(self.known, best_mm / np.sqrt(np.where(self.known, self.confidence, 1)), np.float32(np.nan))

    def points_in_rig(self) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "n"]]:
        """Known points in the rig frame (mm) and their flat pixel indices."""
        known = np.flatnonzero(self.known)
        rays = self.camera.rays(self.camera.pixel_centres().reshape(-1, 2)[known])
        in_cam = rays * self.depth_mm.ravel()[known, None].astype(np.float64)
        return self.cam_from_rig.inverse().apply(in_cam), known


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points on a surface, with its normals there."""

    points: Float[np.ndarray, "p 3"]
    """In the world frame, mm."""
    normals: Float[np.ndarray, "p 3"]
    """Outward unit normals."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Tracks:
    """Sparse points and where they were seen."""

    points: Float[np.ndarray, "p 3"]
    """World positions, mm; in a :class:`cuspid.model.sparse_model.SparseModel`, in its own units."""
    colors: UInt8[np.ndarray, "p 3"]
    """RGB."""
    point_index: Int[np.ndarray, "o"]
    """For each observation: which point."""
    frame_index: Int[np.ndarray, "o"]
    """For each observation: which frame, an index into the ``frames`` of the owner."""
    camera_index: Int[np.ndarray, "o"]
    """For each observation: which camera, an index into ``rig.names``."""
    pixels: Float[np.ndarray, "o 2"]
    """For each observation: the place, in px of the (distorted) image."""


def concatenate_tracks(first: Tracks, second: Tracks) -> Tracks:
    """The points and observations of both."""
    joined = {each.name: np.concatenate([getattr(t, each.name) for t in (first, second)]) for each in fields(Tracks)}
    joined["point_index"][len(first.point_index) :] += len(first.points)
    return Tracks(**joined)


def select_tracks(tracks: Tracks, which: Bool[np.ndarray, "o"]) -> Tracks:
    """Some of the observations, and the points that are seen in them."""
    kept, number = np.unique(tracks.point_index[which], return_inverse=True)
    return Tracks(
        points=tracks.points[kept],
        colors=tracks.colors[kept],
        point_index=number.astype(np.int64),
        frame_index=tracks.frame_index[which],
        camera_index=tracks.camera_index[which],
        pixels=tracks.pixels[which],
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class Refinement:
    """How far the images moved the calibration, and what remains uncertain."""

    rms_sigmas: float
    """RMS change of all free parameters, in standard deviations of the given covariance; if that is right, 1 or less:
    parameters that no image determines stay where they were."""
    camera_sigmas: Mapping[str, float]
    """The same for each camera."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "camera_sigmas", MappingProxyType(dict(self.camera_sigmas)))

    @property
    def summary(self) -> str:
        """One line for the user."""
        name, most = max(self.camera_sigmas.items(), key=lambda item: item[1])
        return (
            f"refined by {self.rms_sigmas:.2f} of its standard deviations from the file (root mean square; at most "
            f"{most:.2f}, for camera {name})"
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Expectation:
    """How far the surface may be off, according to poses and calibration."""

    points: Float[np.ndarray, "n 3"]
    """Some of the sparse points, mm in the world frame."""
    covariance: Float[np.ndarray, "n 3 3"]
    """Covariance of each of them, mm^2, once all are fitted to the truth by a rigid motion, as an evaluation does. The
    error of the point's own keypoints is not included."""
    scale_sigma_ppm: float
    """Standard deviation of the scale; a surface that lies too far out everywhere is not included."""
    span_mm: float
    """Length of the scan along its longest axis, between the centres of its two ends."""
    span_sigma_um: float
    """Standard deviation of that length."""

    def __post_init__(self) -> None:
        for name in ("points", "covariance"):
            object.__setattr__(self, name, read_only(np.asarray(getattr(self, name), dtype=np.float64)))

    @property
    def is_exact(self) -> bool:
        """Whether neither poses nor calibration add anything."""
        return not self.covariance.any()

    def sigma_mm(self, vertices: Float[np.ndarray, "v 3"], normals: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v"]:
        """Standard deviation of vertices nearby, along their normals: that of the nearest points (mean variance)."""
        tree = cKDTree(self.points)

        def variance(part: slice) -> Float[np.ndarray, "n"]:
            _, nearest = tree.query(vertices[part], k=min(_NEAREST, len(self.points)))
            covariance = self.covariance[nearest.reshape(len(nearest), -1)].mean(axis=1)
            return np.asarray(np.einsum("vi,vij,vj->v", normals[part], covariance, normals[part]))

        return np.sqrt(np.concatenate(map_slices(variance, len(vertices), 1 + len(vertices) // _AT_ONCE)))


@dataclass(frozen=True, eq=False, kw_only=True)
class Reconstruction:
    """Located frames, in millimetres unless ``has_scale`` is False. The world frame is the rig frame of the first
    located frame."""

    rig: Rig
    """Refined calibration (the given one if it was held fixed)."""
    refinement: Refinement | None = None
    """What was refined of it; None if it was held fixed."""
    expectation: Expectation | None = None
    """Expected accuracy of the surface; None if the frames were not located by cuspid's own adjustment."""
    rig_from_world: Mapping[str, Rigid3]
    """Pose of each located frame, in the order of capture."""
    tracks: Tracks | None = None
    """Sparse model, if features were used."""
    dropped: tuple[Dropped, ...] = ()
    """What was left out, each with its reason."""
    pose_covariance: Float[np.ndarray, "n 6 6"] | None = None
    """Covariance of each pose, relative to the first frame: of a small motion (rotation vector rad, translation mm) on
    the left of ``rig_from_world``."""
    reprojection_rms_px: float | None = None
    """RMS reprojection error of the sparse model."""
    has_scale: bool = True
    """False where the scale is unknown, as for the photographs of one camera: lengths are then in an arbitrary unit,
    whatever the names of the fields say."""
    log: Mapping[str, float | int] = field(default_factory=dict)
    """Counts, and durations of the stages in seconds; units are in the keys."""
    notes: tuple[str, ...] = ()
    """What a user must know about it, one line each; empty if nothing is doubtful."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "rig_from_world", MappingProxyType(dict(self.rig_from_world)))

    def __repr__(self) -> str:
        frames = f"{len(self.frames)} frames, {len(self.dropped)} left out"
        points = "no points" if self.tracks is None else f"{len(self.tracks.points):,} points"
        return f"Reconstruction({frames}, {points}, {'mm' if self.has_scale else 'no scale'}, {self.rig})"

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the located frames."""
        return tuple(self.rig_from_world)

    @property
    def told_by(self) -> str:
        """What ``expectation`` follows from: surfaces, unlike tracks, say nothing about the calibration."""
        return "poses alone" if self.tracks is None else "poses and calibration"

    def with_cameras_as(self, names: Sequence[str]) -> Reconstruction:
        """The same reconstruction with its cameras in another order."""
        tracks = self.tracks
        if tracks is not None:
            place = np.array([names.index(name) for name in self.rig.names])
            tracks = replace(tracks, camera_index=place[tracks.camera_index])
        return replace(self, rig=Rig({name: self.rig[name] for name in names}), tracks=tracks)
