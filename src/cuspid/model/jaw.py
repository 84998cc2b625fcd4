"""A jaw: a mesh in the occlusal frame with a tooth number for each face.

Occlusal frame: origin at the arch centroid, occlusal plane = XY, +Z out of the gum, +Y anterior; right-handed, so +X is
the patient's right in a lower jaw and the left in an upper one. Teeth carry FDI numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from cuspid.geometry import read_only
from cuspid.model.mesh import Mesh
from cuspid.runtime.display import Viewable
from cuspid.runtime.errors import InputError

Arch = Literal["lower", "upper"]
ARCHES: tuple[Arch, ...] = ("lower", "upper")
GUM = 0
"""The label of faces that are not a tooth."""

UNIVERSAL_FROM_FDI = {
    **{11 + k: 8 - k for k in range(8)},
    **{21 + k: 9 + k for k in range(8)},
    **{31 + k: 24 - k for k in range(8)},
    **{41 + k: 25 + k for k in range(8)},
}
"""FDI tooth number to the Universal one (permanent teeth)."""

FDI_FROM_UNIVERSAL = {universal: fdi for fdi, universal in UNIVERSAL_FROM_FDI.items()}


@dataclass(frozen=True, eq=False)
class Landmark:
    """A named anatomical point."""

    position: Float[np.ndarray, "3"]
    """In the occlusal frame, mm."""
    estimated_sigma_mm: float | None = None
    """Standard uncertainty (one axis) of a point that was estimated from the surface; None for one that is known
    exactly or was placed by hand."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", read_only(np.asarray(self.position, dtype=np.float64)))


@dataclass(frozen=True, eq=False)
class Sphere:
    """A sphere of a metrology object."""

    centre: Float[np.ndarray, "3"]
    """In the occlusal frame, mm."""
    radius_mm: float
    """Nominal radius."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre", read_only(np.asarray(self.centre, dtype=np.float64)))


@dataclass(frozen=True, eq=False, kw_only=True)
class Jaw(Viewable):
    """What is scanned, or the reference that a scan is evaluated against."""

    mesh: Mesh
    """Surface in the occlusal frame."""
    face_labels: Int[np.ndarray, "f"] | None = None
    """FDI number for each face, 0 for gum; None if the file has no labels."""
    arch: Arch | None = None
    """Upper or lower, where it is known."""
    landmarks: Mapping[str, Landmark] = field(default_factory=dict)
    """By label, ``<FDI>.<point>`` or ``<point>`` (scheme: `cuspid.anatomy.landmarks.scheme`)."""
    lines: Mapping[str, Float[np.ndarray, "_ 3"]] = field(default_factory=dict)
    """Polylines on the surface, mm, by label: ``45.margin`` is the margin line of the preparation of tooth 45; a closed
    one ends at its first point."""
    spheres: Mapping[str, Sphere] = field(default_factory=dict)
    """Spheres of a metrology object, by label."""

    def __post_init__(self) -> None:
        if self.face_labels is not None:
            object.__setattr__(self, "face_labels", read_only(np.asarray(self.face_labels, dtype=np.int64)))
            if len(self.face_labels) != len(self.mesh.faces):
                raise InputError(
                    f"jaw: {len(self.face_labels)} labels for {len(self.mesh.faces)} faces; each face needs exactly one"
                )

    def __repr__(self) -> str:
        named = {"landmarks": self.landmarks, "lines": self.lines, "spheres": self.spheres}
        teeth = "no labels" if self.face_labels is None else f"{len(self.teeth)} teeth"
        also = [f"{len(each)} {what}" for what, each in named.items() if each]
        return f"Jaw({', '.join([self.arch or 'arch unknown', teeth, *also])}, {self.mesh})"

    @property
    def teeth(self) -> tuple[int, ...]:
        """FDI numbers that occur, in ascending order; empty if there are no labels."""
        if self.face_labels is None:
            return ()
        return tuple(int(label) for label in np.unique(self.face_labels) if label != GUM)

    def tooth_faces(self, fdi: int) -> np.ndarray:
        """Boolean mask over the faces of a tooth."""
        if self.face_labels is None or fdi not in self.teeth:
            known = ", ".join(map(str, self.teeth)) or "no labels"
            raise InputError(f"jaw: no tooth {fdi} (FDI); it has {known}")
        return self.face_labels == fdi
