from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cuspid.anatomy.landmarks.dimensions import arch_dimensions, needed_landmarks
from cuspid.anatomy.landmarks.estimation import SIGMA_MM, estimate_landmarks, with_estimates
from cuspid.anatomy.landmarks.scheme import TOOTH_LANDMARKS, central_groove_u, labels_of, missing, tip_direction
from cuspid.anatomy.landmarks.tooth_view import _view
from cuspid.anatomy.phantom.build import build_phantom
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.geometry import Rigid3
from cuspid.model.jaw import ARCHES, GUM, Jaw, Landmark
from cuspid.model.mesh import Mesh
from cuspid.report.figures.landmark import save_landmark_picture, save_measure_picture
from cuspid.runtime.errors import InputError

# The uncertainties are from the phantoms of seeds 100 to 113, which no test uses.


@cache
def upper_jaw() -> Jaw:
    return build_phantom(PhantomOptions(arch="upper", seed=1, edge_mm=0.8))


@pytest.fixture(scope="module", params=["lower", "upper"])
def phantom(request: pytest.FixtureRequest, coarse_phantom: Jaw) -> Jaw:
    return coarse_phantom if request.param == "lower" else upper_jaw()


@cache
def estimated(jaw: Jaw) -> dict[str, Landmark]:
    return estimate_landmarks(Jaw(mesh=jaw.mesh, face_labels=jaw.face_labels, arch=jaw.arch))


def errors_mm(jaw: Jaw, found: dict[str, Landmark]) -> dict[str, np.ndarray]:
    return {label: point.position - jaw.landmarks[label].position for label, point in found.items()}


@pytest.mark.long
def test_every_landmark_is_found_and_marked_as_estimated(phantom: Jaw):
    found = estimated(phantom)
    assert missing(found, phantom.teeth) == ()
    assert set(found) == set(labels_of(phantom.teeth))
    assert all(0.03 < (point.estimated_sigma_mm or 0) < 3 for point in found.values())


def test_the_dimensions_are_within_half_a_millimetre(phantom: Jaw):
    truth = arch_dimensions(phantom.landmarks, phantom.arch or "lower")
    found = arch_dimensions(estimated(phantom), phantom.arch or "lower")
    for name in ("a", "b", "c", "f"):
        known, measured = truth[name], found[name]
        assert known is not None
        assert measured is not None
        assert 0 < abs(measured.value_mm - known.value_mm) < 0.5
        assert abs(measured.value_mm - known.value_mm) < 3 * (measured.sigma_mm or 0)


def test_the_uncertainties_cover_the_errors(phantom: Jaw):
    found = estimated(phantom)
    scaled = np.array([error / found[label].estimated_sigma_mm for label, error in errors_mm(phantom, found).items()])
    # They are those of real teeth, which err by more than a phantom's.
    assert 0.25 < np.sqrt(np.mean(scaled**2)) < 1.0
    assert np.mean(np.abs(scaled) < 2) > 0.95


def test_heights_go_through_the_vertices_and_bend_between_them():
    """On a dome of triangles, anywhere in the jaw, they are nearer to the dome than the triangles are."""
    side, place = 11, np.array([20.0, -30.0, 5.0])
    x, y = (each.ravel() for each in np.meshgrid(np.linspace(-4, 4, side), np.linspace(-4, 4, side), indexing="ij"))
    dome = lambda u, v: -0.06 * (u**2 + v**2)  # noqa: E731
    k = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    faces = np.vstack([np.column_stack(each) for each in ((k, k + side, k + side + 1), (k, k + side + 1, k + 1))])
    view = _view(46, Mesh(np.column_stack([x, y, dome(x, y)]) + place, faces), np.eye(3), 0.1)
    assert view is not None
    inside = np.abs(view.places).max(axis=-1) < 2.5
    error = (view.heights - dome(*np.moveaxis(view.places, -1, 0)))[inside]
    sag = 0.06 * (8 / (side - 1)) ** 2 / 2
    assert 0 < np.sqrt(np.mean(error**2)) < 0.2 * sag
    np.testing.assert_allclose(view.lift(np.array([0.8, -1.6])), place + [0.8, -1.6, dome(0.8, -1.6)], atol=0.01)


def test_tips_of_worn_cusps_are_their_outer_corners():
    """On a molar in both directions, on the lingual side of a premolar across the arch; in a lower jaw more so."""
    for name, signs in (("mesiobuccal_cusp", (-1, 1)), ("distobuccal_cusp", (1, 1)), ("mesiolingual_cusp", (-1, -1))):
        assert all(tuple(np.sign(tip_direction(arch, name))) == (*signs, 1) for arch in ARCHES)
    for name in ("lingual_cusp", "mesiolingual_cusp"):
        assert tip_direction("lower", name)[1] < tip_direction("upper", name)[1] < 0


def test_the_central_groove_of_a_molar_lies_between_its_outline_and_its_cusps():
    cusps = [np.array([u, v]) for u, v in ((-2.0, 3.0), (1.0, 3.0), (-1.0, -3.0), (4.0, -3.0))]
    assert central_groove_u("molar", cusps) == pytest.approx(0.25)
    assert central_groove_u("premolar", cusps) == 0.0


def test_cusps_and_edges_lie_on_the_surface_and_few_are_far(phantom: Jaw):
    found = estimated(phantom)
    tips = np.array([point.position for label, point in found.items() if "cusp" in label or "edge" in label])
    assert phantom.mesh.closest(tips)[0].max() < 1e-6
    lengths = np.array([np.linalg.norm(error) for error in errors_mm(phantom, found).values()])
    assert 0.02 < np.median(lengths) < 0.25
    assert np.mean(lengths < 1.0) > 0.94


def test_a_tilted_jaw_gives_nearly_the_same_dimensions(coarse_phantom: Jaw):
    tilt = Rigid3(Rotation.from_euler("xyz", [3.0, -3.0, 5.0], degrees=True).as_matrix(), np.zeros(3))
    turned = replace(coarse_phantom, mesh=coarse_phantom.mesh.transformed(tilt), landmarks={})
    found = arch_dimensions(estimate_landmarks(turned), "lower")
    straight = arch_dimensions(estimated(coarse_phantom), "lower")
    for name in ("a", "b", "c", "f"):
        one, other = found[name], straight[name]
        assert one is not None
        assert other is not None
        assert abs(one.value_mm - other.value_mm) < 0.4


def test_cusps_are_found_along_the_teeth_however_the_jaw_lies(phantom: Jaw):
    tilt = Rigid3(Rotation.from_euler("xyz", [8.0, 6.0, 0.0], degrees=True).as_matrix(), np.zeros(3))
    straight = estimated(phantom)
    found = estimate_landmarks(replace(phantom, mesh=phantom.mesh.transformed(tilt), landmarks={}))
    moved = [
        np.linalg.norm(found[label].position - tilt.apply(point.position))
        for label, point in straight.items()
        if "cusp" in label
    ]
    assert 0 < np.median(moved) < 0.15


def test_specks_of_a_label_elsewhere_do_not_count(phantom: Jaw):
    labels = phantom.face_labels
    assert labels is not None
    tooth = phantom.teeth[-2]
    away = np.linalg.norm(phantom.mesh.face_centres - phantom.mesh.centroid(phantom.tooth_faces(tooth)), axis=1)
    speck = np.argmax(np.where(labels == GUM, away, 0.0))
    found = estimate_landmarks(
        replace(phantom, face_labels=np.where(np.arange(len(labels)) == speck, tooth, labels), landmarks={})
    )
    for name in TOOTH_LANDMARKS["molar"]:
        apart = found[f"{tooth}.{name}"].position - estimated(phantom)[f"{tooth}.{name}"].position
        assert np.linalg.norm(apart) < 0.01


def test_a_tooth_that_is_missing_is_left_out_and_the_others_stay(coarse_phantom: Jaw):
    labels = coarse_phantom.face_labels
    assert labels is not None
    twelve = replace(coarse_phantom, face_labels=np.where(np.isin(labels, (37, 47)), GUM, labels), landmarks={})
    found = estimate_landmarks(twelve)
    assert len(found) == 62
    dimensions = arch_dimensions(found, "lower")
    assert (dimensions.c, dimensions.f) == (None, None)
    assert dimensions.b is not None
    assert dimensions.b.value_mm == pytest.approx(51.2, abs=0.5)
    assert dimensions.f_first is not None


def test_known_landmarks_stay_as_they_are(coarse_phantom: Jaw):
    labels = coarse_phantom.face_labels
    assert labels is not None
    few = replace(coarse_phantom, face_labels=np.where(np.isin(labels, (32, 33)), labels, GUM))
    known = {"33.cusp_tip": coarse_phantom.landmarks["33.cusp_tip"]}
    filled = with_estimates(replace(few, landmarks=known))
    assert filled.landmarks["33.cusp_tip"] is known["33.cusp_tip"]
    assert set(filled.landmarks) == set(labels_of((32, 33))) - {"papilla", "midline"}


def test_without_labels_it_says_so(coarse_phantom: Jaw):
    with pytest.raises(InputError, match="no tooth labels"):
        estimate_landmarks(Jaw(mesh=coarse_phantom.mesh, arch="lower"))


def test_every_kind_of_point_has_its_uncertainty():
    kinds = {f"{kind}.{name}" for kind, names in TOOTH_LANDMARKS.items() for name in names}
    assert set(SIGMA_MM) == kinds | {"papilla", "midline"}


def test_the_pictures_show_the_jaw_and_name_what_is_missing(tmp_path: Path, coarse_phantom: Jaw):
    save_landmark_picture(tmp_path / "points.png", coarse_phantom, (46,), title="points")
    lines = needed_landmarks("lower")
    save_measure_picture(tmp_path / "lengths.png", coarse_phantom, {"f": lines["f"]}, {"f": 33.0})
    for name in ("points.png", "lengths.png"):
        image = cv2.imread(str(tmp_path / name))
        assert image is not None
        assert 0.1 < np.mean(np.any(image != 255, axis=-1)) < 0.9
    bare = replace(coarse_phantom, landmarks={})
    with pytest.raises(InputError, match=r"no landmark 43\.cusp_tip, 33\.cusp_tip"):
        save_measure_picture(tmp_path / "none.png", bare, {"a": lines["a"]}, {"a": 27.0})
    assert not (tmp_path / "none.png").exists()
