"""The named surfaces of the phantom, of a block whose surfaces are known, and of a mirrored jaw."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from cuspid.anatomy.landmarks.scheme import kind_of
from cuspid.anatomy.surfaces import SURFACES, SurfaceOptions, named_surfaces, tooth_axes
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import InputError

SIDES = ("lingual", "mesial", "distal")


@pytest.fixture(scope="module")
def masks(coarse_phantom: Jaw) -> dict[str, np.ndarray]:
    return named_surfaces(coarse_phantom)


def areas_of(jaw: Jaw, masks: dict[str, np.ndarray], fdi: int) -> dict[str, float]:
    tooth = jaw.tooth_faces(fdi)
    areas = {name: float(jaw.mesh.face_areas[tooth & mask].sum()) for name, mask in masks.items()}
    return {name: area for name, area in areas.items() if area > 0}


def test_each_face_of_a_tooth_has_one_name_and_their_areas_sum_to_the_tooth(
    coarse_phantom: Jaw, masks: dict[str, np.ndarray]
) -> None:
    assert tuple(masks) == SURFACES
    names = np.sum(list(masks.values()), axis=0)
    on_teeth = np.isin(coarse_phantom.face_labels, coarse_phantom.teeth)
    assert np.all(names[on_teeth] == 1)
    assert np.all(names <= 1)
    assert not np.any(masks["gingival"] & on_teeth)
    tooth = coarse_phantom.tooth_faces(46)
    assert sum(areas_of(coarse_phantom, masks, 46).values()) == pytest.approx(
        coarse_phantom.mesh.face_areas[tooth].sum()
    )


def test_each_tooth_has_all_its_surfaces(coarse_phantom: Jaw, masks: dict[str, np.ndarray]) -> None:
    for fdi in coarse_phantom.teeth:
        front = kind_of(fdi) in ("incisor", "canine")
        top, outer = ("incisal", "labial") if front else ("occlusal", "buccal")
        areas = areas_of(coarse_phantom, masks, fdi)
        assert set(areas) == {top, outer, *SIDES}
        whole = sum(areas.values())
        assert all(area > 0.02 * whole for area in areas.values())
        assert areas[outer] > 0.15 * whole
        low, high = (0.04, 0.2) if front else (0.2, 0.55)
        assert low < areas[top] / whole < high


def test_the_surfaces_look_and_lie_where_their_names_say(coarse_phantom: Jaw, masks: dict[str, np.ndarray]) -> None:
    mesh = coarse_phantom.mesh
    for fdi, axes in tooth_axes(coarse_phantom).items():
        tooth = coarse_phantom.tooth_faces(fdi)
        places = mesh.face_centres @ axes.T
        top = "incisal" if kind_of(fdi) in ("incisor", "canine") else "occlusal"
        for name, axis, sign in (
            ("mesial", 0, -1),
            ("distal", 0, 1),
            ("lingual", 1, -1),
            ("labial" if top == "incisal" else "buccal", 1, 1),
            (top, 2, 1),
        ):
            mask = tooth & masks[name]
            mean_normal = np.average(mesh.face_normals[mask], axis=0, weights=mesh.face_areas[mask]) @ axes.T
            assert sign * mean_normal[axis] > 0.4
            assert sign * (places[mask, axis].mean() - places[tooth, axis].mean()) > 0


def test_the_axes_are_those_of_the_patient(coarse_phantom: Jaw) -> None:
    axes = tooth_axes(coarse_phantom)
    assert list(axes) == [*range(47, 40, -1), *range(31, 38)]
    for fdi, (distal, outward, up) in axes.items():
        centre = coarse_phantom.mesh.face_centres[coarse_phantom.tooth_faces(fdi)].mean(axis=0)
        assert outward @ centre > 0
        np.testing.assert_allclose([distal @ outward, distal @ distal, outward @ outward], [0, 1, 1], atol=1e-12)
        np.testing.assert_array_equal(up, [0, 0, 1])
    assert axes[41][0] @ [1, 0, 0] > 0.9
    assert axes[31][0] @ [1, 0, 0] < -0.9
    assert axes[46][0] @ [0, 1, 0] < -0.8
    assert axes[36][0] @ [0, 1, 0] < -0.8


def mirrored(jaw: Jaw) -> Jaw:
    """The jaw in a mirror: left is right, also in the tooth numbers."""
    swap = {0: 0, **{10 * a + k: 10 * b + k for a, b in ((1, 2), (2, 1), (3, 4), (4, 3)) for k in range(1, 9)}}
    return replace(
        jaw,
        mesh=Mesh(jaw.mesh.vertices * [-1, 1, 1], jaw.mesh.faces[:, ::-1]),
        face_labels=np.array([swap[int(label)] for label in jaw.face_labels]),
        landmarks={},
    )


def test_a_mirrored_jaw_has_mirrored_names(coarse_phantom: Jaw) -> None:
    """Borderline faces may change sides by rounding; a face in ten thousand is allowed to."""
    there, here = named_surfaces(mirrored(coarse_phantom)), named_surfaces(coarse_phantom)
    for name in SURFACES:
        assert here[name].any()
        assert np.mean(there[name] != here[name]) < 1e-4


def test_an_upper_jaw_has_the_names_of_the_lower_one_that_it_is_made_of(coarse_phantom: Jaw) -> None:
    """Seen from its occlusal side, an upper jaw has the patient's left where a lower one has the right."""
    upper = {0: 0, **{30 + k: 10 + k for k in range(1, 9)}, **{40 + k: 20 + k for k in range(1, 9)}}
    labels = np.array([upper[int(label)] for label in coarse_phantom.face_labels])
    as_upper = named_surfaces(replace(coarse_phantom, face_labels=labels, arch="upper", landmarks={}))
    for name, mask in named_surfaces(coarse_phantom).items():
        assert np.mean(as_upper[name] != mask) < 1e-4


def blocks() -> Jaw:
    """Three box-shaped lower teeth (45, 46, 47) in a row along -Y at the patient's right, 10 mm apart."""
    parts, labels = [], []
    for k, fdi in enumerate((45, 46, 47)):
        box = trimesh.creation.box((8.0, 6.0, 7.0)).subdivide().subdivide().subdivide()
        parts.append(np.asarray(box.vertices) + [25.0, -10.0 * k, 0.0])
        labels += [fdi] * len(box.faces)
    count = len(parts[0])
    faces = np.concatenate([np.asarray(box.faces) + count * k for k in range(3)])
    return Jaw(mesh=Mesh(np.concatenate(parts), faces), face_labels=np.array(labels), arch="lower")


def test_the_surfaces_of_a_box_are_its_sides() -> None:
    """The under side has no name of its own; it goes to the sides."""
    jaw = blocks()
    masks, normals = named_surfaces(jaw), jaw.mesh.face_normals
    under = normals[:, 2] < -0.5
    for name, normal in (
        ("occlusal", [0, 0, 1]),
        ("buccal", [1, 0, 0]),
        ("lingual", [-1, 0, 0]),
        ("mesial", [0, 1, 0]),
        ("distal", [0, -1, 0]),
    ):
        np.testing.assert_array_equal(masks[name][~under], (normals @ normal > 0.9)[~under])


@pytest.mark.parametrize("width_mm", [1.0, 4.0])
def test_the_gingival_surface_has_the_asked_width(coarse_phantom: Jaw, width_mm: float) -> None:
    gingival = named_surfaces(coarse_phantom, SurfaceOptions(gingival_mm=width_mm))["gingival"]
    teeth = coarse_phantom.mesh.submesh(np.isin(coarse_phantom.face_labels, coarse_phantom.teeth))
    gum = ~np.isin(coarse_phantom.face_labels, coarse_phantom.teeth)
    distance, _, _ = teeth.closest(coarse_phantom.mesh.face_centres)
    assert 0.9 * width_mm < distance[gingival].max() <= width_mm
    assert distance[gum & ~gingival].min() > width_mm


def test_a_higher_incisal_surface_is_larger(coarse_phantom: Jaw) -> None:
    low, high = (named_surfaces(coarse_phantom, SurfaceOptions(incisal_mm=h))["incisal"] for h in (0.5, 1.5))
    assert np.all(high[low])
    assert low.sum() < high.sum()


@pytest.mark.parametrize("labels", [None, [46]])
def test_a_jaw_that_does_not_tell_how_its_arch_runs_is_refused(labels: list[int] | None) -> None:
    box = trimesh.creation.box((8.0, 6.0, 7.0))
    face_labels = None if labels is None else np.full(len(box.faces), labels[0])
    jaw = Jaw(mesh=Mesh(np.asarray(box.vertices), np.asarray(box.faces)), face_labels=face_labels)
    with pytest.raises(InputError, match="at least two are needed"):
        named_surfaces(jaw)


def test_options_that_make_no_sense_are_refused() -> None:
    with pytest.raises(InputError, match="must lie between"):
        SurfaceOptions(gingival_mm=0.0)
