"""The sphere arch is what it says it is."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from cuspid.anatomy.dentition import ARCH_FORMS
from cuspid.anatomy.sphere_arch import SphereArchOptions, build_sphere_arch
from cuspid.errors import InputError
from cuspid.handpiece.designs import twelve_cameras
from cuspid.jaw import Jaw
from cuspid.simulation.scan_path import ScanPathOptions, plan_scan_path

COARSE = SphereArchOptions(edge_mm=0.45)


@pytest.fixture(scope="module")
def arch() -> Jaw:
    """The default sphere arch."""
    return build_sphere_arch()


@pytest.fixture(scope="module")
def coarse_arch() -> Jaw:
    """With few faces; its vertices lie on the spheres all the same."""
    return build_sphere_arch(COARSE)


# --- the object ---------------------------------------------------------------------------------------------------


def test_the_solid_is_closed_and_in_one_piece(arch: Jaw) -> None:
    mesh = trimesh.Trimesh(arch.mesh.vertices, arch.mesh.faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.body_count == 1
    assert mesh.euler_number == 2
    assert mesh.volume > 0


def test_faces_of_a_sphere_lie_on_it_within_a_micrometre(arch: Jaw) -> None:
    for label, sphere in arch.spheres.items():
        faces = arch.mesh.faces[arch.face_labels == int(label)]
        corners = arch.mesh.vertices[faces] - sphere.centre
        deepest = np.linalg.norm(corners.mean(axis=1), axis=1).min()
        assert -1e-3 < deepest - sphere.radius_mm < 0, label
        assert np.abs(np.linalg.norm(corners, axis=2) - sphere.radius_mm).max() < 1e-3, label
        edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
        assert 0.05 < edges.max() < SphereArchOptions().edge_mm, label


def test_each_sphere_is_free_down_to_the_ridge_and_all_round(arch: Jaw) -> None:
    free = SphereArchOptions().free_polar_deg
    assert free == pytest.approx(120.0)
    area = 2 * np.pi * 2.5**2 * (1 - np.cos(np.deg2rad(free)))
    for label in arch.spheres:
        of_sphere = arch.mesh.face_areas[arch.face_labels == int(label)].sum()
        assert of_sphere == pytest.approx(area, rel=0.04), label


@pytest.mark.parametrize("which", ["lower", "upper"])
def test_canines_and_molars_are_as_wide_apart_as_in_the_arch_form(which: str) -> None:
    spheres = build_sphere_arch(SphereArchOptions(arch=which, edge_mm=0.9)).spheres
    left, right = ("3", "4") if which == "lower" else ("1", "2")
    form = ARCH_FORMS[which]
    for position, width in (
        ("3", form.inter_canine_mm),
        ("6", form.inter_first_molar_mm),
        ("7", form.inter_second_molar_mm),
    ):
        gap = spheres[right + position].centre - spheres[left + position].centre
        np.testing.assert_allclose(gap, [width, 0, 0], atol=1e-6)


def test_it_stands_in_the_occlusal_frame(coarse_arch: Jaw) -> None:
    centres = np.array([sphere.centre for sphere in coarse_arch.spheres.values()])
    np.testing.assert_allclose(centres.mean(axis=0), [0, 0, -2.5], atol=1e-9)
    assert coarse_arch.spheres["31"].centre[1] == centres[:, 1].max()
    assert coarse_arch.spheres["41"].centre[0] > 0
    assert 1.0 < np.ptp(centres[:, 2]) < 1.5
    assert coarse_arch.teeth == tuple(sorted(int(label) for label in coarse_arch.spheres))


def test_the_twelve_cameras_can_scan_it_like_a_jaw(coarse_arch: Jaw) -> None:
    options = ScanPathOptions(jitter_mm=0.0, jitter_deg=0.0)
    path = plan_scan_path(coarse_arch, twelve_cameras(), options, np.random.default_rng(0))
    assert 0.75 < path.minimum_overlap < 1
    tops = np.array([sphere.centre + [0, 0, sphere.radius_mm] for sphere in coarse_arch.spheres.values()])
    nearest = np.linalg.norm(tops[:, None] - path.curve.points[None], axis=2).min(axis=1)
    assert nearest.max() < 1.0


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"radius_mm": 3.2}, "apart"),
        ({"rise_mm": 2.5}, "rise_mm"),
        ({"edge_mm": 0.0}, "edge_mm"),
        ({"depth_mm": -1.0}, "depth_mm"),
    ],
)
def test_impossible_options_are_refused_in_one_line(options: dict[str, float], word: str) -> None:
    with pytest.raises(InputError, match=word) as caught:
        build_sphere_arch(SphereArchOptions(**options))
    assert "\n" not in str(caught.value)
