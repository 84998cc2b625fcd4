"""A phantom has the dimensions, teeth and irregularities that it is asked for, and a population those of its table."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.stats import chi2

from cuspid.anatomy.landmarks.scheme import labels_of
from cuspid.anatomy.phantom.build import build_phantom, phantom_landmarks, phantom_teeth
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.anatomy.phantom.population import GROUPS, LENGTHS, GroupName, Normal, draw_and_count, draw_population
from cuspid.model.jaw import Arch, Jaw, Landmark
from cuspid.runtime.errors import InputError

TOLERANCE_MM = 0.05
QUADRANTS = {"lower": (30, 40), "upper": (10, 20)}


def ends_of(landmarks: dict[str, Landmark], arch: Arch, position: int, point: str) -> np.ndarray:
    """A landmark on both sides (2, 3)."""
    return np.array([landmarks[f"{quadrant + position}.{point}"].position for quadrant in QUADRANTS[arch]])


def dimensions_of(landmarks: dict[str, Landmark], arch: Arch) -> np.ndarray:
    """a, b, c and f, mm."""
    points = [ends_of(landmarks, arch, *pair) for pair in ((3, "cusp_tip"), (6, "buccal_groove"), (7, "buccal_groove"))]
    widths = [np.linalg.norm(one - other) for one, other in points]
    return np.array([*widths, np.linalg.norm(points[2].mean(axis=0) - landmarks["papilla"].position)])


def irregularity_of(landmarks: dict[str, Landmark], arch: Arch) -> float:
    """Little's index: the distances between the anatomical contacts of the six front teeth, added up, mm."""
    negative, positive = QUADRANTS[arch]
    row = [f"{negative + 3}.mesial_angle"]
    for fdi in (negative + 2, negative + 1):
        row += [f"{fdi}.distal_angle", f"{fdi}.mesial_angle"]
    for fdi in (positive + 1, positive + 2):
        row += [f"{fdi}.mesial_angle", f"{fdi}.distal_angle"]
    points = np.array([landmarks[label].position[:2] for label in [*row, f"{positive + 3}.mesial_angle"]])
    return float(np.linalg.norm(points[1::2] - points[::2], axis=1).sum())


@pytest.mark.long
@settings(max_examples=2)
@given(
    a=st.floats(25.0, 29.0),
    b=st.floats(49.5, 53.0),
    widening=st.floats(2.0, 8.0),
    f=st.floats(32.0, 35.5),
    seed=st.integers(0, 2**31),
)
def test_asked_dimensions_are_measured(a: float, b: float, widening: float, f: float, seed: int) -> None:
    options = PhantomOptions(
        seed=seed,
        inter_canine_mm=a,
        inter_first_molar_mm=b,
        inter_second_molar_mm=b + widening,
        arch_length_mm=f,
    )
    assert np.abs(dimensions_of(phantom_landmarks(options), "lower") - [a, b, b + widening, f]).max() < TOLERANCE_MM


def test_asked_dimensions_of_an_upper_jaw_are_measured() -> None:
    asked = PhantomOptions(arch="upper", inter_canine_mm=36.0, inter_first_molar_mm=54.0, arch_length_mm=30.5)
    assert np.abs(dimensions_of(phantom_landmarks(asked), "upper") - [36.0, 54.0, 59.1, 30.5]).max() < TOLERANCE_MM


def test_larger_teeth_make_a_longer_arch() -> None:
    small, large = (phantom_landmarks(PhantomOptions(tooth_size=size, variation=0.0)) for size in (0.97, 1.03))
    gain = dimensions_of(large, "lower") - dimensions_of(small, "lower")
    assert np.abs(gain[:3]).max() < 2 * TOLERANCE_MM
    assert 1.0 < gain[3] < 6.0


@pytest.mark.parametrize("missing", [(37, 47, 35)])
def test_missing_teeth_are_missing_and_their_space_is_closed(missing: tuple[int, ...]) -> None:
    options = PhantomOptions(missing=missing, variation=0.0)
    teeth = phantom_teeth(options)
    there = [fdi for fdi in [*range(37, 30, -1), *range(41, 48)] if fdi not in missing]
    assert [placed.fdi for placed in teeth] == there
    apart = np.linalg.norm(np.diff([placed.origin[:2] for placed in teeth], axis=0), axis=1)
    half = np.array([placed.tooth.crown.half_width_mm for placed in teeth])
    assert np.all(apart < 1.15 * (half[1:] + half[:-1]))


@pytest.mark.long
def test_crowding_raises_the_irregularity(coarse_phantom: Jaw, crowded: Jaw) -> None:
    before, after = (irregularity_of(jaw.landmarks, "lower") for jaw in (coarse_phantom, crowded))
    assert before < 3.0
    assert before + 3.0 < after < 15.0


def test_a_tooth_is_rotated_by_the_asked_angle() -> None:
    teeth = {placed.fdi: placed for placed in phantom_teeth(PhantomOptions(rotate_deg={45: 25.0}, variation=0.0))}
    angles = []
    for quadrant, side in ((40, 1), (30, -1)):
        chord = (teeth[quadrant + 6].origin - teeth[quadrant + 4].origin)[:2] * [side, 1]
        along = teeth[quadrant + 5].axes[:2, 0] * [side, 1]
        angles.append(np.degrees(np.arctan2(chord[0] * along[1] - chord[1] * along[0], chord @ along)))
    assert abs(abs(angles[0] - angles[1]) - 25.0) < 4.0


def test_a_tooth_is_displaced_towards_the_asked_side() -> None:
    teeth = {placed.fdi: placed for placed in phantom_teeth(PhantomOptions(displace_mm={35: -1.5}, variation=0.0))}

    def aside(front: int, middle: int, back: int) -> float:
        """How far the middle tooth stands outside of the line of its neighbours, mm."""
        chord, arm = (teeth[k].origin[:2] - teeth[front].origin[:2] for k in (back, middle))
        outwards = np.array([-chord[1], chord[0]]) / np.linalg.norm(chord)
        return float(arm @ outwards * np.sign(outwards @ teeth[middle].origin[:2]))

    assert aside(34, 35, 36) < aside(44, 45, 46) - 1.0


@pytest.fixture(scope="module")
def crowded() -> Jaw:
    return build_phantom(PhantomOptions(edge_mm=0.8, crowding_mm=3.0))


@pytest.fixture(scope="module")
def closed_up() -> Jaw:
    return build_phantom(PhantomOptions(edge_mm=0.8, arch="upper", missing=(14, 24)))


@pytest.fixture(scope="module")
def deep_rooted() -> Jaw:
    """A root of it reaches 0.3 mm out of the box in which the surface is looked for."""
    return build_phantom(draw_population("lower-12", 2, np.random.default_rng(0), PhantomOptions(edge_mm=0.8))[1])


@pytest.fixture(params=["crowded", "closed_up", "deep_rooted"])
def unusual(request: pytest.FixtureRequest) -> Jaw:
    return request.getfixturevalue(request.param)


@pytest.mark.long
def test_an_unusual_jaw_is_closed_and_each_tooth_one_patch(unusual: Jaw) -> None:
    faces, count = unusual.mesh.faces, len(unusual.mesh.vertices)
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    directed, reverse = edges @ [count, 1], edges @ [1, count]
    assert len(np.unique(directed)) == len(directed)
    assert np.array_equal(np.sort(directed), np.sort(reverse))
    order = np.argsort(np.minimum(directed, reverse), kind="stable")
    pairs = (order // 3).reshape(-1, 2)
    same = pairs[unusual.face_labels[pairs[:, 0]] == unusual.face_labels[pairs[:, 1]]]
    _, patch = connected_components(coo_array((np.ones(len(same)), same.T), shape=(len(faces),) * 2), directed=False)
    assert len(np.unique(patch)) == 1 + len(unusual.teeth)


@pytest.mark.long
def test_the_landmarks_of_an_unusual_jaw_lie_on_its_surface(unusual: Jaw) -> None:
    assert set(unusual.landmarks) == set(labels_of(unusual.teeth))
    away = unusual.mesh.closest(np.array([landmark.position for landmark in unusual.landmarks.values()]))[0]
    assert np.median(away) < 0.02
    assert away.max() < 0.7


@pytest.mark.long
@pytest.mark.parametrize(
    ("options", "word"),
    [
        (PhantomOptions(missing=(33,)), "missing"),
        (PhantomOptions(missing=(14,)), "missing"),
        (PhantomOptions(rotate_deg={18: 5.0}), "rotate_deg"),
        (PhantomOptions(missing=(37, 47), inter_second_molar_mm=55.0), "inter_second_molar_mm"),
        (PhantomOptions(missing=(37,), arch_length_mm=33.0), "arch_length_mm"),
        (PhantomOptions(arch_length_mm=60.0), "nearest arch"),
        (PhantomOptions(inter_canine_mm=14.0), "inter_canine_mm"),
    ],
)
def test_what_cannot_be_is_said(options: PhantomOptions, word: str) -> None:
    with pytest.raises(InputError, match=word):
        phantom_landmarks(options)


def within_sampling_bounds(values: np.ndarray, spread: Normal) -> bool:
    """Whether mean and SD of a sample agree with a normal distribution, at about 3 sigma."""
    count = len(values)
    low, high = chi2.ppf([0.001, 0.999], count - 1) / (count - 1)
    error = abs(values.mean() - spread.mean_mm) / (spread.sd_mm / np.sqrt(count))
    return bool(error < 3.3 and low < values.var(ddof=1) / spread.sd_mm**2 < high)


def drawn_of(jaw: PhantomOptions) -> list[float | None]:
    """a, b, c and f as drawn, mm."""
    return [jaw.inter_canine_mm, jaw.inter_first_molar_mm, jaw.inter_second_molar_mm, jaw.arch_length_mm]


@pytest.mark.long
@pytest.mark.parametrize(("name", "count"), [("lower-14", 30), ("upper-14", 30), ("upper-12", 12)])
def test_a_population_has_the_spread_of_its_sources(name: GroupName, count: int) -> None:
    jaws, _ = draw_and_count(name, count, np.random.default_rng(5))
    group = GROUPS[name]
    drawn = np.array([drawn_of(jaw) for jaw in jaws], dtype=float)
    spreads = [group.inter_canine, group.inter_first_molar, group.inter_second_molar]
    spreads += [] if group.arch_length is None else [group.arch_length]
    assert all(within_sampling_bounds(drawn[:, k], spread) for k, spread in enumerate(spreads))
    assert np.isnan(drawn[:, 3]).all() == (name == "upper-12")


@pytest.mark.long
@pytest.mark.parametrize("name", ["upper-14", "lower-12"])
def test_a_drawn_jaw_has_the_dimensions_drawn(name: GroupName) -> None:
    (jaw,) = draw_population(name, 1, np.random.default_rng(2))
    asked = np.array(drawn_of(jaw), dtype=float)
    assert np.nanmax(np.abs(dimensions_of(phantom_landmarks(jaw), jaw.arch) - asked)) < TOLERANCE_MM


@pytest.mark.parametrize("arch", ["lower", "upper"])
def test_the_length_drawn_is_the_published_one_less_what_it_leaves_out(arch: Arch) -> None:
    options = PhantomOptions(arch=arch, variation=0.0)
    landmarks = phantom_landmarks(options)
    grooves = ends_of(landmarks, arch, 7, "buccal_groove").mean(axis=0)
    edges = ends_of(landmarks, arch, 1, "incisal_edge").mean(axis=0)
    last = phantom_teeth(options)[-1]
    end = min(last.to_jaw(np.array([last.tooth.crown.half_width_mm, y, 0.5 * 7.0]))[1] for y in (-1.0, 0.0, 1.0))
    papilla = landmarks["papilla"].position
    published = {"lower": 40.40, "upper": 44.13}[arch]
    flat = published - (edges[1] - papilla[1]) - (grooves[1] - end)
    assert LENGTHS[arch].mean_mm == pytest.approx(np.hypot(flat, papilla[2] - grooves[2]), abs=0.7)


def test_length_is_not_drawn_where_the_size_of_the_teeth_is_given() -> None:
    (jaw,) = draw_population("lower-14", 1, np.random.default_rng(2), PhantomOptions(tooth_size=1.0))
    assert (jaw.arch_length_mm, jaw.tooth_size) == (None, 1.0)


def test_a_population_is_drawn_again_the_same() -> None:
    one, same = (draw_population("upper-14", 3, np.random.default_rng(8)) for _ in range(2))
    assert one == same
    assert len({jaw.seed for jaw in one}) == 3
    with pytest.raises(InputError, match="at least one"):
        draw_population("upper-14", 0, np.random.default_rng(8))
