"""A brief is read and checked; the family holds the designs of the thesis; the search improves on them."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cuspid.geometry import Rigid3
from cuspid.handpiece.brief import CamerasBrief, DesignBrief, MouthBrief, parse_brief, read_brief
from cuspid.handpiece.designs import essential_four, six_cameras, twelve_cameras
from cuspid.handpiece.family import LAYOUTS, Layout, Shape, build_handpiece
from cuspid.handpiece.optimise import (
    Assessment,
    SearchOptions,
    Section,
    assess_handpiece,
    handpiece_outline,
    optimise_handpiece,
)
from cuspid.handpiece.precision import bound_rms_um, fisher_information
from cuspid.handpiece.presets import PRESETS
from cuspid.model.mesh import Mesh
from cuspid.model.rig import Handpiece
from cuspid.report.figures.design import save_design_picture
from cuspid.runtime.errors import InputError

SMALL = """
sensor = "thesis"
thickness_mm = 7
working_distance_mm = [4.0, 6.0]
[surfaces]
occlusal = 0.9
buccal = 0.9
lingual = 0.9
"""
QUICK = SearchOptions(points=20, samples=1, finalists=1, evaluations=15)
FIGURES = "width_px = 400\nheight_px = 400\npixel_um = 1.75\nfield_of_view_deg = 80.0\nf_number = 8.0\nfocus_mm = 4.5"


def brief_of(text: str = SMALL, **changes: object) -> DesignBrief:
    return replace(parse_brief(tomllib.loads(text)), **changes)


def box_tooth(half_mm: float = 4.5, height_mm: float = 7.0, cells: int = 10) -> Section:
    """A tooth like a box on a plane, its top at z = 0, seen from three places along X."""
    ticks = np.linspace(-half_mm, half_mm, cells + 1)
    depth = np.linspace(-height_mm, 0.0, cells + 1)

    def sheet(u: np.ndarray, v: np.ndarray, place: list[np.ndarray | float]) -> tuple[np.ndarray, np.ndarray]:
        grid = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1).reshape(-1, 2)
        slots = iter(grid.T)
        points = np.stack([np.full(len(grid), x) if isinstance(x, float) else next(slots) for x in place], axis=1)
        n, m = len(u), len(v)
        a = (np.arange(n - 1)[:, None] * m + np.arange(m - 1)).ravel()
        return points, np.concatenate([np.stack([a, a + m, a + m + 1], 1), np.stack([a, a + m + 1, a + 1], 1)])

    free = np.zeros(0)
    sheets = {
        "occlusal": sheet(ticks, ticks, [free, free, 0.0]),
        "buccal": sheet(-ticks, depth, [free, half_mm, free]),
        "lingual": sheet(ticks, depth, [free, -half_mm, free]),
    }
    vertices, faces, owner = [], [], []
    for name, (points, triangles) in sheets.items():
        faces.append(triangles + sum(map(len, vertices)))
        vertices.append(points)
        owner += [name] * len(triangles)
    mesh = Mesh(np.concatenate(vertices), np.concatenate(faces))
    names = np.array(owner)
    poses = tuple(Rigid3(np.eye(3), np.array([-x, 0.0, 0.0])) for x in (-3.0, 0.0, 3.0))
    return Section(mesh=mesh, surfaces={name: names == name for name in sheets}, rig_from_world=poses)


@pytest.fixture(scope="module")
def section() -> Section:
    return box_tooth()


def assessed(handpiece: Handpiece, section: Section, brief: DesignBrief | None = None) -> Assessment:
    return assess_handpiece(handpiece, brief or brief_of(), [section], 14.0, QUICK)


# --- the brief ----------------------------------------------------------------------------------------------------


def test_a_brief_is_read_with_its_defaults(tmp_path: Path) -> None:
    path = tmp_path / "brief.toml"
    path.write_text(SMALL + "[cameras]\nmax = 8\n[motion]\nturns = 3\n")
    brief = read_brief(path)
    assert brief.sensor == PRESETS["thesis"]
    assert brief.working_distance_mm == (4.0, 6.0)
    assert (brief.cameras.max, brief.motion.turns, brief.mouth.tooth) == (8, 3, 7)
    near, far = brief.depth_range_mm
    assert 0 < near < 4.0 < 6.0 < far < 15.0


@pytest.mark.parametrize("thickness_mm", [0.5, 2.0, 7.0])
def test_modules_and_plates_have_the_thickness_together(thickness_mm: float) -> None:
    holder = brief_of(thickness_mm=thickness_mm).holder
    assert holder.camera_mm[2] + holder.wall_mm == pytest.approx(thickness_mm)


def test_a_sensor_may_be_changed_or_given_by_its_own_figures() -> None:
    changed = brief_of(SMALL.replace('"thesis"', '{preset = "thesis", focus_mm = 4.2}'))
    assert changed.sensor == replace(PRESETS["thesis"], focus_mm=4.2)
    own = brief_of(SMALL.replace('"thesis"', "{" + FIGURES.replace("\n", ", ") + "}"))
    assert own.sensor.width_px == 400
    assert own.sensor.camera.width == 400


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"thesis"', '"kodak"', r"unknown sensor 'kodak'; choose one of thesis, "),
        ('"thesis"', '{preset = "thesis", zoom = 2}', r"sensor: unknown key zoom"),
        ('"thesis"', "{width_px = 400}", r"sensor: .*pixel_um.* missing"),
        ("thickness_mm = 7", "", r"thickness_mm missing"),
        ("thickness_mm = 7", 'thickness_mm = "7"', r"thickness_mm must be a number"),
        ("thickness_mm = 7", 'thickness_mm = 7\nname = "' + "x" * 101 + '"', r"name is .*at most 100 characters"),
        ("thickness_mm = 7", "thickness_mm = -7", r"thickness_mm is -7"),
        ("thickness_mm = 7", "thickness_mm = 7\ncolour = 3", r"unknown key colour; choose from .*blur_px"),
        ("[4.0, 6.0]", "[6.0, 4.0]", r"working_distance_mm is 6-4"),
        ("[4.0, 6.0]", "[4.0, 20.0]", r"depth of field of thesis.*does not cover the working distance 4-20 mm"),
        ("[4.0, 6.0]", "[1.0, 6.0]", r"depth of field of thesis.*does not cover"),
        ("occlusal = 0.9", "occlusal = 90", r"share of surface 'occlusal' is 90"),
        ("[surfaces]", "[cameras]\nmax = 1\n[surfaces]", r"cameras.max is 1"),
        ("[surfaces]", "[cameras]\nmax = 2.5\n[surfaces]", r"cameras.max must be a whole number"),
        ("[surfaces]", "[cameras]\nspacing_mm = 0.1\n[surfaces]", r"less than the width of the sensor"),
        ("[surfaces]", "[motion]\nturns = 2\n[surfaces]", r"motion.turns is 2"),
        ("[surfaces]", "[mouth]\ntooth = 9\n[surfaces]", r"mouth.tooth is 9"),
        ("[surfaces]", "[mouth]\npeople = 1.0\n[surfaces]", r"mouth.people is 1"),
        ("[surfaces]", "[weights]\ncoverage = -1.0\n[surfaces]", r"weights must not be negative"),
    ],
)
def test_each_wrong_condition_is_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "brief.toml"
    path.write_text(SMALL.replace(old, new))
    with pytest.raises(InputError, match=message) as raised:
        read_brief(path)
    assert str(raised.value).startswith(str(path))
    assert "\n" not in str(raised.value)


def test_what_is_no_toml_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "brief.toml"
    path.write_text("sensor = ")
    with pytest.raises(InputError, match=r"cannot be read as TOML"):
        read_brief(path)
    with pytest.raises(InputError, match=r"no such file"):
        read_brief(tmp_path / "none.toml")


def test_a_gap_that_is_too_small_is_refused_before_anything_is_searched(section: Section) -> None:
    with pytest.raises(InputError, match=r"7 mm \+ working distance 4 mm is 11 mm, more than the gap of 10.9 mm .*95%"):
        optimise_handpiece(brief_of(), [section], 10.9)
    brief_of().check_gap(11.0)


def test_a_surface_that_the_teeth_have_not_is_refused(section: Section) -> None:
    with pytest.raises(InputError, match=r"'palatal' must be seen.*buccal, lingual, occlusal"):
        optimise_handpiece(brief_of(surfaces={"palatal": 0.5}), [section], 14.0)


# --- the family ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("layout", "design"),
    [
        (Layout(occlusal=4, outer=0, side=0), essential_four),
        (Layout(occlusal=4, outer=2, side=0), six_cameras),
        (Layout(occlusal=4, outer=0, side=4), twelve_cameras),
    ],
)
def test_the_family_holds_the_designs_of_the_thesis(layout: Layout, design: object) -> None:
    made = build_handpiece(layout, Shape(), PRESETS["thesis"], (2.5, 9.0))
    given_design: Handpiece = design()  # type: ignore[operator]
    assert made.rig.names == given_design.rig.names
    for name, mounted in given_design.rig.cameras.items():
        np.testing.assert_allclose(made.rig[name].cam_from_rig.matrix, mounted.cam_from_rig.matrix, atol=1e-12)
        np.testing.assert_allclose(made.rig[name].camera.focal_px, mounted.camera.focal_px)
    for name, light in given_design.lights.items():
        np.testing.assert_allclose(made.lights[name].position_mm, light.position_mm, atol=1e-12)


SHAPES = st.builds(
    Shape,
    distance_mm=st.floats(3, 8),
    across_mm=st.floats(1, 4),
    along_mm=st.floats(1, 4),
    outer_distance_mm=st.floats(1, 5),
    outer_tilt_deg=st.floats(0, 60),
    side_tilt_deg=st.floats(35, 85),
)


@given(st.sampled_from(LAYOUTS), SHAPES)
def test_every_member_is_symmetric_and_has_its_cameras(layout: Layout, shape: Shape) -> None:
    made = build_handpiece(layout, shape, PRESETS["thesis"], (2.5, 9.0))
    assert len(made.rig.names) == layout.cameras
    # A group of three has its third camera on one side; those over the teeth have two or four.
    centres = np.array([each.centre_in_rig for each in made.rig.cameras.values()])
    gaps = np.linalg.norm(centres[:, None] - centres[None] * [1, -1, 1], axis=2).min(axis=1)
    assert gaps.max() < 1e-9
    outline = handpiece_outline(made, 7.0)
    assert outline[:, 1].max() >= shape.distance_mm + 7.0 - 1e-9


# --- one design ---------------------------------------------------------------------------------------------------


def test_the_bound_of_a_pair_is_that_of_its_fisher_matrix(section: Section) -> None:
    pair = build_handpiece(Layout(occlusal=2, outer=0, side=0), Shape(), PRESETS["thesis"], (2.5, 9.0))
    still = replace(section, rig_from_world=(Rigid3.identity(),))
    found = assessed(pair, still)
    noise = QUICK.noise
    near = np.array([[0.0, 0, 0], [1.0, 1.0, 0], [-1.0, 2.0, 0]])
    expected = bound_rms_um(fisher_information(list(pair.rig.cameras.values()), near, noise))
    assert expected.min() * 0.9 < found.bound_um["occlusal"] < expected.max() * 1.2


def test_twelve_cameras_see_the_sides_of_a_box_and_four_do_not(section: Section) -> None:
    four, twelve = assessed(essential_four(), section), assessed(twelve_cameras(), section)
    for name in ("buccal", "lingual"):
        assert four.seen[name] < 0.02
        assert 0.6 < twelve.seen[name] <= 1
    assert four.seen["occlusal"] > 0.6
    assert {c.name for c in four.unmet} >= {"share of buccal", "share of lingual"}
    assert four.cost > twelve.cost


def test_noise_and_room_count(section: Section) -> None:
    quiet = assess_handpiece(essential_four(), brief_of(), [section], 14.0, QUICK)
    loud = assess_handpiece(
        essential_four(), brief_of(), [section], 14.0, replace(QUICK, noise=replace(QUICK.noise, sigma_px=1.0))
    )
    assert loud.mean_bound_um == pytest.approx(2 * quiet.mean_bound_um, rel=1e-6)
    assert "height above the teeth, mm" not in {c.name for c in quiet.unmet}
    tight = assess_handpiece(essential_four(), brief_of(), [section], 11.9, QUICK)
    (height,) = (c for c in tight.unmet if c.name.startswith("height"))
    assert height.reached == pytest.approx(12.0, abs=0.01)
    narrow = assess_handpiece(twelve_cameras(), brief_of(width_mm=20.0), [section], 14.0, QUICK)
    assert "width, mm" in {c.name for c in narrow.unmet}


def test_a_rig_that_touches_or_is_too_dense_is_told(section: Section) -> None:
    shape = Shape(side_tilt_deg=85.0, side_offset_mm=-2.0, along_mm=1.0, across_mm=1.0)
    made = build_handpiece(Layout(occlusal=4, outer=0, side=4), shape, PRESETS["thesis"], (2.5, 9.0))
    names = {c.name for c in assessed(made, section).unmet}
    assert {"clearance, mm", "spacing of the cameras, mm"} <= names


# --- the search ---------------------------------------------------------------------------------------------------


def test_the_search_improves_over_the_thesis_and_can_be_repeated(section: Section) -> None:
    brief = brief_of(cameras=CamerasBrief(max=6))
    first, second = (optimise_handpiece(brief, [section], 14.0, QUICK) for _ in range(2))
    thesis = build_handpiece(first.best.layout, Shape(), brief.sensor, brief.depth_range_mm)
    assert first.best.assessment.cost < assessed(thesis, section, brief).cost - 0.01
    assert first.best.shape == second.best.shape
    assert first.best.assessment.cost == second.best.assessment.cost
    assert first.evaluations == second.evaluations <= 2 * len(first.trials) + 20
    assert [t.assessment.cost for t in first.trials] == sorted(t.assessment.cost for t in first.trials)
    assert first.handpiece.working_distance_mm == first.best.shape.distance_mm
    assert first.handpiece.body is not None
    assert first.handpiece.body.bounds[1, 2] >= first.best.shape.distance_mm + brief.thickness_mm - 1e-9
    low, high = brief.working_distance_mm
    assert low <= first.handpiece.working_distance_mm <= high


def test_a_brief_that_no_rig_meets_names_the_condition(section: Section) -> None:
    brief = brief_of(surfaces={"buccal": 0.99}, cameras=CamerasBrief(max=4), mouth=MouthBrief(clearance_mm=0.3))
    design = optimise_handpiece(brief, [section], 14.0, QUICK)
    assert len(design.handpiece.rig.names) <= 4
    with pytest.raises(
        InputError, match=r"no handpiece with at most 4 cameras .* share of buccal: 0.*required >= 0.99"
    ):
        design.check(brief)


def test_a_brief_that_is_met_passes(section: Section) -> None:
    brief = brief_of(surfaces={"occlusal": 0.5}, cameras=CamerasBrief(max=4))
    design = optimise_handpiece(brief, [section], 14.0, replace(QUICK, samples=0))
    design.check(brief)
    assert design.best.assessment.unmet == ()


def test_a_section_is_cut_from_a_jaw_with_the_surfaces_of_the_tooth(section: Section) -> None:
    far = section.mesh.transformed(Rigid3(np.eye(3), np.array([30.0, 0, 0])))
    both = Mesh(
        np.concatenate([section.mesh.vertices, far.vertices]),
        np.concatenate([section.mesh.faces, far.faces + len(far.vertices)]),
    )
    count = len(far.faces)
    tooth = np.arange(2 * count) < count
    cut = Section.cut(both, tooth, {"occlusal": np.tile(section.surfaces["occlusal"], 2)}, section.rig_from_world)
    assert len(cut.mesh.faces) == count
    np.testing.assert_array_equal(cut.surfaces["occlusal"], section.surfaces["occlusal"])


# --- the picture --------------------------------------------------------------------------------------------------


def test_a_design_is_drawn(section: Section, tmp_path: Path) -> None:
    twelve = twelve_cameras()
    path = tmp_path / "design.png"
    save_design_picture(path, twelve, section.mesh, handpiece_outline(twelve, 7.0), title="twelve", notes=("a", "b"))
    assert path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    bare = tmp_path / "bare.png"
    save_design_picture(bare, Handpiece(rig=twelve.rig))
    assert bare.stat().st_size > 20_000
