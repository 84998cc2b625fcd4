"""Sharp convex edges come to lie where their flanks meet; what is round, concave or rough stays as it is."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from builders import any_pose, joined, moved, sphere
from cuspid.fusion.sharp_edges import SharpEdgeOptions, sharpen_edges
from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import InputError
from synthetic_scene import height_field

DETAIL_MM, SPACING_MM, HALF_MM = 0.012, 0.05, 1.0
"""As for the built-in handpieces."""


def roof(depth: Callable[[np.ndarray], np.ndarray], turn: float, shift_mm: float = 0.013) -> Mesh:
    """A surface that only changes across a line, which runs across the grid of its vertices."""
    count = round(2 * HALF_MM / SPACING_MM) + 1
    across = np.cos(turn), np.sin(turn)
    return height_field(lambda x, y: 5 + depth(across[0] * x + across[1] * y + shift_mm), HALF_MM, count)


def edge(slope: float, radius_mm: float = 0.0) -> Callable[[np.ndarray], np.ndarray]:
    """Two flanks, convex for a positive slope, rounded by an arc."""
    reach = radius_mm * abs(slope) / np.hypot(1, slope)

    def depth(t: np.ndarray) -> np.ndarray:
        top = radius_mm * (np.hypot(1, slope) - 1)
        arc = top + radius_mm - np.sqrt(np.maximum(radius_mm**2 - t**2, 0))
        return np.sign(slope) * np.where(np.abs(t) < reach, arc, abs(slope) * np.abs(t))

    return depth


def cut_off_um(mesh: Mesh, turn: float, shift_mm: float = 0.013) -> np.ndarray:
    """Distances of the true edge from the mesh, away from its border."""
    along = np.linspace(-0.6, 0.6, 200)
    line = np.stack([-np.sin(turn) * along, np.cos(turn) * along], axis=1) - shift_mm * np.array(
        [np.cos(turn), np.sin(turn)]
    )
    return 1000 * mesh.closest(np.column_stack([line, np.full(len(line), 5.0)]))[0]


@settings(max_examples=25, deadline=None)
@given(turn=st.floats(0.05, 0.7), slope=st.floats(0.5, 1.0))
def test_faces_do_not_cut_a_sharp_edge_off(turn: float, slope: float) -> None:
    mesh = roof(edge(slope), turn)
    sharp, count = sharpen_edges(mesh, DETAIL_MM)
    assert 15 < count < 80
    before, after = cut_off_um(mesh, turn), cut_off_um(sharp, turn)
    assert before.mean() > 2.0
    assert after.mean() < 0.1 * before.mean()
    assert np.percentile(after, 95) < 0.5
    # Flanks are not changed: what was on the surface is on it still.
    t = np.cos(turn) * sharp.vertices[:, 0] + np.sin(turn) * sharp.vertices[:, 1] + 0.013
    inner = (np.abs(sharp.vertices[:, :2]) < 0.7).all(axis=1)
    assert np.abs(sharp.vertices[inner, 2] - 5 - slope * np.abs(t[inner])).max() < 5e-4


@settings(max_examples=25, deadline=None)
@given(turn=st.floats(0.05, 0.7), slope=st.floats(0.5, 1.5), radius_mm=st.floats(0.2, 0.8))
def test_round_edges_stay_round(turn: float, slope: float, radius_mm: float) -> None:
    mesh = roof(edge(slope, radius_mm), turn)
    sharp, count = sharpen_edges(mesh, DETAIL_MM)
    assert count == 0
    assert sharp is mesh or (sharp.vertices == mesh.vertices).all()


def test_concave_edges_and_smooth_surfaces_are_left_alone() -> None:
    for mesh in (roof(edge(-1.0), 0.3), sphere(0.5, 4), roof(edge(0.2), 0.3)):
        assert sharpen_edges(mesh, DETAIL_MM)[1] == 0


@pytest.mark.parametrize("noise_mm", [0.002, 0.01])
def test_noise_makes_no_edges(noise_mm: float) -> None:
    flat = roof(edge(0.0), 0.3)
    noise = np.random.default_rng(0).normal(0, noise_mm, len(flat.vertices))
    rough = Mesh(flat.vertices + noise[:, None] * [0, 0, 1], flat.faces)
    sharp, count = sharpen_edges(rough, DETAIL_MM)
    assert count <= 0.001 * len(flat.vertices)
    assert np.abs(sharp.vertices[:, 2] - 5).max() <= np.abs(noise).max() + noise_mm


def test_an_edge_is_found_in_noise() -> None:
    turn, rng = 0.3, np.random.default_rng(1)
    mesh = roof(edge(1.0), turn)
    mesh = Mesh(mesh.vertices + rng.normal(0, 0.001, (len(mesh.vertices), 1)) * [0, 0, 1], mesh.faces)
    sharp, count = sharpen_edges(mesh, DETAIL_MM)
    assert count > 15
    assert cut_off_um(sharp, turn).mean() < 0.5 * cut_off_um(mesh, turn).mean()


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 1000), scale=st.floats(0.1, 10))
def test_a_moved_and_scaled_mesh_gives_the_same_edges(seed: int, scale: float) -> None:
    mesh, pose = roof(edge(1.0), 0.3), any_pose(seed, 20.0)
    sharp, count = sharpen_edges(mesh, DETAIL_MM)
    other = Mesh(scale * pose.apply(mesh.vertices), mesh.faces)
    sharp_other, count_other = sharpen_edges(other, scale * DETAIL_MM)
    assert abs(count_other - count) <= 2  # of two ends that are equally near, either is taken
    off = np.linalg.norm(sharp_other.vertices - scale * pose.apply(sharp.vertices), axis=1)
    assert (off > 1e-6 * scale).sum() <= 4


def test_faces_are_never_turned_over() -> None:
    mesh = roof(edge(1.5), 0.3)
    sharp, _ = sharpen_edges(mesh, DETAIL_MM)
    assert (sharp.faces == mesh.faces).all()
    assert ((sharp.face_normals * mesh.face_normals).sum(axis=1) > 0.2 - 1e-9).all()
    assert (sharp.face_areas > 0).all()


def test_limits() -> None:
    mesh = roof(edge(1.0), 0.3)
    assert sharpen_edges(mesh, DETAIL_MM, SharpEdgeOptions(enabled=False)) == (mesh, 0)
    assert sharpen_edges(mesh, DETAIL_MM, SharpEdgeOptions(max_outwards=0.01))[1] < 5
    assert sharpen_edges(mesh, DETAIL_MM, SharpEdgeOptions(min_angle_deg=120))[1] == 0
    assert sharpen_edges(mesh, DETAIL_MM, SharpEdgeOptions(roundness=0))[1] == 0
    nothing = Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    assert sharpen_edges(nothing, DETAIL_MM) == (nothing, 0)
    with pytest.raises(InputError, match="--roundness"):
        SharpEdgeOptions(roundness=2)


def test_pieces_do_not_see_each_other() -> None:
    """The flanks of an edge are what is connected with it, not what lies near."""
    one = roof(edge(1.0), 0.3)
    both = joined(one, moved(one, (0, 0, 0.1)))
    sharp, count = sharpen_edges(both, DETAIL_MM)
    alone, single = sharpen_edges(one, DETAIL_MM)
    assert count == 2 * single
    assert (sharp.vertices[: len(one.vertices)] == alone.vertices).all()
