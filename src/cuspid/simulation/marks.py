"""What teeth and gums bear besides their shape: dentine that shines through, stained fissures, fillings; stippling.

What teeth bear follows from the shape, by how far a surface that is softened over a length lies above each point:
enamel is thin in the hollows of the chewing surface, at necks and behind front teeth, and thick at cusps and edges, so
that hollows are yellower; and what discolours teeth stays in fissures. Each is a share per vertex, by which a colour
replaces the one below. Gum is stippled where it is attached.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32
from scipy.spatial import cKDTree

from cuspid.model.jaw import GUM, Jaw
from cuspid.model.mesh import Mesh
from cuspid.simulation.scattering import diffuse

_BROAD_MM, _FINE_MM = 2.0, 0.3
"""Lengths over which the surface is softened to tell hollows and fissures."""
_HOLLOW_MM, _FISSURE_MM = (-1.3, 0.6), (0.06, 0.14)
"""Depths below the softened surface from which on dentine shows and stains begin, and where both are full."""
_GUM_MM = 0.5
"""As far from the gum grooves are no fissures."""
_PATCH_MM = 1.2
"""Over which the amount of stain changes."""
_FIRST_PREMOLAR = 4
"""By the last digit of its FDI number."""
_FILLED, _AMALGAM = 0.25, 0.5
"""Share of premolars and molars that are filled, and of fillings that are of amalgam."""
_FILLING, _OFF_CENTRE, _UPWARDS = (0.32, 0.2), 0.1, 0.3
"""Longest and shortest radius of a filling and how far it lies off the middle, as shares of the width of its crown;
cosine of the steepest surface that it covers."""
_THINNEST_MM = 1e-3
"""Crowns are never taken for thinner."""
_FILLING_EDGE = 0.08
"""Width of its edge, as a share of its radius."""
_FREE_MM, _ATTACHED_MM = (0.4, 1.0), (4.0, 6.0)
"""Distances from teeth: where the margin, which is smooth, becomes attached gum, and where that ends."""


@dataclass(frozen=True)
class Marks:
    """What a jaw bears."""

    colours: Float[np.ndarray, "k 3"]
    """Of what is on teeth (linear RGB albedo), from the lowest to the topmost."""
    shares: Float32[np.ndarray, "v k"]
    """How much of each is on a vertex."""
    stippled: Float32[np.ndarray, "v"]
    """How much of the stippling of its material a vertex has."""


DENTINE, STAIN, COMPOSITE, AMALGAM = (0.66, 0.46, 0.21), (0.16, 0.08, 0.03), (0.70, 0.63, 0.49), (0.10, 0.10, 0.11)


def no_marks(mesh: Mesh) -> Marks:
    """None."""
    count = len(mesh.vertices)
    return Marks(np.zeros((0, 3)), np.zeros((count, 0), np.float32), np.zeros(count, np.float32))


def natural_marks(jaw: Jaw, seed: int) -> Marks:
    """Marks as on real teeth; ``seed`` selects which fissures are stained and which teeth are filled."""
    rng, mesh = np.random.default_rng([seed, 15]), jaw.mesh
    dentine = _ramp(hollow_mm(mesh, _BROAD_MM), *_HOLLOW_MM)
    stain = _ramp(hollow_mm(mesh, _FINE_MM), *_FISSURE_MM) * _patches(mesh, rng) * _far_from_gum(jaw)
    shares = np.column_stack([dentine, stain, *_fillings(jaw, rng)])
    return Marks(np.array([DENTINE, STAIN, COMPOSITE, AMALGAM]), shares.astype(np.float32), _attached_gum(jaw))


def hollow_mm(mesh: Mesh, length_mm: float) -> Float[np.ndarray, "v"]:
    """How far the surface, softened over a length, lies above each vertex, along its normal."""
    centred = mesh.vertices - mesh.vertices.mean(axis=0)  # what spreads is found as exactly as it is large
    above = diffuse(mesh, length_mm, centred) - centred
    return np.asarray((above * mesh.vertex_normals).sum(axis=1))


def _ramp(values: Float[np.ndarray, "n"], low: float, high: float) -> Float[np.ndarray, "n"]:
    share = np.clip((values - low) / (high - low), 0, 1)
    return np.asarray(share**2 * (3 - 2 * share))


def _far_from_gum(jaw: Jaw) -> Float[np.ndarray, "v"]:
    on_tooth = np.ones(len(jaw.mesh.vertices))
    if jaw.face_labels is not None:
        on_tooth[jaw.mesh.faces[jaw.face_labels == GUM]] = 0
    return _ramp(diffuse(jaw.mesh, _GUM_MM, on_tooth[:, None])[:, 0], 0.8, 1.0)


def _attached_gum(jaw: Jaw) -> Float32[np.ndarray, "v"]:
    """How much each vertex is of attached gum, which is stippled, 0 to 1: the margin at the teeth and the mucosa far
    from them are smooth."""
    share = np.zeros(len(jaw.mesh.vertices), dtype=np.float32)
    if jaw.face_labels is None or not jaw.teeth:
        return share
    gum = np.unique(jaw.mesh.faces[jaw.face_labels == GUM])
    teeth = np.unique(jaw.mesh.faces[jaw.face_labels != GUM])
    away = cKDTree(jaw.mesh.vertices[teeth]).query(jaw.mesh.vertices[gum], workers=1)[0]
    share[gum] = _ramp(away, *_FREE_MM) * (1 - _ramp(away, *_ATTACHED_MM))
    return share


def _patches(mesh: Mesh, rng: np.random.Generator) -> Float[np.ndarray, "v"]:
    """From 0 to 1, evenly, changing over a millimetre or so."""
    areas = mesh.vertex_areas
    white = rng.normal(size=len(areas)) / np.sqrt(np.where(areas > 0, areas, np.inf))  # some may be in no face
    noise = diffuse(mesh, _PATCH_MM, white[:, None])[:, 0]
    return np.asarray(noise.argsort().argsort() / max(len(noise) - 1, 1))


def _fillings(jaw: Jaw, rng: np.random.Generator) -> list[Float[np.ndarray, "v"]]:
    """Shares of composite and of amalgam."""
    shares = [np.zeros(len(jaw.mesh.vertices)) for _ in range(2)]
    for tooth in jaw.teeth:
        filled, amalgam, turn, *shift = rng.random(5)
        if tooth % 10 < _FIRST_PREMOLAR or filled > _FILLED:
            continue
        vertices = np.unique(jaw.mesh.faces[jaw.tooth_faces(tooth)])
        plan, upwards = jaw.mesh.vertices[vertices, :2], jaw.mesh.vertex_normals[vertices, 2] > _UPWARDS
        width = max(float(np.ptp(plan, axis=0).min()), _THINNEST_MM)
        off = (plan - np.median(plan, axis=0)) / width - _OFF_CENTRE * (np.array(shift) - 0.5)
        cosine, sine = np.cos(np.pi * turn), np.sin(np.pi * turn)
        radius = np.linalg.norm(off @ np.array([[cosine, -sine], [sine, cosine]]) / _FILLING, axis=1)
        inside = _ramp(-radius, -1 - _FILLING_EDGE, -1 + _FILLING_EDGE)
        shares[int(amalgam < _AMALGAM)][vertices] = np.where(upwards, inside, 0)
    return shares
