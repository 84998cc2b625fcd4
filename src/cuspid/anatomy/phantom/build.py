"""A procedural dental arch: teeth and their gum as one watertight mesh with an FDI number for each face.

The teeth are placed by `arrangement`, their crowns are implicit surfaces (`crowns`, `dentition`), and so is the `gum`
they stand in; the `solid` is their union. Frames: see `arrangement`.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from cuspid.anatomy.edges import neighbours_of
from cuspid.anatomy.phantom.arrangement import PlacedTooth, place_teeth, vary_teeth
from cuspid.anatomy.phantom.gum import Gum
from cuspid.anatomy.phantom.isosurface import (
    evaluate,
    mesh_of,
    newton_step,
    prevent_folds,
    project_to_surface,
    value_and_gradient,
)
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.anatomy.phantom.solid import Solid
from cuspid.anatomy.phantom.surface_points import landmarks_of, papilla
from cuspid.anatomy.teeth.crowns import Points
from cuspid.geometry.graph import parts_of
from cuspid.model.jaw import Jaw, Landmark
from cuspid.model.mesh import Mesh, edges_of


def build_phantom(options: PhantomOptions = PhantomOptions()) -> Jaw:
    """The phantom jaw for the given options, with its landmarks; the same options give the same jaw.

    Raises:
        InputError: a tooth that is not there is named, or the asked dimensions cannot be met together.
    """
    solid = _solid(options)
    landmarks = landmarks_of(solid, options.arch)
    vertices, faces = mesh_of(solid.distance, *solid.bounds, options.edge_mm)
    vertices = _snap_to_margin(solid, vertices, faces, options.edge_mm)
    labels = _connect_labels(faces, solid.labels(vertices[faces].mean(axis=1)))
    vertices = _snap_to_points(vertices, faces, np.array([landmark.position for landmark in landmarks.values()]))
    return Jaw(mesh=Mesh(vertices, faces), face_labels=labels, arch=options.arch, landmarks=landmarks)


def phantom_landmarks(options: PhantomOptions = PhantomOptions()) -> dict[str, Landmark]:
    """The landmarks that `build_phantom` gives the jaw, without the costly mesh.

    Raises:
        InputError: as `build_phantom`.
    """
    return landmarks_of(_solid(options), options.arch)


def phantom_teeth(options: PhantomOptions = PhantomOptions()) -> tuple[PlacedTooth, ...]:
    """The teeth of the phantom and where they stand, from the last one at X < 0 to the last at X > 0."""
    return _solid(options).teeth


def _solid(options: PhantomOptions) -> Solid:
    """Teeth and gum."""
    rng = np.random.default_rng(options.seed)
    individuals = vary_teeth(options, rng)
    waves = Gum.random_waves(rng)

    def add_gum(teeth: tuple[PlacedTooth, ...]) -> Solid:
        return Solid(teeth=teeth, gum=Gum.from_teeth(teeth, waves))

    return add_gum(place_teeth(options, individuals, lambda teeth: papilla(add_gum(teeth), options.arch)))


def _snap_to_points(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], points: Points
) -> Float[np.ndarray, "v 3"]:
    """The vertices, of which those next to the points are moved to them: the surface has sharp grooves and corners,
    which a mesh would cut off."""
    near = cKDTree(vertices).query(points, 4)[1]
    for candidates in near.T:
        left = (vertices[near] != points[:, None]).any(axis=2).all(axis=1)
        moved = vertices.copy()
        moved[candidates[left]] = points[left]
        vertices = prevent_folds(vertices, moved, faces)
    return vertices


# The labels


def _snap_to_margin(
    solid: Solid, vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], edge_mm: float
) -> Float[np.ndarray, "v 3"]:
    """Vertices beside the margin of the gum moved onto it, so that edges run along it."""
    lead = evaluate(solid.lead_of_gum, vertices)
    ends = edges_of(faces)
    ends = ends[lead[ends[:, 0]] * lead[ends[:, 1]] < 0]
    nearer = np.abs(lead[ends[:, 0]]) < np.abs(lead[ends[:, 1]])
    beside = np.unique(np.where(nearer, ends[:, 0], ends[:, 1]))
    moved = vertices.copy()
    moved[beside] = _slide_to_margin(solid, vertices[beside], 0.4 * edge_mm)
    return prevent_folds(vertices, moved, faces)


def _slide_to_margin(solid: Solid, points: Points, limit_mm: float) -> Points:
    """Points (n, 3) of the surface moved within it towards the margin of the gum."""
    values, slope = value_and_gradient(solid.lead_of_gum, points)
    _, normal = value_and_gradient(solid.distance, points)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)
    tangential = slope - (slope * normal).sum(axis=1, keepdims=True) * normal
    return project_to_surface(solid.distance, newton_step(points, values, tangential, limit_mm), limit_mm)


def _connect_labels(faces: Int[np.ndarray, "f 3"], labels: Int[np.ndarray, "f"]) -> Int[np.ndarray, "f"]:
    """Labels (f,) of which each is one connected patch: specks take the label that surrounds them."""
    pairs = neighbours_of(faces)
    for _ in range(3):
        same = pairs[labels[pairs[:, 0]] == labels[pairs[:, 1]]]
        patch = parts_of(same, len(faces))
        size = np.bincount(patch)
        largest = np.zeros(labels.max() + 1, dtype=np.int64)
        np.maximum.at(largest, labels, size[patch])
        speck = size[patch] < largest[labels]
        if not speck.any():
            break
        border = pairs[speck[pairs[:, 0]] & ~speck[pairs[:, 1]]]
        source = np.full(len(size), -1)
        source[patch[border[:, 0]]] = labels[border[:, 1]]
        labels = np.where(speck & (source[patch] >= 0), source[patch], labels)
    return labels
