"""Prepared teeth: cracks, crown preparations and inlays cut into a labelled jaw by exact booleans.

Frame: the occlusal frame of `cuspid.model.jaw`, mm. Each preparation is a tool in the frame of its tooth
(`cuspid.anatomy.preparation.tooth_site`), whose axis is the long axis of the crown and the path of insertion. All tools
are taken away from the jaw; the result is closed (an open scan stays open at its own borders), its new faces carry
labels, and the edge of each preparation is kept as a line on the surface: ``45.margin``, ``46.crack``.

Sources of the defaults:

- Goodacre, Campagni and Aquilino, *Tooth preparations for complete crowns*, J. Prosthet. Dent. 85, 2001: total occlusal
  convergence 10 to 20 degrees, rounded line angles, a supragingival finish line where possible.
- Ivoclar Vivadent, *IPS e.max CAD labside* instructions (all-ceramic crown: occlusal 1.5 mm, shoulder with rounded
  inner edge at least 1.0 mm, 6 degrees; inlay: depth and isthmus at least 1.0 mm, slightly diverging box walls).
- Schriwer et al., *The effect of preparation taper on the resistance to fracture of monolithic zirconia crowns*, Dent.
  Mater. 37, 2021: monolithic crown with 15 degrees of total convergence on a shallow circumferential chamfer of 0.5 mm.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from cuspid.anatomy.booleans import CAVITY, TROUGH, Cut, Tool, close_holes, rim_of, subtract
from cuspid.anatomy.edges import neighbours_of
from cuspid.anatomy.preparation.crack_tool import CrackShape, crack_tool
from cuspid.anatomy.preparation.crown_tool import CrownShape, crown_tool
from cuspid.anatomy.preparation.inlay_tool import InlayShape, inlay_tool
from cuspid.anatomy.preparation.tooth_site import ToothSite, site_of
from cuspid.geometry.graph import parts_of
from cuspid.model.jaw import GUM, Jaw
from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import Options, Range

_OVERLAP_MM = 0.005


@dataclass(frozen=True, kw_only=True)
class CrackOptions(Options):
    """A V-shaped crack that runs mesiodistally over the occlusal surface and over one marginal ridge."""

    width_um: Annotated[float, Range(20, 1000)] = 150.0
    """Width at the surface. Cracks below 100 um are reported to escape conventional diagnosis; the default is
    visible."""
    depth_um: Annotated[float, Range(50, 3000)] = 1000.0
    """Depth along the axis of the tooth (assumption: within the enamel of a molar's occlusal surface)."""
    ridge: Literal["mesial", "distal"] = "mesial"
    """The marginal ridge that it crosses."""


@dataclass(frozen=True, kw_only=True)
class CrownOptions(Options):
    """A preparation for an all-ceramic crown."""

    occlusal_reduction_mm: Annotated[float, Range(0.3, 4)] = 1.5
    """Reduction of the occlusal surface, or of the incisal edge, along the axis."""
    axial_reduction_mm: Annotated[float, Range(0.2, 3)] = 1.2
    """Minimum distance of the walls from the former surface, from 1.2 mm above the finish line upwards."""
    taper_deg: Annotated[float, Range(1, 20)] = 6.0
    """Inclination of each axial wall: half of the total occlusal convergence."""
    finish_line: Literal["shoulder", "chamfer"] = "shoulder"
    """Form of the finish line: a level shoulder with a rounded inner edge, or a chamfer that rises by 30 degrees."""
    finish_width_mm: Annotated[float, Range(0.2, 2)] = 1.0
    """Width of the finish line: from the margin inwards, perpendicular to it, to the line of the axial wall at its
    height."""
    above_gum_mm: Annotated[float, Range(0.2, 3)] = 0.5
    """Height of the finish line above the gum margin. Towards the contacts it rises no more than the cervical line
    of such a tooth; there the papilla is cut back (as it is retracted in the mouth), so that the finish line can be
    seen."""
    edge_radius_mm: Annotated[float, Range(0.1, 1)] = 0.5
    """Rounding between the axial walls and the occlusal surface."""


@dataclass(frozen=True, kw_only=True)
class FullContourCrownOptions(Options):
    """A preparation for a full-contour (monolithic) crown: thinner, following the form of the tooth."""

    occlusal_reduction_mm: Annotated[float, Range(0.3, 4)] = 1.0
    """As for `CrownOptions`."""
    axial_reduction_mm: Annotated[float, Range(0.2, 3)] = 0.5
    """As for `CrownOptions`."""
    taper_deg: Annotated[float, Range(1, 20)] = 7.5
    """As for `CrownOptions`."""
    finish_line: Literal["shoulder", "chamfer"] = "chamfer"
    """As for `CrownOptions`."""
    finish_width_mm: Annotated[float, Range(0.2, 2)] = 0.5
    """As for `CrownOptions`."""
    above_gum_mm: Annotated[float, Range(0.2, 3)] = 0.5
    """As for `CrownOptions`."""
    edge_radius_mm: Annotated[float, Range(0.1, 1)] = 0.3
    """As for `CrownOptions`."""


@dataclass(frozen=True, kw_only=True)
class InlayOptions(Options):
    """A preparation for a mesio-occluso-distal inlay."""

    isthmus_width_mm: Annotated[float, Range(0.8, 6)] = 2.2
    """Buccolingual width of the slot at its floor."""
    pulpal_depth_mm: Annotated[float, Range(0.5, 4)] = 1.8
    """Depth of the slot's floor below the central groove."""
    box_width_mm: Annotated[float, Range(0.8, 8)] = 4.0
    """Buccolingual width of the boxes at their gingival floor; wide enough to clear the contact."""
    gingival_floor_mm: Annotated[float, Range(0.5, 3)] = 1.2
    """Mesiodistal width of the gingival floor, from the proximal surface to the axial wall."""
    box_depth_mm: Annotated[float, Range(0.3, 4)] = 1.2
    """Height of the axial wall: from the pulpal to the gingival floor."""
    divergence_deg: Annotated[float, Range(0, 20)] = 8.0
    """Inclination of each wall; the walls diverge towards occlusal."""
    edge_radius_mm: Annotated[float, Range(0.05, 2)] = 0.3
    """Rounding of the internal edges between walls and floors."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.box_width_mm < self.isthmus_width_mm:
            raise InputError(
                f"inlay: --box-width-mm is {self.box_width_mm:g}; it must not be less than the isthmus width, "
                f"{self.isthmus_width_mm:g} mm"
            )
        if self.edge_radius_mm > self.isthmus_width_mm / 3:
            raise InputError(
                f"inlay: --edge-radius-mm is {self.edge_radius_mm:g}; it must not exceed a third of the isthmus width, "
                f"{self.isthmus_width_mm / 3:.2f} mm"
            )


PreparationOptions = CrackOptions | CrownOptions | FullContourCrownOptions | InlayOptions
"""How one tooth is prepared."""

KINDS: Mapping[str, type[PreparationOptions]] = MappingProxyType(
    {
        "crack": CrackOptions,
        "crown": CrownOptions,
        "full_contour_crown": FullContourCrownOptions,
        "mod_inlay": InlayOptions,
    }
)
"""Options of each kind of preparation."""

PRESETS: Mapping[str, Mapping[int, PreparationOptions]] = MappingProxyType(
    {
        "thesis-reference": MappingProxyType(
            {
                46: CrackOptions(),
                45: CrownOptions(),
                42: FullContourCrownOptions(occlusal_reduction_mm=1.5),
                35: InlayOptions(),
                36: InlayOptions(isthmus_width_mm=2.8, box_width_mm=4.4),
            }
        )
    }
)
"""Prepared jaws by name. ``thesis-reference`` is Fig. 3.20: FDI 46 cracked, 45 prepared for a crown, 42 for a
full-contour crown, 35 and 36 for mesio-occluso-distal inlays."""


def options_of(kind: str) -> PreparationOptions:
    """The default options of a kind. Raises InputError for an unknown one."""
    if kind not in KINDS:
        raise InputError(f"preparation: unknown kind {kind!r}; choose one of {', '.join(KINDS)}")
    return KINDS[kind]()


def preset(name: str) -> Mapping[int, PreparationOptions]:
    """The preparations of a preset. Raises InputError for an unknown one."""
    if name not in PRESETS:
        raise InputError(f"preparation: unknown preset {name!r}; choose one of {', '.join(PRESETS)}")
    return PRESETS[name]


def prepare(jaw: Jaw, preparations: Mapping[int, PreparationOptions]) -> Jaw:
    """The jaw with teeth prepared, by FDI number.

    Landmarks, spheres and lines are kept (a landmark of a prepared tooth says where it was). Lines are added: the
    margin ``<FDI>.margin`` or the rim of the crack ``<FDI>.crack`` (closed, on the surface), and
    ``<FDI>.crack_bottom``.

    Raises InputError where a tooth is not there, a preparation does not fit into it, or the jaw is not a manifold.
    """
    if not preparations:
        raise InputError("preparation: no tooth was named; give a tooth and a kind, or a preset")
    if jaw.face_labels is None:
        raise InputError("preparation: the jaw has no tooth labels; give one with an FDI number for each face")
    sites = {fdi: site_of(jaw, fdi) for fdi in preparations}
    tools = {fdi: _tool(sites[fdi], options) for fdi, options in preparations.items()}
    cut = subtract(
        close_holes(jaw.mesh),
        [(tools[fdi], _blocks(sites[fdi], preparations)) for fdi in preparations],
        [f"tooth {fdi}" for fdi in preparations],
    )
    return _assemble_jaw(jaw, preparations, tools, cut)


def _tool(site: ToothSite, options: PreparationOptions) -> Tool:
    """The tool of a preparation, in the frame of the jaw."""
    match options:
        case CrackOptions():
            shape = CrackShape(width_mm=options.width_um / 1000, depth_mm=options.depth_um / 1000, ridge=options.ridge)
            tool = crack_tool(site, shape)
        case CrownOptions() | FullContourCrownOptions():
            tool = crown_tool(
                site,
                CrownShape(
                    occlusal_mm=options.occlusal_reduction_mm,
                    axial_mm=options.axial_reduction_mm,
                    taper_deg=options.taper_deg,
                    finish_line=options.finish_line,
                    width_mm=options.finish_width_mm,
                    above_gum_mm=options.above_gum_mm,
                    edge_radius_mm=options.edge_radius_mm,
                ),
            )
        case InlayOptions():
            tool = inlay_tool(
                site,
                InlayShape(
                    isthmus_mm=options.isthmus_width_mm,
                    depth_mm=options.pulpal_depth_mm,
                    box_width_mm=options.box_width_mm,
                    box_floor_mm=options.gingival_floor_mm,
                    box_depth_mm=options.box_depth_mm,
                    divergence_deg=options.divergence_deg,
                    edge_radius_mm=options.edge_radius_mm,
                ),
            )
    return tool.in_jaw(site.site_from_jaw.inverse())


def _blocks(site: ToothSite, preparations: Mapping[int, PreparationOptions]) -> list[Mesh]:
    """What a tool must leave alone beyond the borders of its tooth, in the frame of the jaw.

    Where the neighbour is opened too, they overlap by a hair, so that nothing stands between them.
    """
    jaw_from_site = site.site_from_jaw.inverse()
    opened = [not isinstance(preparations.get(border.fdi, CrackOptions()), CrackOptions) for border in site.borders]
    return [
        border.beyond(_OVERLAP_MM if both else 0.0).transformed(jaw_from_site)
        for border, both in zip(site.borders, opened, strict=True)
    ]


def _assemble_jaw(jaw: Jaw, preparations: Mapping[int, PreparationOptions], tools: Mapping[int, Tool], cut: Cut) -> Jaw:
    """The jaw of a cut: labels and lines."""
    assert jaw.face_labels is not None
    order = list(preparations)
    lines = dict(jaw.lines)
    labels = np.full(len(cut.face), -1)
    original = cut.source == -1
    kept = ~original | (cut.face < len(jaw.mesh.faces))
    labels[original & kept] = jaw.face_labels[cut.face[original & kept]]
    for index, fdi in enumerate(order):
        ours = cut.source == index
        marks = np.full(len(cut.face), -1)
        marks[ours] = tools[fdi].marks[cut.face[ours]]
        labels[ours] = np.where(marks[ours] == TROUGH, GUM, fdi)
        name = "crack" if isinstance(preparations[fdi], CrackOptions) else "margin"
        lines[f"{fdi}.{name}"] = _counter_clockwise(rim_of(cut, marks == CAVITY))
        bottom = tools[fdi].line
        if bottom is not None:
            lines[f"{fdi}.{name}_bottom"] = bottom
        standing = (cut.source == -2 - index) | _detached_faces(cut.mesh, (labels == fdi) & kept)
        labels = _facets(cut.mesh, labels, standing, fdi)
    mesh = Mesh(cut.mesh.vertices, cut.mesh.faces).submesh(kept)
    if jaw.mesh.colors is not None:
        _, nearest = cKDTree(jaw.mesh.vertices).query(mesh.vertices)
        mesh = replace(mesh, colors=jaw.mesh.colors[nearest])
    return replace(jaw, mesh=mesh, face_labels=labels[kept], lines=lines)


def _detached_faces(mesh: Mesh, mine: Bool[np.ndarray, "f"]) -> Bool[np.ndarray, "f"]:
    """Faces of a tooth that no longer hang together with most of it: what is left of its side of a contact."""
    pairs = neighbours_of(mesh.faces)
    patch = parts_of(pairs[mine[pairs].all(axis=1)], len(mine))
    return mine & (patch != np.bincount(patch[mine]).argmax())


def _facets(mesh: Mesh, labels: Int[np.ndarray, "f"], facets: Bool[np.ndarray, "f"], fdi: int) -> Int[np.ndarray, "f"]:
    """Labels with those of the faces that a tool left standing beyond its tooth: of the nearest known face there."""
    if not facets.any():
        return labels
    others = np.flatnonzero((labels != -1) & (labels != fdi))
    _, nearest = cKDTree(mesh.face_centres[others]).query(mesh.face_centres[facets])
    labels = labels.copy()
    labels[facets] = labels[others[nearest]]
    return labels


def _counter_clockwise(line: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """A closed line so that it runs counter-clockwise seen from occlusal."""
    x, y = line[:-1, 0], line[:-1, 1]
    area = np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
    return line if area >= 0 else line[::-1]
