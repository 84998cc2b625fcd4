"""The edge of a preparation is found where it is, and what the detector cannot tell is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from cuspid import storage
from cuspid.evaluation.margin import MarginOptions, _edge, cut_margin, cut_margins, margin_error
from cuspid.geometry import Rigid3
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import InputError
from verbs import run

TURNS = 180
RADIUS_MM = 3.0


def stump(fillet_mm: float = 0.0) -> Mesh:
    """A cylinder of 3 mm radius whose upper edge, at z = 0, is rounded by a fillet; open below."""
    angles = np.linspace(np.pi / 2, 0, 12)
    arc = np.column_stack([RADIUS_MM - fillet_mm * (1 - np.cos(angles)), fillet_mm * (np.sin(angles) - 1)])
    corner = arc if fillet_mm else np.array([[RADIUS_MM, 0.0]])
    across = np.arange(0.4, RADIUS_MM - fillet_mm - 0.02, 0.1)
    down = np.arange(-fillet_mm - 0.1, -2.5, -0.1)
    profile = np.concatenate(
        [np.column_stack([across, 0 * across]), corner, np.column_stack([0 * down + RADIUS_MM, down])]
    )
    turn = 2 * np.pi * np.arange(TURNS) / TURNS
    r, z = profile[:, :1], profile[:, 1:]
    vertices = np.stack([r * np.cos(turn), r * np.sin(turn), z + 0 * turn], axis=-1).reshape(-1, 3)
    k = np.arange(len(profile) - 1)[:, None] * TURNS
    a, b = k + np.arange(TURNS), k + (np.arange(TURNS) + 1) % TURNS
    quads = [np.stack([a, a + TURNS, b + TURNS], axis=-1), np.stack([a, b + TURNS, b], axis=-1)]
    return Mesh(vertices, np.concatenate([quad.reshape(-1, 3) for quad in quads]))


def rim() -> np.ndarray:
    """The edge of the sharp stump: closed, counter-clockwise from above."""
    turn = 2 * np.pi * np.arange(TURNS + 1) / TURNS
    return np.column_stack([RADIUS_MM * np.cos(turn), RADIUS_MM * np.sin(turn), 0 * turn])


def test_the_reference_against_itself_is_the_floor() -> None:
    error = margin_error(cut_margin(stump(), stump(), rim()))
    assert error.floor == error.scan
    assert error.floor.found_pct == 100
    assert error.floor.sections > 150
    assert error.floor.max_um < 5


@given(towards=st.floats(0, 2 * np.pi), shift_um=st.floats(10, 120))
@settings(max_examples=4)
def test_a_scan_that_is_too_high_or_too_low_is_measured(towards: float, shift_um: float) -> None:
    sign = 1 if towards < np.pi else -1
    moved = stump().transformed(Rigid3(np.eye(3), np.array([0.0, 0.0, sign * shift_um / 1000])))
    found = margin_error(cut_margin(moved, stump(), rim())).scan
    assert found.mean_um == pytest.approx(shift_um, abs=5)
    # The edge is square: its bisector leans by 45 degrees, and lateral points down and outwards.
    assert found.outward_um == pytest.approx(sign * shift_um / np.sqrt(2), abs=5)
    assert found.lateral_um == pytest.approx(-sign * shift_um / np.sqrt(2), abs=5)


def test_a_larger_stump_moves_the_margin_both_outwards_and_aside() -> None:
    reference = stump()
    larger = Mesh(reference.vertices * [1.01, 1.01, 1.0], reference.faces)
    found = margin_error(cut_margin(larger, reference, rim())).scan
    assert found.mean_um == pytest.approx(30, abs=5)
    assert found.lateral_um == pytest.approx(30 / np.sqrt(2), abs=4)


@pytest.mark.parametrize("fillet_mm", [0.04, 0.08])
def test_a_rounded_edge_lies_inwards(fillet_mm: float) -> None:
    found = margin_error(cut_margin(stump(fillet_mm), stump(), rim())).scan
    expected_um = 1000 * fillet_mm * (np.sqrt(2) - 1)
    assert found.outward_um == pytest.approx(-expected_um, abs=4)
    assert found.lateral_um == pytest.approx(0, abs=4)
    assert found.found_pct > 98


@pytest.mark.parametrize(("far_deg", "found"), [(100.0, "far"), (62.5, "near")])
def test_a_sharper_edge_may_lie_farther_away(far_deg: float, found: str) -> None:
    """One and a half standard deviations (a quarter of the reach) away, one 3.1 times as sharp is as likely."""
    options = MarginOptions(reach_mm=2.4, min_bend_deg=15.0)
    bends = np.deg2rad([0.0, 25.0, far_deg])
    steps = np.array([2.0, 0.9, 1.0])
    ways = np.column_stack([np.cos(np.cumsum(-bends)), np.sin(np.cumsum(-bends))]) * steps[:, None]
    places = np.vstack([[0.0, 0.0], np.cumsum(ways, axis=0)]) - ways[0]
    edge = _edge(places, options)
    assert edge is not None
    expected = places[1] if found == "near" else places[2]
    assert np.linalg.norm(edge.point - expected) < 0.03


def test_what_the_scan_lacks_is_not_found() -> None:
    reference = stump()
    half = reference.submesh(reference.face_centres[:, 0] > 0)
    found = margin_error(cut_margin(half, reference, rim())).scan
    assert 40 < found.found_pct < 52
    assert found.mean_um < 5


def test_a_scan_elsewhere_has_no_edge() -> None:
    far = stump().transformed(Rigid3(np.eye(3), np.array([50.0, 0.0, 0.0])))
    found = margin_error(cut_margin(far, stump(), rim())).scan
    assert found.found_pct == 0
    assert np.isnan(found.mean_um)


def test_margins_are_named_by_tooth_and_the_alignment_is_applied() -> None:
    away = Rigid3.from_rotation_vector(np.array([0.1, -0.2, 0.3]), np.array([1.0, 2.0, 3.0]))
    jaw = Jaw(mesh=stump(), lines={"45.margin": rim(), "46.crack": rim()})
    margins = cut_margins(stump().transformed(away), jaw, away.inverse())
    assert list(margins) == [45]
    assert margin_error(margins[45]).scan.max_um < 5


@pytest.mark.parametrize("up_mm", [0.05, -0.05])
def test_sections_show_where_the_scan_lies(up_mm: float) -> None:
    """The edge is square, so the scan's is the reference's, moved, in coordinates of its own."""
    moved = stump().transformed(Rigid3(np.eye(3), np.array([0.0, 0.0, up_mm])))
    cut = cut_margin(moved, stump(), rim())
    shift = up_mm * np.array([-1.0, 1.0]) / np.sqrt(2)
    for section in cut.sections:
        assert np.hypot(*section.place_mm[:2]) == pytest.approx(RADIUS_MM, abs=0.002)
        assert section.scan is not None
        assert section.scan_edge == pytest.approx(section.reference_edge + shift, abs=0.01)
        lateral, outward = section.reference.T
        assert outward == pytest.approx(-np.abs(lateral), abs=0.01)
        assert np.abs(section.scan - shift) @ [-1, 0] == pytest.approx((section.scan - shift)[:, 1], abs=0.01)
    assert len(cut.sections) == margin_error(cut).scan.sections


def test_a_line_that_is_no_edge_is_refused() -> None:
    with pytest.raises(InputError, match="no edge"):
        cut_margin(stump(), stump(), rim() * [0.6, 0.6, 1.0])
    with pytest.raises(InputError, match="too short"):
        cut_margin(stump(), stump(), rim()[:4])
    with pytest.raises(InputError, match="flanks"):
        MarginOptions(flank_from_mm=0.5)


def test_margins_are_measured_and_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A tooth whose edge was scanned 50 um too low."""
    for costly in ("save_deviation_picture", "report"):
        monkeypatch.setattr(f"cuspid.cli.scan.{costly}", lambda *_, **__: None)
    tooth, low, out = stump(), Rigid3(np.eye(3), np.array([0.0, 0.0, -0.05])), tmp_path / "out"
    labels = np.full(len(tooth.faces), 46, dtype=np.int32)
    storage.write_jaw(tmp_path / "jaw.ply", Jaw(mesh=tooth, face_labels=labels, lines={"46.margin": rim()}))
    storage.write_mesh(tmp_path / "scan.ply", tooth.transformed(low))
    run("evaluate", tmp_path / "scan.ply", tmp_path / "jaw.ply", "--out", out, "--no-align", "--samples", 2000)
    assert storage.read_json(out / "margins.json")["46"]["scan"]["mean_um"] == pytest.approx(50, abs=5)
    assert "Margins in µm" in capsys.readouterr().out
    assert out / "margins.png" in storage.read_result(out).pictures.values()
    pixels = np.asarray(Image.open(out / "margins.png").convert("RGB")).astype(int)
    assert (np.ptp(pixels, axis=2) > 120).mean() > 0.001, "the scan is drawn in red"
