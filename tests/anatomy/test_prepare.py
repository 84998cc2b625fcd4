"""Preparations have the measures that were asked for, leave the rest alone, and keep their margins on the surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from cuspid.anatomy.edges import open_edges
from cuspid.anatomy.preparation.prepare import (
    KINDS,
    CrackOptions,
    CrownOptions,
    FullContourCrownOptions,
    InlayOptions,
    options_of,
    prepare,
    preset,
)
from cuspid.anatomy.preparation.tooth_site import Border, ToothSite, site_of
from cuspid.model.jaw import GUM, Jaw, Landmark
from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import InputError

DOWN = np.array([0.0, 0.0, -1.0])


@pytest.fixture(scope="module")
def jaw(coarse_phantom: Jaw) -> Jaw:
    return replace(coarse_phantom, landmarks={"45.buccal_cusp": Landmark(np.array([1.0, 2.0, 3.0]))})


@pytest.fixture(scope="module")
def prepared(jaw: Jaw) -> Jaw:
    return prepare(jaw, preset("thesis-reference"))


@pytest.fixture(scope="module")
def sites(jaw: Jaw) -> dict[int, ToothSite]:
    return {fdi: site_of(jaw, fdi) for fdi in preset("thesis-reference")}


def heights(jaw: Jaw, site: ToothSite, xy: np.ndarray) -> np.ndarray:
    """Height (n,) of a jaw above positions (n, 2) of a site, along its axis."""
    mesh = jaw.mesh.transformed(site.site_from_jaw)
    hits = mesh.cast(np.column_stack([xy, np.full(len(xy), 20.0)]), np.tile(DOWN, (len(xy), 1)))
    return 20.0 - hits.distances


def volume(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return float(np.sum(a * np.cross(b, c)) / 6)


def walls(prepared: Jaw, site: ToothSite) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of the steep faces inside a margin: distance from it seen from occlusal, height above it, normals, areas."""
    mesh = prepared.mesh.transformed(site.site_from_jaw)
    line = site.site_from_jaw.apply(prepared.lines[f"{site.fdi}.margin"])
    dense = np.concatenate([line[:-1] + share * np.diff(line, axis=0) for share in np.linspace(0, 1, 20)])
    mine = prepared.tooth_faces(site.fdi)
    centres, normals = mesh.face_centres[mine], mesh.face_normals[mine]
    distance, nearest = cKDTree(dense[:, :2]).query(centres[:, :2])
    rise = centres[:, 2] - dense[nearest, 2]
    steep = (np.abs(normals[:, 2]) < 0.3) & (rise > 0.5) & (distance > 0.2)
    return distance[steep], rise[steep], normals[steep], mesh.face_areas[mine][steep]


@pytest.mark.long
def test_the_result_is_one_closed_surface_with_every_tooth(jaw: Jaw, prepared: Jaw) -> None:
    assert len(open_edges(prepared.mesh.faces)) == 0
    assert prepared.teeth == jaw.teeth
    assert prepared.landmarks == jaw.landmarks
    assert 100 < volume(jaw.mesh) - volume(prepared.mesh) < 600


def test_the_margins_are_closed_and_on_the_surface(jaw: Jaw, prepared: Jaw) -> None:
    assert set(prepared.lines) == {"46.crack", "46.crack_bottom", "45.margin", "42.margin", "35.margin", "36.margin"}
    for name, line in prepared.lines.items():
        assert prepared.mesh.closest(line)[0].max() < 1e-3
        if name != "46.crack_bottom":
            np.testing.assert_array_equal(line[0], line[-1])
            assert np.linalg.norm(np.diff(line, axis=0), axis=1).max() < 1.5
            on_both = jaw.mesh.closest(line)[0] < 1e-3
            assert on_both.all() if name == "46.crack" else on_both.mean() > 0.35


def test_what_is_no_neighbour_is_untouched_and_neighbours_only_at_their_seam(jaw: Jaw, prepared: Jaw) -> None:
    kept = cKDTree(prepared.mesh.face_centres)
    for fdi in set(jaw.teeth) - set(preset("thesis-reference")):
        centres = jaw.mesh.face_centres[jaw.tooth_faces(fdi)]
        gone = kept.query(centres)[0] > 1e-9
        assert gone.mean() < 0.12
        others = np.isin(jaw.face_labels, list(preset("thesis-reference")))
        if gone.any():
            assert cKDTree(jaw.mesh.face_centres[others]).query(centres[gone])[0].max() < 0.8
        if fdi in (32, 33, 31, 47):
            assert not gone.any()


def test_only_the_papillae_are_cut_back_in_the_gum(jaw: Jaw, prepared: Jaw) -> None:
    gum = jaw.mesh.face_centres[jaw.face_labels == GUM]
    gone = cKDTree(prepared.mesh.face_centres).query(gum)[0] > 1e-9
    teeth = jaw.mesh.face_centres[np.isin(jaw.face_labels, list(preset("thesis-reference")))]
    assert 0 < gone.mean() < 0.05
    assert cKDTree(teeth).query(gum[gone])[0].max() < 2.0


@pytest.mark.parametrize(("fdi", "taper_deg", "width_mm"), [(45, 6.0, 1.0), (42, 7.5, 0.5)])
def test_a_crown_preparation_has_its_taper_and_width(
    prepared: Jaw, sites: dict[int, ToothSite], fdi: int, taper_deg: float, width_mm: float
) -> None:
    distance, rise, normals, areas = walls(prepared, sites[fdi])
    proximal = (np.abs(normals[:, 0]) > 0.9) & (rise < 1.6)
    assert areas[proximal].sum() > 2
    taper = np.rad2deg(np.arcsin(normals[proximal, 2]))
    assert np.median(taper) == pytest.approx(taper_deg, abs=0.5)
    width = distance[proximal] - rise[proximal] * np.tan(np.deg2rad(taper_deg))
    assert np.median(width) == pytest.approx(width_mm, abs=0.05)


def test_a_crown_preparation_lowers_the_occlusal_surface(jaw: Jaw, prepared: Jaw, sites: dict[int, ToothSite]) -> None:
    middle = sites[45].surface.vertices.mean(axis=0)
    grid = (
        np.stack(np.meshgrid(np.linspace(-1, 1, 21), np.linspace(-1.5, 1.5, 31)), axis=-1).reshape(-1, 2) + middle[:2]
    )
    lowered = heights(jaw, sites[45], grid) - heights(prepared, sites[45], grid)
    assert np.median(lowered) == pytest.approx(1.5, abs=0.1)
    vertices = sites[42].surface.vertices
    edge = vertices[vertices[:, 2] > vertices[:, 2].max() - 0.6]
    middle = edge[np.abs(edge[:, 0] - edge[:, 0].mean()) < 0.8].mean(axis=0)
    disc = middle[:2] + np.stack(np.meshgrid(*[np.linspace(-0.6, 0.6, 13)] * 2), axis=-1).reshape(-1, 2)
    before, after = (heights(each, sites[42], disc).max() for each in (jaw, prepared))
    assert before - after == pytest.approx(1.5, abs=0.1)


def test_a_crack_has_its_width_and_depth(jaw: Jaw, prepared: Jaw, sites: dict[int, ToothSite]) -> None:
    bottom = sites[46].site_from_jaw.apply(prepared.lines["46.crack_bottom"])
    middle = np.arange(len(bottom) // 3, 2 * len(bottom) // 3, 5)
    along = bottom[middle + 1, :2] - bottom[middle - 1, :2]
    across = np.column_stack([-along[:, 1], along[:, 0]]) / np.linalg.norm(along, axis=1, keepdims=True)
    xy = (bottom[middle, None, :2] + np.arange(-0.15, 0.15, 0.001)[:, None] * across[:, None]).reshape(-1, 2)
    deep = (heights(jaw, sites[46], xy) - heights(prepared, sites[46], xy)).reshape(len(middle), -1)
    width_um = np.median(1000 * 0.001 * np.sum(deep > 0.005, axis=1))
    depth_um = np.median(1000 * deep.max(axis=1))
    assert width_um == pytest.approx(150, abs=10)
    assert depth_um == pytest.approx(1000, abs=10)


@pytest.mark.parametrize("fdi", [35, 36])
def test_an_inlay_has_its_isthmus_depth_and_divergence(
    jaw: Jaw, prepared: Jaw, sites: dict[int, ToothSite], fdi: int
) -> None:
    options, site = preset("thesis-reference")[fdi], sites[fdi]
    assert isinstance(options, InlayOptions)
    mine = prepared.mesh.submesh(prepared.tooth_faces(fdi)).transformed(site.site_from_jaw)
    y = np.arange(-6, 6, 0.01)
    z = heights(prepared, site, np.column_stack([0 * y, y]))
    floor = np.median(mine.face_centres[(mine.face_normals[:, 2] > 0.999) & (np.abs(mine.face_centres[:, 0]) < 1), 2])
    before = heights(jaw, site, np.column_stack([0 * y, y]))
    opened = [np.ptp(y[(z < floor + up) & (before > z + 0.01)]) for up in (0.4, 0.8)]
    divergence = np.rad2deg(np.arctan((opened[1] - opened[0]) / 0.8))
    assert divergence == pytest.approx(options.divergence_deg, abs=2.5)
    assert opened[0] - 0.8 * np.tan(np.deg2rad(8)) == pytest.approx(options.isthmus_width_mm, abs=0.05)
    x = np.linspace(-0.5, 0.5, 21) * site.width_mm / 2
    near = y[np.abs(y - y[len(y) // 2]) < 1.5]
    lines = heights(jaw, site, np.stack(np.meshgrid(x, near, indexing="ij"), axis=-1).reshape(-1, 2))
    groove = np.median(lines.reshape(len(x), -1).min(axis=1))
    assert groove - floor == pytest.approx(options.pulpal_depth_mm, abs=0.1)


def test_the_order_of_preparations_does_not_matter_and_the_same_gives_the_same(jaw: Jaw) -> None:
    one = prepare(jaw, {46: CrackOptions()})
    two = prepare(jaw, {46: CrackOptions()})
    np.testing.assert_array_equal(one.mesh.vertices, two.mesh.vertices)
    assert 0 < volume(jaw.mesh) - volume(one.mesh) < 1.0
    assert len(one.mesh.vertices) - len(one.mesh.faces) // 2 == len(jaw.mesh.vertices) - len(jaw.mesh.faces) // 2


def test_an_open_scan_stays_open_where_it_was(jaw: Jaw) -> None:
    keep = jaw.mesh.face_centres[:, 2] > jaw.mesh.vertices[:, 2].min() + 3.0
    scan = Jaw(mesh=jaw.mesh.submesh(keep), face_labels=jaw.face_labels[keep], arch="lower")
    cracked = prepare(scan, {46: CrackOptions(ridge="distal")})
    assert len(open_edges(cracked.mesh.faces)) == len(open_edges(scan.mesh.faces)) > 50
    assert cracked.mesh.bounds[0, 2] == scan.mesh.bounds[0, 2]


@pytest.mark.parametrize(
    ("preparations", "says"),
    [
        ({48: CrownOptions()}, "no tooth 48"),
        ({42: CrackOptions()}, "premolar or molar"),
        ({42: InlayOptions()}, "premolar or molar"),
        ({45: CrownOptions(axial_reduction_mm=3.0, finish_width_mm=2.0)}, "leave no stump"),
        ({45: CrownOptions(occlusal_reduction_mm=4.0, above_gum_mm=2.0)}, "stump"),
        ({35: InlayOptions(pulpal_depth_mm=4.0, box_depth_mm=4.0)}, "shallower"),
        ({35: InlayOptions(gingival_floor_mm=3.0)}, "narrower"),
        ({}, "no tooth was named"),
    ],
)
def test_what_does_not_fit_is_refused(jaw: Jaw, preparations: dict, says: str) -> None:
    with pytest.raises(InputError, match=says):
        prepare(jaw, preparations)


def test_a_jaw_that_is_no_manifold_is_refused_with_its_edges(jaw: Jaw) -> None:
    twice = np.concatenate([jaw.mesh.faces, jaw.mesh.faces[:2]])
    broken = Jaw(mesh=Mesh(jaw.mesh.vertices, twice), face_labels=np.append(jaw.face_labels, jaw.face_labels[:2]))
    with pytest.raises(InputError, match="shared by more than two faces"):
        prepare(broken, {46: CrackOptions()})
    with pytest.raises(InputError, match="no tooth labels"):
        prepare(Jaw(mesh=jaw.mesh), {46: CrackOptions()})


def test_options_are_checked_and_named() -> None:
    assert {type(options_of(kind)) for kind in KINDS} == set(KINDS.values())
    with pytest.raises(InputError, match="mod_inlay"):
        options_of("veneer")
    with pytest.raises(InputError, match="thesis-reference"):
        preset("thesis")
    with pytest.raises(InputError, match="taper-deg"):
        CrownOptions(taper_deg=45.0)
    with pytest.raises(InputError, match="width-um"):
        CrackOptions(width_um=0.0)
    assert isinstance(preset("thesis-reference")[42], FullContourCrownOptions)


def test_a_border_is_quadratic_in_its_reach_and_level_beyond() -> None:
    centre, reach = np.array([1.0, -2.0]), np.array([3.0, 4.0])
    border = Border(fdi=45, side=1.0, centre=centre, reach=reach, coefficients=np.array([1, 2, 3, 4, 5, 6.0]))
    y, z = np.array([2.0, 1.0, 1.0, 90.0, -90.0]), np.array([1.0, 9.0, -9.0, -2.0, -2.0])
    dy, dz = np.array([1.0, 0.0, 0.0, 3.0, -3.0]), np.array([3.0, 4.0, -4.0, 0.0, 0.0])
    np.testing.assert_allclose(border.x(y, z), 1 + 2 * dy + 3 * dz + 4 * dy**2 + 5 * dy * dz + 6 * dz**2)
