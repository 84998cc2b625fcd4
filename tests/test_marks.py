"""What real teeth bear follows from their shape, and stays on the teeth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from builders import plate, sphere
from cuspid.geometry import Rigid3
from cuspid.jaw import GUM, Jaw
from cuspid.mesh import Mesh
from cuspid.simulation import raycast
from cuspid.simulation.appearance import APPEARANCES
from cuspid.simulation.marks import Marks, hollow_mm, natural_marks
from cuspid.simulation.raycast import Scene, lamps, radiance
from plain_scene import lit
from synthetic_scene import height_field

BALL = sphere(4.0, subdivisions=3)


@given(st.floats(0.3, 3), st.floats(0.1, 10), st.integers(0, 100))
def test_a_ball_is_hollow_from_inside_only_and_as_much_as_its_curvature_says(
    length_mm: float, scale: float, seed: int
) -> None:
    """Spread along a ball of radius R, its coordinates shrink by 1 + 2 (l / R)^2, wherever it lies."""
    shift = np.random.default_rng(seed).uniform(-100, 100, 3)
    ball = Mesh(scale * BALL.vertices + shift, BALL.faces)
    inside = Mesh(ball.vertices, ball.faces[:, ::-1])
    ratio = 2 * (length_mm / 4.0) ** 2
    depth = scale * 4.0 * ratio / (1 + ratio)
    assert hollow_mm(ball, scale * length_mm) == pytest.approx(-depth, rel=0.1)
    assert hollow_mm(inside, scale * length_mm) == pytest.approx(depth, rel=0.1)


def test_a_plane_is_not_hollow_and_a_groove_is() -> None:
    inner = np.abs(plate(5.0, 3.0, 60).vertices[:, :2]).max(axis=1) < 1.5
    assert np.abs(hollow_mm(plate(5.0, 3.0, 60), 0.3))[inner].max() < 1e-4
    groove = height_field(lambda x, y: 5 + 0.3 * np.exp(-((x / 0.2) ** 2)), count=121)
    x, hollow = groove.vertices[:, 0], hollow_mm(groove, 0.3)
    far = (np.abs(groove.vertices[:, :2]).max(axis=1) < 2.5) & (np.abs(x) > 1.5)
    assert hollow[np.abs(x) < 0.05].min() > 0.1 > 0.01 > np.abs(hollow[far]).max()


@pytest.fixture(scope="module")
def marked(coarse_phantom: Jaw) -> list[np.ndarray]:
    """Shares of each mark, by seed."""
    return [natural_marks(coarse_phantom, seed).shares for seed in range(12)]


def test_shares_are_shares_and_seeds_choose_stains_and_fillings(marked: list[np.ndarray]) -> None:
    for shares in marked:
        assert shares.min() >= 0
        assert shares.max() <= 1
        np.testing.assert_array_equal(shares[:, 0], marked[0][:, 0])  # dentine follows from the shape alone
    stains, fillings = ([shares[:, k] for shares in marked] for k in (1, 2))
    assert 0.1 < np.corrcoef(stains[0], stains[1])[0, 1] < 0.95  # in the same fissures, not in the same of them
    assert len({tuple(each) for each in fillings}) > 3


def test_stains_are_hollow_and_far_from_the_gum(coarse_phantom: Jaw, marked: list[np.ndarray]) -> None:
    mesh, labels = coarse_phantom.mesh, coarse_phantom.face_labels
    gum = np.unique(mesh.faces[labels == GUM])
    stained = np.max([shares[:, 1] for shares in marked], axis=0) > 0.3
    assert 20 < stained.sum() < 0.2 * len(stained)
    assert not stained[gum].any()
    assert hollow_mm(mesh, 0.3)[stained].min() > 0


def test_fillings_lie_on_chewing_surfaces_of_some_back_teeth(coarse_phantom: Jaw, marked: list[np.ndarray]) -> None:
    filled = dict[int, list[bool]]()
    for shares in marked:
        either = shares[:, 2] + shares[:, 3]
        assert either.max() <= 1  # one or the other
        assert not (coarse_phantom.mesh.vertex_normals[either > 0, 2] < 0.2).any()
        for tooth in coarse_phantom.teeth:
            vertices = np.unique(coarse_phantom.mesh.faces[coarse_phantom.tooth_faces(tooth)])
            filled.setdefault(tooth, []).append(bool((either[vertices] > 0.5).any()))
    assert not any(any(each) for tooth, each in filled.items() if tooth % 10 < 4)
    share = np.mean([each for tooth, each in filled.items() if tooth % 10 >= 4])
    assert 0.12 < share < 0.4
    kinds = [np.max([shares[:, k].max() for shares in marked]) for k in (2, 3)]
    assert min(kinds) > 0.9


def test_marks_replace_the_colour_of_teeth_and_leave_the_gum(
    coarse_phantom: Jaw, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The topmost hides those below; without a mark on it, a tooth is as it was."""
    tooth = coarse_phantom.mesh.vertices[np.unique(coarse_phantom.mesh.faces[coarse_phantom.tooth_faces(46)])]
    pose = Rigid3(np.diag([1.0, -1.0, -1.0]), np.array([-tooth[0, 0], tooth[0, 1], tooth[:, 2].max() + 5]))
    camera, rig_from_jaw = lit().rig[lit().rig.names[0]], lamps(lit(), "all", pose)
    matte = replace(APPEARANCES["natural"].enamel, reflectance=0.0)

    def seen(marks: Marks) -> np.ndarray:
        monkeypatch.setattr(raycast, "natural_marks", lambda jaw, seed: marks)
        look = replace(APPEARANCES["natural"], enamel=matte)
        scene = Scene(jaw=coarse_phantom, handpiece=lit(), appearance=look, supersampling=1)
        return radiance(scene, camera.camera, camera.cam_from_rig @ pose, rig_from_jaw)

    count = len(coarse_phantom.mesh.vertices)
    colours, none = np.array([[0.9, 0.1, 0.2], [0.0, 0.0, 0.0]]), np.zeros((count, 2), np.float32)
    bare, black, red = (seen(Marks(colours, none + np.float32(share))) for share in ((0, 0), (1, 1), (1, 0)))
    on_tooth = (black.sum(axis=2) == 0) & (bare.sum(axis=2) > 0)
    assert 0.2 < on_tooth.mean() < 1
    np.testing.assert_array_equal(black[~on_tooth], bare[~on_tooth])
    np.testing.assert_array_equal(red[~on_tooth], bare[~on_tooth])
    light = red[on_tooth] / colours[0]
    assert (bare[on_tooth] / light).min() > 0.3  # what is below is enamel again
    assert (bare[on_tooth] / light).max() < 0.9


def test_lone_vertices_and_flat_teeth_do_no_harm() -> None:
    """Meshes of users have both."""
    vertices = np.concatenate([BALL.vertices, [[9.0, 9, 9], [1, 0, 8], [1, 3, 8], [1, 3, 9]]])
    faces = np.concatenate([BALL.faces, [[0, 1, 1], [643, 644, 645]]])
    labels = np.concatenate([np.full(len(BALL.faces), 47), [GUM, 46]])
    for seed in range(20):
        shares = natural_marks(Jaw(mesh=Mesh(vertices, faces), face_labels=labels), seed).shares
        assert np.isfinite(shares).all()
        assert shares.min() >= 0
        assert shares.max() <= 1
