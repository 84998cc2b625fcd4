"""The phantom is one closed surface with the teeth, sizes and shapes that anatomy asks for."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from cuspid.anatomy.landmarks.scheme import labels_of
from cuspid.anatomy.phantom.arrangement import PlacedTooth
from cuspid.anatomy.phantom.build import build_phantom, phantom_landmarks, phantom_teeth
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.anatomy.teeth.crowns import Points
from cuspid.anatomy.teeth.dentition import ARCH_FORMS
from cuspid.model.jaw import GUM, Jaw

COARSE_MM = 0.4
"""Edge length at which the tests mesh the phantom."""

WIDTH_AND_DEPTH_MM = {
    "lower": [(5.0, 6.0), (5.5, 6.5), (7.0, 7.5), (7.0, 7.5), (7.0, 8.0), (11.0, 10.5), (10.5, 10.0)],
    "upper": [(8.5, 7.0), (6.5, 6.0), (7.5, 8.0), (7.0, 9.0), (7.0, 9.0), (10.0, 11.0), (9.0, 11.0)],
}
"""Mesiodistal and buccolingual widths of teeth 1 to 7 in Wheeler's table."""

CUSPS = {
    "lower": {3: {1}, 5: {3}, 6: {5}, 7: {4}},
    "upper": {3: {1}, 4: {2}, 5: {2}, 6: {4}, 7: {4}},
}
"""Number of cusps of each tooth."""


@pytest.fixture(scope="module", params=["lower", "upper"])
def options(request: pytest.FixtureRequest) -> PhantomOptions:
    return PhantomOptions(arch=request.param, edge_mm=COARSE_MM)


@pytest.fixture(scope="module")
def jaw(options: PhantomOptions) -> Jaw:
    return build_phantom(options)


@pytest.fixture(scope="module")
def teeth(options: PhantomOptions) -> dict[int, PlacedTooth]:
    return {tooth.fdi: tooth for tooth in phantom_teeth(options)}


def surface_of(jaw: Jaw, fdi: int) -> Points:
    """The vertices of a tooth."""
    return jaw.mesh.vertices[np.unique(jaw.mesh.faces[jaw.tooth_faces(fdi)])]


def edges_of(jaw: Jaw) -> np.ndarray:
    """Directed edges (3f, 2), face by face."""
    faces = jaw.mesh.faces
    return np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)


def tips_of(jaw: Jaw, tooth: PlacedTooth, radius_mm: float = 1.3) -> Points:
    """The points of a tooth that are the highest of all within a radius, in the upper quarter of the crown."""
    local = tooth.to_tooth(surface_of(jaw, tooth.fdi))
    local = local[local[:, 2] > 0.77 * tooth.tooth.crown.height_mm]
    near = cKDTree(local[:, :2]).query_ball_point(local[:, :2], radius_mm)
    return local[[local[k, 2] >= local[found, 2].max() for k, found in enumerate(near)]]


def top_of(jaw: Jaw, fdi: int) -> np.ndarray:
    """The highest point (3,) of a tooth."""
    surface = surface_of(jaw, fdi)
    return surface[surface[:, 2].argmax()]


def quadrants(options: PhantomOptions) -> tuple[int, int]:
    """The quadrants at X < 0 and X > 0."""
    return (30, 40) if options.arch == "lower" else (10, 20)


@pytest.mark.long
def test_the_surface_is_closed_and_consistently_oriented(jaw: Jaw) -> None:
    edges = edges_of(jaw)
    directed = edges[:, 0] * len(jaw.mesh.vertices) + edges[:, 1]
    reverse = edges[:, 1] * len(jaw.mesh.vertices) + edges[:, 0]
    assert len(np.unique(directed)) == len(directed)
    assert np.array_equal(np.sort(directed), np.sort(reverse))


def test_the_surface_faces_outwards(jaw: Jaw) -> None:
    volume = np.einsum("fk,fk->", jaw.mesh.face_centres, jaw.mesh.face_cross) / 6
    assert 10_000 < volume < 25_000


def test_the_surface_is_one_piece(jaw: Jaw) -> None:
    edges, count = edges_of(jaw), len(jaw.mesh.vertices)
    pieces, _ = connected_components(coo_array((np.ones(len(edges)), edges.T), shape=(count, count)))
    assert pieces == 1


def test_no_face_is_degenerate(jaw: Jaw) -> None:
    assert jaw.mesh.face_areas.min() > 1e-6
    assert 0.3 * COARSE_MM**2 < np.median(jaw.mesh.face_areas) < 0.5 * COARSE_MM**2


def test_the_default_has_at_least_200_000_faces(jaw: Jaw) -> None:
    # The number of faces goes with the inverse square of their edge.
    expected = len(jaw.mesh.faces) * (COARSE_MM / PhantomOptions().edge_mm) ** 2
    assert 250_000 < expected < 800_000


def test_each_of_the_fourteen_teeth_is_one_patch(jaw: Jaw, options: PhantomOptions) -> None:
    assert jaw.teeth == tuple(q + k for q in quadrants(options) for k in range(1, 8))
    edges = edges_of(jaw)
    owner = np.repeat(np.arange(len(jaw.mesh.faces)), 3)
    order = np.lexsort((edges.max(axis=1), edges.min(axis=1)))
    pairs = owner[order].reshape(-1, 2)
    same = pairs[jaw.face_labels[pairs[:, 0]] == jaw.face_labels[pairs[:, 1]]]
    graph = coo_array((np.ones(len(same)), same.T), shape=(len(jaw.mesh.faces),) * 2)
    _, patch = connected_components(graph, directed=False)
    for label in (GUM, *jaw.teeth):
        assert len(np.unique(patch[jaw.face_labels == label])) == 1, label


def test_right_and_left_are_where_the_frame_says(jaw: Jaw, options: PhantomOptions) -> None:
    negative, positive = quadrants(options)
    for k in range(1, 8):
        assert surface_of(jaw, negative + k)[:, 0].mean() < -1.5
        assert surface_of(jaw, positive + k)[:, 0].mean() > 1.5


@pytest.mark.long
def test_the_same_seed_gives_the_same_mesh_and_another_seed_another() -> None:
    one, same, other = (build_phantom(PhantomOptions(seed=seed, edge_mm=1.2)) for seed in (1, 1, 2))
    again = phantom_landmarks(PhantomOptions(seed=1))
    assert all(np.array_equal(again[label].position, one.landmarks[label].position) for label in again)
    assert np.array_equal(one.mesh.vertices, same.mesh.vertices)
    assert np.array_equal(one.face_labels, same.face_labels)
    distance = other.mesh.closest(one.mesh.vertices)[0]
    assert 0.02 < np.median(distance) < 1.0


def test_crowns_have_anatomical_sizes(jaw: Jaw, teeth: dict[int, PlacedTooth], options: PhantomOptions) -> None:
    for fdi, tooth in teeth.items():
        width, depth, height = np.ptp(tooth.to_tooth(surface_of(jaw, fdi)), axis=0)
        expected_width, expected_depth = WIDTH_AND_DEPTH_MM[options.arch][fdi % 10 - 1]
        assert 0.9 * expected_width < tooth.tooth.crown.width_mm < 1.15 * expected_width, fdi
        assert 0.9 * expected_depth < tooth.tooth.crown.depth_mm < 1.1 * expected_depth, fdi
        assert 0.95 < width / tooth.tooth.crown.width_mm < 1.15, fdi
        assert 0.9 < depth / tooth.tooth.crown.depth_mm < 1.05, fdi
        assert 0.75 < height / tooth.tooth.crown.height_mm < 1.05, fdi


def test_canine_width_is_that_of_the_arch_form(jaw: Jaw, options: PhantomOptions) -> None:
    negative, positive = (top_of(jaw, q + 3)[0] for q in quadrants(options))
    assert abs(positive - negative - ARCH_FORMS[options.arch].inter_canine_mm) < 1.0


@pytest.mark.parametrize("molar", [6, 7])
def test_molar_widths_are_those_of_the_arch_form(jaw: Jaw, options: PhantomOptions, molar: int) -> None:
    form = ARCH_FORMS[options.arch]
    target = form.inter_first_molar_mm if molar == 6 else form.inter_second_molar_mm
    inner, outer = (
        sum(np.percentile(abs(surface_of(jaw, q + molar)[:, 0]), share) for q in quadrants(options))
        for share in (50, 100)
    )
    assert inner < target < outer


def test_neighbours_touch(jaw: Jaw, options: PhantomOptions) -> None:
    negative, positive = quadrants(options)
    row = [negative + k for k in range(7, 0, -1)] + [positive + k for k in range(1, 8)]
    for one, other in pairwise(row):
        gap = cKDTree(surface_of(jaw, one)).query(surface_of(jaw, other))[0].min()
        assert 0 <= gap < 0.3, (one, other)


def test_the_frame_is_occlusal(jaw: Jaw, options: PhantomOptions) -> None:
    tops = np.array([top_of(jaw, fdi) for fdi in jaw.teeth])
    assert np.all(abs(tops.mean(axis=0)) < [0.7, 1.5, 0.5])
    tilt = np.linalg.lstsq(np.column_stack([tops[:, :2], np.ones(14)]), tops[:, 2], rcond=None)[0]
    assert np.all(np.degrees(abs(np.arctan(tilt[:2]))) < 1.5)
    assert top_of(jaw, jaw.teeth[0])[1] > 10
    assert jaw.mesh.bounds[0, 2] < -12


def test_the_curve_of_spee_is_one_to_two_millimetres_deep(jaw: Jaw, options: PhantomOptions) -> None:
    outwards = 1 if options.arch == "upper" else -1
    for quadrant in quadrants(options):
        tops = np.array([top_of(jaw, quadrant + k) for k in (1, 4, 5, 6, 7)])
        chord = np.interp(tops[:, 1], tops[[4, 0], 1], tops[[4, 0], 2])
        assert 1.0 < (outwards * (tops[:, 2] - chord)).max() < 2.2


def test_cusps_are_as_many_as_the_tooth_has(jaw: Jaw, teeth: dict[int, PlacedTooth], options: PhantomOptions) -> None:
    for fdi, tooth in teeth.items():
        expected = CUSPS[options.arch].get(fdi % 10)
        if expected:
            assert len(tips_of(jaw, tooth)) in expected, fdi


def test_the_landmarks_are_those_of_the_scheme(jaw: Jaw) -> None:
    assert len(jaw.landmarks) == 72
    assert set(jaw.landmarks) == set(labels_of(jaw.teeth))
    assert all(landmark.estimated_sigma_mm is None for landmark in jaw.landmarks.values())


def test_the_landmarks_lie_on_the_surface(jaw: Jaw) -> None:
    away = jaw.mesh.closest(np.array([landmark.position for landmark in jaw.landmarks.values()]))[0]
    assert away.max() < 0.05


def test_the_landmarks_lie_on_their_tooth(jaw: Jaw) -> None:
    for label, landmark in jaw.landmarks.items():
        if label[0].isdigit():
            assert cKDTree(surface_of(jaw, int(label[:2]))).query(landmark.position)[0] < COARSE_MM, label


def test_the_arch_widths_are_those_of_the_arch_form(jaw: Jaw, options: PhantomOptions) -> None:
    form = ARCH_FORMS[options.arch]
    negative, positive = quadrants(options)
    for position, point, expected in (
        (3, "cusp_tip", form.inter_canine_mm),
        (6, "buccal_groove", form.inter_first_molar_mm),
        (7, "buccal_groove", form.inter_second_molar_mm),
    ):
        ends = [jaw.landmarks[f"{quadrant + position}.{point}"].position for quadrant in (negative, positive)]
        assert abs(np.linalg.norm(ends[1] - ends[0]) - expected) < 0.05
