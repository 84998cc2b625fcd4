"""The mouth opens as geometry says, people are drawn as their sources say, and shares are counted right."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from PIL import Image
from scipy.optimize import brentq

from cuspid.anatomy.mouth import (
    OPENINGS,
    PRINTED_GAP_MM,
    RAMUS,
    Anatomy,
    Mouth,
    MouthOptions,
    Normal,
    draw_people,
    fit_curve,
    fit_pct,
    opening_turn_rad,
    sagittal_view,
    study_mouths,
    thesis_lines,
    tooth_ends_mm,
    typical_mouth,
)
from cuspid.report.figures.mouth import save_fit_picture, save_gap_picture, save_sagittal_picture
from cuspid.runtime.errors import InputError

R, H = 90.0, 90.0 * np.sin(np.deg2rad(22.5))

openings = st.floats(25, 65)
radii = st.floats(75, 110)
depths = st.floats(20, 48)
paths = st.floats(0, 20)
slopes = st.floats(0, 60)


def a_mouth(opening: float, radius: float = R, depth: float = H, path: float = 12.0, slope: float = 35.0) -> Mouth:
    return Mouth(interincisal_mm=opening, radius_mm=radius, depth_mm=depth, path_mm=path, slope_deg=slope)


# --- one mouth ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("opening", "gap"), [(35.0, 18.0), (40.0, 21.0), (50.0, 25.0), (60.0, 30.0)])
def test_a_common_mouth_has_the_known_gap(opening: float, gap: float) -> None:
    assert float(a_mouth(opening).gap_mm(46.5)) == pytest.approx(gap, abs=0.7)


@given(openings, radii, depths, st.floats(0, 60))
def test_a_pure_hinge_moves_every_tooth_on_a_chord(opening: float, radius: float, depth: float, behind: float) -> None:
    mouth = a_mouth(opening, radius, depth, path=0.0)
    distance = np.hypot(mouth.incisor_mm - behind, depth)
    assert float(mouth.gap_mm(behind)) == pytest.approx(float(2 * distance * np.sin(mouth.turn_rad / 2)), abs=1e-9)


@given(openings, radii, depths, paths, slopes)
def test_the_angle_gives_the_opening(opening: float, radius: float, depth: float, path: float, slope: float) -> None:
    assume(np.isfinite(opening_turn_rad(opening, radius, depth, path, slope)))
    mouth = a_mouth(opening, radius, depth, path, slope)
    assert float(mouth.gap_mm(0.0)) == pytest.approx(opening, abs=1e-9)
    assert 0 < float(mouth.turn_rad) < np.pi / 2


@given(openings, radii, depths, paths, slopes)
def test_the_angle_is_the_one_that_a_search_finds(
    opening: float, radius: float, depth: float, path: float, slope: float
) -> None:
    x, beta = np.sqrt(radius**2 - depth**2), np.deg2rad(slope)

    def excess(theta: float) -> float:
        down = x * np.sin(theta) - depth * (1 - np.cos(theta)) + path * np.sin(beta)
        forwards = -x * (1 - np.cos(theta)) - depth * np.sin(theta) + path * np.cos(beta)
        return float(np.hypot(down, forwards)) - opening

    # From where the incisors are nearest to their closed place the opening grows with the angle.
    nearest = max(0.0, min(np.linspace(0, 1.5, 3001), key=excess))
    assume(excess(nearest) < -0.1 and excess(1.5) > 0)
    assert float(a_mouth(opening, radius, depth, path, slope).turn_rad) == pytest.approx(
        brentq(excess, nearest, 1.5, xtol=1e-13), abs=1e-9
    )


@given(openings, radii, depths, paths, slopes, st.floats(0, 50))
def test_points_of_the_lower_jaw_keep_their_distances(
    opening: float, radius: float, depth: float, path: float, slope: float, behind: float
) -> None:
    assume(np.isfinite(opening_turn_rad(opening, radius, depth, path, slope)))
    mouth = a_mouth(opening, radius, depth, path, slope)
    front, back = mouth.places_mm(np.array([0.0, behind]))
    assert np.linalg.norm(front - back) == pytest.approx(behind, abs=1e-9)
    assert np.linalg.norm(front - mouth.condyle_mm()) == pytest.approx(radius, abs=1e-9)
    closed = mouth.places_mm(np.array([0.0, behind]), 0.0)
    assert np.linalg.norm(back - closed[1]) == pytest.approx(float(mouth.gap_mm(behind)), abs=1e-9)
    assert closed[1, 1] - back[1] == pytest.approx(float(mouth.vertical_gap_mm(behind)), abs=1e-9)


@given(st.floats(30, 60), st.floats(0, 14))
def test_the_gap_grows_with_the_opening_and_forwards(opening: float, path: float) -> None:
    mouth, wider = a_mouth(opening, path=path), a_mouth(opening + 1, path=path)
    gaps = np.array([float(mouth.gap_mm(end)) for end in (0.0, *tooth_ends_mm(28.1))])
    assert np.all(np.diff(gaps) < 0)
    assert gaps[-1] < float(wider.gap_mm(tooth_ends_mm(28.1)[-1])) < gaps[-1] + 1


def test_condyles_that_slide_turn_the_jaw_less() -> None:
    mouths = [a_mouth(45.0, path=path) for path in (0.0, 6.0, 12.0)]
    assert np.all(np.diff([float(mouth.turn_rad) for mouth in mouths]) < 0)
    # The jaw swings back less under the skull: the molars stay more nearly above each other.
    backwards = [-float(mouth.displacement_mm(45.0)[0]) for mouth in mouths]
    assert np.all(np.diff(backwards) < -1)
    assert np.all(np.diff([float(mouth.vertical_gap_mm(45.0)) for mouth in mouths]) > 0.5)
    assert np.all(np.diff([float(mouth.gap_mm(45.0)) for mouth in mouths]) < -0.2)


def test_the_overlap_of_the_incisors_adds_to_the_opening() -> None:
    plain = Mouth(interincisal_mm=43.0)
    overlapping = Mouth(interincisal_mm=40.0, overlap_mm=3.0)
    assert float(overlapping.gap_mm(45.0)) == pytest.approx(float(plain.gap_mm(45.0)))
    assert float(overlapping.gap_mm(45.0)) > float(Mouth(interincisal_mm=40.0).gap_mm(45.0)) + 1


def test_many_mouths_are_each_like_one() -> None:
    opening, depth = np.array([35.0, 45.0, 55.0]), np.array([30.0, 34.0, 40.0])
    many = Mouth(interincisal_mm=opening, depth_mm=depth, path_mm=np.full(3, 10.0))
    for k in range(3):
        one = Mouth(interincisal_mm=float(opening[k]), depth_mm=float(depth[k]), path_mm=10.0)
        assert np.asarray(many.gap_mm(45.0))[k] == pytest.approx(float(one.gap_mm(45.0)))


@pytest.mark.parametrize(
    ("values", "word"),
    [
        ({"interincisal_mm": 190.0}, "no rotation"),
        ({"interincisal_mm": 5.0}, "no rotation"),
        ({"interincisal_mm": -40.0}, "interincisal_mm"),
        ({"interincisal_mm": 40.0, "radius_mm": 0.0}, "radius_mm"),
        ({"interincisal_mm": 40.0, "depth_mm": 95.0}, "distance to the incisors"),
        ({"interincisal_mm": 40.0, "path_mm": -1.0}, "path_mm"),
        ({"interincisal_mm": np.array([40.0, -1.0])}, "-1"),
    ],
)
def test_an_impossible_mouth_is_refused_in_one_line(values: dict[str, float], word: str) -> None:
    with pytest.raises(InputError, match=word) as caught:
        Mouth(**values)
    assert "\n" not in str(caught.value)


def test_teeth_end_one_behind_the_other() -> None:
    ends = tooth_ends_mm(np.array([28.1, 30.0]))
    assert ends.shape == (2, 7)
    assert np.all(np.diff(ends, axis=1) > 0)
    np.testing.assert_allclose((ends[:, 4] + ends[:, 5]) / 2, [28.1, 30.0])
    assert ends[0, 6] == pytest.approx(45, abs=2)


# --- people -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("study", list(OPENINGS))
@pytest.mark.parametrize("sex", ["men", "women"])
def test_people_are_as_their_source_says(study: str, sex: str) -> None:
    people = draw_people(OPENINGS[study][sex], MouthOptions(), np.random.default_rng(1))
    anatomy, mouth = Anatomy(), people.mouth
    for drawn, source in (
        (mouth.interincisal_mm, OPENINGS[study][sex]),
        (mouth.depth_mm, anatomy.depth_mm),
        (mouth.path_mm, anatomy.path_mm),
        (mouth.slope_deg, anatomy.slope_deg),
        (mouth.overlap_mm, anatomy.overlap_mm),
        ((people.ends_mm[:, 4] + people.ends_mm[:, 5]) / 2, anatomy.molar_depth_mm),
    ):
        assert np.mean(drawn) == pytest.approx(source.mean, abs=0.03 * source.sd)
        assert np.std(drawn) == pytest.approx(source.sd, rel=0.03)
    assert people.left_out < 50
    assert people.left_out + len(people.ends_mm) == 20_000


def test_the_intervals_of_rieder_hold_the_share_that_he_gives() -> None:
    men, women = (
        draw_people(OPENINGS["rieder-1978"][sex], MouthOptions(), np.random.default_rng(2)).mouth.interincisal_mm
        for sex in ("men", "women")
    )
    assert np.mean((men > 40) & (men < 60)) == pytest.approx(0.83, abs=0.01)
    assert np.mean((women > 35) & (women < 55)) == pytest.approx(0.87, abs=0.01)


def test_the_draw_follows_its_options() -> None:
    opening = OPENINGS["india-2012"]["men"]
    plain, same, other = (
        draw_people(opening, MouthOptions(people=500), np.random.default_rng(seed)) for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(plain.gap_mm, same.gap_mm)
    assert not np.array_equal(plain.gap_mm, other.gap_mm)
    tall = draw_people(opening, MouthOptions(ramus=True), np.random.default_rng(0))
    assert np.mean(tall.mouth.depth_mm) == pytest.approx(RAMUS.mean, abs=0.3)
    bare = draw_people(opening, MouthOptions(overlap=False), np.random.default_rng(0))
    assert np.all(bare.mouth.overlap_mm == 0)
    half = draw_people(opening, MouthOptions(held=0.5), np.random.default_rng(0))
    assert np.mean(half.mouth.interincisal_mm) == pytest.approx(opening.mean / 2, abs=0.1)
    assert np.mean(half.mouth.path_mm) == pytest.approx(Anatomy().path_mm.mean / 2, abs=0.1)
    tied = draw_people(opening, MouthOptions(correlation=0.5), np.random.default_rng(0)).mouth
    assert np.corrcoef(tied.interincisal_mm, tied.radius_mm)[0, 1] == pytest.approx(0.487, abs=0.02)


def test_impossible_draws_are_counted_and_a_hopeless_population_refused() -> None:
    narrow = Normal(mean=14.0, sd=2.0, source="made up")
    people = draw_people(narrow, MouthOptions(people=1000, overlap=False), np.random.default_rng(0))
    assert 50 < people.left_out < 900
    with pytest.raises(InputError, match="none of the sampled"):
        draw_people(Normal(mean=300.0, sd=1.0, source="made up"), MouthOptions(people=10), np.random.default_rng(0))


# --- shares -------------------------------------------------------------------------------------------------------


def test_shares_are_what_counting_gives() -> None:
    rng = np.random.default_rng(0)
    room, needed = rng.uniform(0, 30, (500, 7)), np.array([0.0, 5.0, 12.0, 29.0, 1000.0])
    counted = [[100 * np.mean(room[:, tooth] >= each) for tooth in range(7)] for each in needed]
    np.testing.assert_allclose(fit_pct(room, needed), counted)
    assert np.all(fit_pct(room, needed)[0] == 100)
    assert np.all(fit_pct(room, needed)[-1] == 0)


def test_the_report_counts_people_whose_gap_is_large_enough() -> None:
    options = MouthOptions(thickness_mm=12.0, working_distance_mm=5.0, clearance_mm=1.0, people=4000)
    report, people = study_mouths(options)
    assert report.needed_mm == 18.0
    for sex, group in report.groups.items():
        assert group.fit_pct[7] == pytest.approx(100 * np.mean(people[sex].gap_mm[:, 6] >= 18.0))
        assert 50 < group.fit_pct[7] < 99
        assert list(group.fit_pct.values()) == sorted(group.fit_pct.values(), reverse=True)
        assert group.gap_mm[7]["p5"] < group.gap_mm[7]["p50"] < group.gap_mm[6]["p50"]
    assert report.groups["men"].fit_pct[7] > report.groups["women"].fit_pct[7]
    strict, _ = study_mouths(MouthOptions(thickness_mm=12.0, working_distance_mm=6.0, people=4000, vertical=True))
    assert strict.groups["men"].fit_pct[7] < report.groups["men"].fit_pct[7]


def test_nothing_fits_everybody_and_too_much_fits_nobody() -> None:
    none, _ = study_mouths(MouthOptions(thickness_mm=0.0, working_distance_mm=0.0, people=500))
    huge, _ = study_mouths(MouthOptions(thickness_mm=200.0, people=500))
    for sex in ("men", "women"):
        assert set(none.groups[sex].fit_pct.values()) == {100.0}
        assert set(huge.groups[sex].fit_pct.values()) == {0.0}


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"thickness_mm": -1.0}, "thickness-mm"),
        ({"people": 0}, "people"),
        ({"correlation": 2.0}, "correlation"),
        ({"held": 1.2}, "held"),
    ],
)
def test_impossible_options_are_refused_in_one_line(options: dict[str, float], word: str) -> None:
    with pytest.raises(InputError, match=word):
        MouthOptions(**options)


def test_the_lines_of_the_thesis_are_recomputed_from_its_own_inputs() -> None:
    first, second, third, fourth = thesis_lines()
    assert first.recomputed.startswith("77.8-133.3;")
    assert second.recomputed.startswith("21.6-39.3;")
    assert "38.1-86.4" in third.recomputed
    assert fourth.recomputed.startswith("15.7-41.3 ")
    assert "17.1-38.9" in fourth.recomputed
    assert all(line.reason and line.printed for line in thesis_lines())


# --- pictures -----------------------------------------------------------------------------------------------------


def test_the_sagittal_view_is_the_typical_mouth() -> None:
    options = MouthOptions()
    view, (mouth, ends) = (
        sagittal_view(OPENINGS["india-2012"]["men"], options),
        typical_mouth(OPENINGS["india-2012"]["men"], options),
    )
    gaps = np.linalg.norm(view.closed_mm - view.opened_mm, axis=1)
    assert gaps[0] == pytest.approx(51.3 + 2.9)
    assert gaps[-1] == pytest.approx(float(mouth.gap_mm(ends[-1])))
    for arc, tooth in zip(view.arcs_mm, (0, -1), strict=True):
        np.testing.assert_allclose(arc[[0, -1]], [view.closed_mm[tooth], view.opened_mm[tooth]], atol=1e-9)


def test_the_fit_curve_falls_from_everybody_to_few() -> None:
    options = MouthOptions(people=500)
    report, people = study_mouths(options)
    needed, shares = fit_curve(people, options)
    for sex, share in shares.items():
        assert np.all(share[0] == 100)
        assert np.all(np.diff(share, axis=0) <= 0)
        assert share[-1, 6] < 10
        assert share[np.searchsorted(needed, options.total_mm), 6] == pytest.approx(report.groups[sex].fit_pct[7])


def test_pictures_are_drawn(tmp_path: Path) -> None:
    options = MouthOptions(people=500)
    view = sagittal_view(OPENINGS["india-2012"]["women"], options)
    save_sagittal_picture(
        tmp_path / "s.png", view.closed_mm, view.opened_mm, view.condyle_mm, view.arcs_mm, 7.0, 5.0, title="a"
    )
    _, people = study_mouths(options)
    needed, shares = fit_curve(people, options)
    save_fit_picture(tmp_path / "f.png", needed, shares, options.total_mm, title="b")
    save_gap_picture(tmp_path / "g.png", {sex: group.gap_mm[:, 6] for sex, group in people.items()}, PRINTED_GAP_MM)
    for name in "sfg":
        assert np.asarray(Image.open(tmp_path / f"{name}.png")).std() > 10
