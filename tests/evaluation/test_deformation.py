"""Deformation of an arch, and scan bodies: what was bent or placed by other code comes back."""

from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from cuspid.evaluation.deformation import MODES, fit_deformation, mode_fields
from cuspid.evaluation.distance import SignedDistance
from cuspid.evaluation.places import scatter
from cuspid.evaluation.registration import RegistrationOptions, locate_place, refine
from cuspid.evaluation.scan_bodies import fit_body
from cuspid.evaluation.spans import Station, slope_ppm, spans
from cuspid.geometry import Rigid3
from cuspid.model.arch_curve import arch_curve
from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import InputError
from horseshoe import horseshoe

SECOND_ORDER = {"scale": 25.0, "spread": 4.0, "lift": 4.0, "twist": 4.0}
"""What finite turns of some mrad add to a linear model: a bent arch is shorter by half their squares (ppm, um)."""


@pytest.fixture
def cases(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    return import_module("study_cases")


@pytest.fixture(scope="module")
def jaw():
    return horseshoe(150, 50)


@pytest.fixture(scope="module")
def curve(jaw):
    return arch_curve(jaw)


@pytest.mark.parametrize(
    "told",
    [
        {"lift": 40.0},
        {"spread": -200.0},
        {"twist": 100.0},
        {"scale": -50.0},
        {"scale": 500.0, "spread": 60.0, "lift": -120.0, "twist": 80.0},
    ],
)
def test_modes_come_back_together(jaw, curve, cases, told):
    mesh, line = jaw.mesh, np.array(curve.points)
    moved = mesh.vertices
    for mode, um in told.items():
        if mode == "scale":
            moved = moved + 1e-6 * um * (mesh.vertices - line[len(line) // 2])
        else:
            signed = cases.signed_twist(line, um) if mode == "twist" else um
            moved = moved + cases.bent(mesh.vertices, line, mode, signed) - mesh.vertices
    motion = Rigid3.from_rotation_vector(np.array([1e-3, -5e-4, 2e-3]), np.array([0.05, 0.02, -0.03]))
    scan = SignedDistance(Mesh(moved, mesh.faces).transformed(motion))
    found = fit_deformation(scatter(mesh, 4000, np.random.default_rng(0)), curve, scan)
    for mode in MODES:
        off = found.amplitudes[mode] - told.get(mode, 0.0)
        assert abs(off) <= max(0.05 * abs(told.get(mode, 0.0)), SECOND_ORDER[mode]), (mode, found.amplitudes)
    assert found.remainder_um < 0.1 * found.before_um
    assert all(found.rms_um[mode] > 0.5 for mode in told)


def test_amplitudes_are_displacements_of_the_ends(curve):
    ends = np.array(curve.points[[0, -1]])
    fields = mode_fields(curve, ends)
    for mode in ("spread", "lift", "twist"):
        assert np.sqrt(np.mean(np.sum(fields[mode] ** 2, axis=1))) == pytest.approx(1e-3, rel=0.02)
    apart = ends[1] - ends[0]
    assert (fields["spread"][1] - fields["spread"][0]) @ apart > 0
    assert (fields["lift"][:, 2] > 0).all()
    assert fields["twist"][0, 2] > 0 > fields["twist"][1, 2]


def test_too_little_surface_tells_no_modes(jaw, curve):
    places = scatter(jaw.mesh, 100, np.random.default_rng(0))
    assert fit_deformation(places, curve, SignedDistance(jaw.mesh)) is None


def test_aligned_at_one_end_a_circular_arch_is_off_by_the_closed_form(cases):
    """A half circle of radius r whose curvature changes by k: clamped at one end, the other moves by k times the first
    moment of the chain about it, which is (k pi r^2, 2 k r^2)."""
    r, um = 25.0, 150.0
    angle = np.linspace(np.pi, 0, 801)
    line = np.stack([r * np.cos(angle), r * np.sin(angle), np.zeros_like(angle)], axis=1)
    moved = cases.bent(line, line, "spread", um)
    k = _curvature_change(line, moved)
    first, second = moved[0] - moved[1], line[0] - line[1]
    turn = np.arctan2(*second[1::-1]) - np.arctan2(*first[1::-1])
    clamp = Rigid3.from_rotation_vector(np.array([0, 0, turn]), np.zeros(3))
    off = clamp.rotate(moved[-1] - moved[0]) - (line[-1] - line[0])
    assert 1000 * np.linalg.norm(off) == pytest.approx(1000 * abs(k) * r**2 * np.hypot(np.pi, 2), rel=0.03)
    assert 1000 * np.linalg.norm(off) > 2 * um


def _curvature_change(line: np.ndarray, moved: np.ndarray) -> float:
    """Mean change of heading per length."""
    headings = [np.unwrap(np.arctan2(*np.diff(each, axis=0)[:, 1::-1].T)) for each in (line, moved)]
    turned = (headings[1][-1] - headings[1][0]) - (headings[0][-1] - headings[0][0])
    return float(turned / np.linalg.norm(np.diff(line, axis=0), axis=1).sum())


# --- scan bodies ------------------------------------------------------------------------------------------------------


def test_scan_bodies_are_found_with_noise_and_a_third_missing(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    found = import_module("study").scan_bodies(2, edge_mm=0.4)
    assert found["lost"] == 0
    assert 0.05 < found["position_rms_um"] < 3
    assert 0.0005 < found["axis_rms_deg"] < 0.03


def test_a_place_without_a_body_is_refused():
    jaw = horseshoe(80, 30).mesh
    body = Mesh(jaw.vertices * 0.1, jaw.faces)
    with pytest.raises(InputError):
        fit_body(jaw, SignedDistance(body), np.array([200.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))


def test_growth_does_not_shift_where_a_tooth_is_found(jaw):
    tooth = jaw.mesh.submesh(jaw.tooth_faces(46))
    points, _ = tooth.sample(3000, np.random.default_rng(0))
    surface, middle = SignedDistance(jaw.mesh), points.mean(axis=0)
    pose = refine(1.001 * points, surface, Rigid3.identity(), RegistrationOptions())
    assert 1000 * np.linalg.norm(locate_place(1.001 * points, surface, pose, middle) - 1.001 * middle) < 0.5
    assert 1000 * np.linalg.norm(pose.inverse().apply(middle) - 1.001 * middle) > 0.5


def test_spans_do_not_depend_on_the_alignment():
    rng = np.random.default_rng(0)
    nominal = {str(k): Rigid3.from_quaternion(rng.normal(size=4), rng.normal(0, 20, 3)) for k in range(4)}
    motion = Rigid3.from_quaternion(rng.normal(size=4), rng.normal(size=3))
    grown = {name: Rigid3(pose.rotation, 1.001 * pose.translation) for name, pose in nominal.items()}
    found = spans("bodies", {name: Station(nominal=nominal[name], measured=motion @ grown[name]) for name in nominal})
    assert len(found) == 6
    assert slope_ppm(found) == pytest.approx(1000, rel=1e-6)
    assert all(span.error_um == pytest.approx(span.nominal_mm, rel=1e-6) for span in found)
    assert all(span.angle_error_deg < 1e-5 for span in found)
