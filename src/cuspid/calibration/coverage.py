"""What the views of a board still lack for a calibration, reported while they are taken.

A lens is known where corners were seen, focal lengths by tilted views, and both by views from several distances; places
of cameras by boards that they saw together. The lenses are not known yet: tilts and distances are read from the plane
homography of each view, with the focal length that all views of a camera suggest, and without distortion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Float, Int

from cuspid.calibration.corners import BoardView, pieces
from cuspid.calibration.start import groups
from cuspid.model.board import Target
from cuspid.runtime.options import Options, Range

CELLS = 6
"""Number of cells along each side of an image."""
SIDES = ("left", "right", "top", "bottom")
"""Which side of the board, as the image shows it, is nearer to the camera."""
_ROWS, _COLUMNS = ("top", "middle", "bottom"), ("left", "centre", "right")
_MOST_TILT_DEG = 75.0
"""Beyond, no corner is exact."""
_USUAL, _SHORTEST, _LONGEST = 1.0, 0.2, 5.0
"""Focal lengths, in widths of the image."""
_LEAST_TOLD = 1e-3
"""What views that face the camera tell of its focal length is noise."""


@dataclass(frozen=True, kw_only=True)
class CoverageOptions(Options):
    """When views are enough."""

    views: Annotated[int, Range(3, 10_000)] = 12
    """Different views of each camera."""
    views_of_cell: Annotated[int, Range(1, 1000)] = 2
    """Views that must show corners in each of 6 x 6 parts of the image."""
    views_of_tilt: Annotated[int, Range(0, 1000)] = 2
    """Views with each of the four sides of the board nearer."""
    min_tilt_deg: Annotated[float, Range(1, 70)] = 18.0
    """Tilt from which one side of the board counts as nearer."""
    distance_ratio: Annotated[float, Range(1, 100)] = 1.2
    """How much farther the farthest view must be than the nearest."""
    shared_instants: Annotated[int, Range(1, 10_000)] = 5
    """Instants that two cameras must share to be joined; all must be, by a chain of neighbours."""
    move_share: Annotated[float, Range(0, 1)] = 0.03
    """How far the board must have moved for a different view, as a share of the width of the image."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraCoverage:
    """What one camera has seen of the board."""

    size: tuple[int, int]
    """Width and height of its images, px."""
    views: int = 0
    """Number of different views."""
    cells: Int[np.ndarray, "6 6"] = field(default_factory=lambda: np.zeros((CELLS, CELLS), dtype=np.int64))
    """Number of views with corners in each part of the image, row by row."""
    homographies: tuple[Float[np.ndarray, "3 3"], ...] = ()
    """Of each view, from the board to the image (:func:`homography_of`)."""
    last: BoardView | None = None
    """The latest different view."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Coverage:
    """What the cameras have seen of the board so far."""

    cameras: Mapping[str, CameraCoverage]
    """By name."""
    shared: Mapping[tuple[str, str], int]
    """For each two cameras, the number of different instants at which both saw the board."""

    @staticmethod
    def of_nothing(sizes: Mapping[str, tuple[int, int]]) -> Coverage:
        """Before the first view, given the sizes of the images."""
        return Coverage(
            cameras={name: CameraCoverage(size=size) for name, size in sizes.items()},
            shared=dict.fromkeys(combinations(sizes, 2), 0),
        )

    def with_instant(self, views: Mapping[str, BoardView | None], board: Target, options: CoverageOptions) -> Coverage:
        """After an instant, given what each camera saw."""
        seen = {name: view for name, view in views.items() if view is not None}
        fresh = {name for name, view in seen.items() if _has_moved(self.cameras[name], view, options)}
        cameras = {
            name: _with_view(each, seen[name], board) if name in fresh else each for name, each in self.cameras.items()
        }
        shared = {
            pair: count + int({*pair} <= seen.keys() and bool({*pair} & fresh)) for pair, count in self.shared.items()
        }
        return Coverage(cameras=cameras, shared=shared)

    def missing(self, options: CoverageOptions) -> dict[str, tuple[str, ...]]:
        """By camera, what its views lack, in a few words each; a camera that lacks nothing is not there."""
        found = {name: tuple(_missing_of(each, options)) for name, each in self.cameras.items()}
        return {name: each for name, each in found.items() if each}

    def apart(self, options: CoverageOptions) -> list[list[str]]:
        """The groups of cameras that are not joined by common views of the board yet; one group where all are."""
        joined = [pair for pair, count in self.shared.items() if count >= options.shared_instants]
        seen = [(name, f"{k}") for k, pair in enumerate(joined) for name in pair]
        return groups(seen, list(self.cameras))

    def is_enough(self, options: CoverageOptions) -> bool:
        """Whether nothing is missing."""
        return not self.missing(options) and len(self.apart(options)) == 1


def focal_px_of(homographies: Sequence[Float[np.ndarray, "3 3"]], width: int) -> float:
    """About the focal length of a camera of square pixels, from homographies between a plane and its image, whose
    origin is the principal point (Z. Zhang, IEEE PAMI 22, 2000, with all else known). Views parallel to the image carry
    no information; where there are no others, that of a usual lens.

    Each gives two equations a s + b = 0 for s = 1 / f^2, of the orthogonality and of the equal length of two axes.
    """
    scaled = [each / np.linalg.norm(each[:2, :2]) for each in homographies]
    a = [(h[:2, 0] @ h[:2, 1], h[:2, 0] @ h[:2, 0] - h[:2, 1] @ h[:2, 1]) for h in scaled]
    b = [(h[2, 0] * h[2, 1], h[2, 0] ** 2 - h[2, 1] ** 2) for h in scaled]
    power = np.sum(np.square(a))
    s = -np.sum(np.multiply(a, b)) / power if power > _LEAST_TOLD else 1 / (_USUAL * width) ** 2
    return float(width * np.clip(1 / (width * np.sqrt(max(s, 1e-12))), _SHORTEST, _LONGEST))


def tilt_of(homography: Float[np.ndarray, "3 3"], focal_px: float) -> tuple[float, str, float]:
    """How far a board is tilted from the image plane, degrees; which of its :data:`SIDES` is nearer; and its distance,
    mm; from a homography between its middle and the principal point."""
    across, down, middle = (homography / [[focal_px], [focal_px], [1]]).T
    if middle[2] < 0:
        across, down, middle = -across, -down, -middle
    unit = np.sqrt(np.linalg.norm(across) * np.linalg.norm(down))
    normal = np.cross(across, down)
    normal = normal / np.linalg.norm(normal) * np.sign(normal @ middle)
    # The inverse of the depth grows in the image along (nx, ny).
    side = ("left", "right")[int(normal[0] > 0)] if abs(normal[0]) > abs(normal[1]) else None
    side = side or ("top", "bottom")[int(normal[1] > 0)]
    return float(np.rad2deg(np.arccos(np.clip(abs(normal[2]), 0, 1)))), side, float(middle[2] / unit)


def homography_of(view: BoardView, board: Target, size: tuple[int, int]) -> Float[np.ndarray, "3 3"] | None:
    """Homography from the board that is seen best (mm, from its middle) to the image (px, from the middle of the
    image); None where the corners do not determine it."""
    part = max(pieces(view, board), key=lambda each: len(each.corner), default=view)
    number = board.board_of(np.arange(len(board.corners)))
    middle = board.corners[number == board.board_of(part.corner)[0], :2].mean(axis=0)
    found, _ = cv2.findHomography(board.corners[part.corner, :2] - middle, part.pixels - np.array(size) / 2)
    return found


def _has_moved(camera: CameraCoverage, view: BoardView, options: CoverageOptions) -> bool:
    """Whether a view differs from the latest one that did."""
    if camera.last is None:
        return True
    _, here, there = np.intersect1d(view.corner, camera.last.corner, return_indices=True)
    if not len(here):
        return True
    moved = np.linalg.norm(view.pixels[here] - camera.last.pixels[there], axis=1)
    return bool(moved.max() >= options.move_share * camera.size[0])


def _with_view(camera: CameraCoverage, view: BoardView, board: Target) -> CameraCoverage:
    column, row = np.clip(np.floor(CELLS * view.pixels / camera.size), 0, CELLS - 1).astype(np.int64).T
    hit = np.zeros((CELLS, CELLS), dtype=np.int64)
    hit[row, column] = 1
    homography = homography_of(view, board, camera.size)
    return CameraCoverage(
        size=camera.size,
        views=camera.views + 1,
        cells=camera.cells + hit,
        homographies=camera.homographies if homography is None else (*camera.homographies, homography),
        last=view,
    )


def _missing_of(camera: CameraCoverage, options: CoverageOptions) -> list[str]:
    lacks = []
    if camera.views < options.views:
        lacks.append(f"{options.views - camera.views} views")
    lacks += [f"corners {place}" for place in _places(camera.cells < options.views_of_cell)]
    focal_px = focal_px_of(camera.homographies, camera.size[0])
    poses = [tilt_of(each, focal_px) for each in camera.homographies]
    sides = [side for tilt_deg, side, _ in poses if options.min_tilt_deg <= tilt_deg <= _MOST_TILT_DEG]
    tilts = [side for side in SIDES if sides.count(side) < options.views_of_tilt]
    if tilts:
        lacks.append(f"tilts with the {' / '.join(tilts)} nearer")
    distances = [distance for _, _, distance in poses]
    if distances and max(distances) < options.distance_ratio * min(distances):
        lacks.append("another distance")
    return lacks


def _places(lacking: np.ndarray) -> Sequence[str]:
    """The ninths of an image in which some part is lacking, in words."""
    ninths = lacking.reshape(3, CELLS // 3, 3, CELLS // 3).any(axis=(1, 3))
    if ninths.all():
        return ["all over the image"]
    named = [f"{_ROWS[row]} {_COLUMNS[column]}" for row, column in np.argwhere(ninths)]
    return [f"at {', '.join(each.replace('middle centre', 'centre') for each in named)}"] if named else []


def coverage_cells(coverage: CameraCoverage, options: CoverageOptions) -> Float[np.ndarray, "6 6"]:
    """How far each part of the image is covered: 0 to 1."""
    return np.minimum(coverage.cells / options.views_of_cell, 1.0)
