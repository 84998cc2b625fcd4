from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cuspid.anatomy.landmarks.dimensions import (
    PRINTED_TABLE,
    Survey,
    arch_dimensions,
    arch_of,
    group_of,
    group_rows,
    implausible,
    jaw_rows,
    measure,
    needed_landmarks,
    survey,
)
from cuspid.anatomy.landmarks.scheme import in_frame, labels_of
from cuspid.model.jaw import Arch, Jaw, Landmark
from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import InputError
from strategies import rigid3s

TRUTH = {"a": 27.0, "b": 51.0, "c": 56.0, "f": 33.0, "f_first": 21.0}
NO_MESH = Mesh(np.eye(3), np.array([[0, 1, 2]]))


def arch_landmarks(sigma: float | None = None, **lengths: float) -> dict[str, Landmark]:
    """Landmarks of a lower arch with the lengths of `TRUTH`, but for those given."""
    sizes = {**TRUTH, **lengths}
    places = {"papilla": (0.0, 20.0, 0.0)}
    for name, fdi, point in (("a", 3, "cusp_tip"), ("b", 6, "buccal_groove"), ("c", 7, "buccal_groove")):
        back = {"a": 4.0, "b": 20.0 - sizes["f_first"], "c": 20.0 - sizes["f"]}[name]
        places[f"4{fdi}.{point}"], places[f"3{fdi}.{point}"] = (
            (sizes[name] / 2, back, 0.0),
            (-sizes[name] / 2, back, 0.0),
        )
    return {label: Landmark(np.array(place), sigma) for label, place in places.items()}


def jaw_of(landmarks: dict[str, Landmark], arch: Arch | None = "lower") -> Jaw:
    return Jaw(mesh=NO_MESH, arch=arch, landmarks=landmarks)


@given(rigid3s())
def test_the_dimensions_are_lengths_that_no_motion_changes(motion):
    dimensions = arch_dimensions(in_frame(arch_landmarks(), motion), "lower")
    for name, length in TRUTH.items():
        found = dimensions[name]
        assert found is not None
        assert found.value_mm == pytest.approx(length, abs=1e-9)
        assert found.sigma_mm is None
    assert dimensions.notes == ()


def test_they_are_taken_in_space_not_in_projection():
    raised = arch_landmarks()
    raised["33.cusp_tip"] = Landmark(raised["33.cusp_tip"].position + [0.0, 0.0, 3.0])
    dimension = arch_dimensions(raised, "lower").a
    assert dimension is not None
    assert dimension.value_mm == pytest.approx(np.hypot(27.0, 3.0))


def test_the_uncertainty_is_that_of_a_simulation():
    rng = np.random.default_rng(0)
    landmarks = {
        label: Landmark(point.position, sigma)
        for (label, point), sigma in zip(arch_landmarks().items(), np.linspace(0.05, 0.3, 7), strict=True)
    }
    stated = arch_dimensions(landmarks, "lower")
    moved = [
        {label: Landmark(p.position + rng.normal(0, p.estimated_sigma_mm or 0, 3)) for label, p in landmarks.items()}
        for _ in range(2000)
    ]
    tried = [arch_dimensions(points, "lower") for points in moved]
    for name in TRUTH:
        spread = np.std([dimension.value_mm for one in tried if (dimension := one[name]) is not None])
        found = stated[name]
        assert found is not None
        assert found.sigma_mm == pytest.approx(spread, rel=0.08)


@given(st.sampled_from(sorted(arch_landmarks())))
def test_a_missing_landmark_leaves_out_what_needs_it_and_is_named(label):
    landmarks = {key: point for key, point in arch_landmarks().items() if key != label}
    dimensions = arch_dimensions(landmarks, "lower")
    for name, needed in needed_landmarks("lower").items():
        assert (dimensions[name] is None) == (label in needed)
        assert (f"{name}: no landmark {label}" in dimensions.notes) == (label in needed)


def test_without_second_molars_there_is_no_c_and_no_f_but_f_first():
    dimensions = arch_dimensions({k: v for k, v in arch_landmarks().items() if "7." not in k}, "lower")
    assert (dimensions.c, dimensions.f) == (None, None)
    assert dimensions.f_first is not None
    assert dimensions.f_first.value_mm == pytest.approx(21.0)


@pytest.mark.parametrize("arch", ["lower", "upper"])
def test_the_needed_landmarks_are_of_the_scheme_and_of_that_arch(arch: Arch):
    teeth = [*range(31, 38), *range(41, 48)] if arch == "lower" else [*range(11, 18), *range(21, 28)]
    needed = {label for labels in needed_landmarks(arch).values() for label in labels}
    assert needed <= set(labels_of(teeth))
    assert len(needed) == 7


def test_arch_and_group_come_from_the_teeth():
    upper = {label: Landmark(np.zeros(3)) for label in labels_of([*range(11, 17), *range(21, 27)])}
    assert arch_of(jaw_of(upper, None)) == "upper"
    assert group_of(jaw_of(upper, None)) == "Upper-12"
    with pytest.raises(InputError, match="give --arch"):
        arch_of(jaw_of({}, None))
    with pytest.raises(InputError, match="give --arch"):
        arch_of(jaw_of({"11.cusp_tip": Landmark(np.zeros(3)), **arch_landmarks()}, None))


def broken() -> tuple[Jaw, tuple[str, ...]]:
    raise InputError("c.ply: not a mesh")


def three_jaws() -> Survey:
    sizes = {"one": 26.0, "two": 28.0, "three": 30.0}
    jaws = {name: partial(lambda a: (jaw_of(arch_landmarks(a=a)), ("a note",)), a) for name, a in sizes.items()}
    return survey({**jaws, "broken": broken, "empty": lambda: (jaw_of({}), ())})


def test_a_survey_gives_mean_sd_and_n_and_lists_what_failed():
    found = three_jaws()
    (table,) = found.groups.values()
    assert (table["a"].count, table["a"].mean_mm, table["a"].std_mm) == (3, pytest.approx(28.0), pytest.approx(2.0))
    assert table["c"].std_mm == pytest.approx(0.0)
    assert set(found.failures) == {"broken", "empty"}
    assert found.failures["broken"] == "c.ply: not a mesh"
    assert "no landmark 43.cusp_tip, 33.cusp_tip" in found.failures["empty"]


def test_a_single_jaw_has_no_sd():
    (table,) = survey({"one": lambda: (jaw_of(arch_landmarks()), ())}).groups.values()
    assert (table["a"].count, table["a"].std_mm) == (1, None)


def test_the_rows_carry_units_and_every_jaw():
    found = three_jaws()
    rows = jaw_rows(found)
    assert [row["jaw"] for row in rows] == ["one", "two", "three", "broken", "empty"]
    assert all(row.keys() == rows[0].keys() for row in rows)
    assert rows[1]["a_mm"] == pytest.approx(28.0)
    assert rows[3]["notes"] == "not measured: c.ply: not a mesh"
    assert rows[0]["notes"] == "a note"
    (group,) = group_rows(found)
    assert (group["group"], group["jaws"], group["a_n"]) == ("Lower-6", 3, 3)
    assert {"a_mean_mm", "a_sd_mm", "f_first_mean_mm"} <= group.keys()


def test_what_is_far_from_the_printed_table_is_told():
    assert implausible(measure("fine", jaw_of(arch_landmarks(a=26.8, b=51.2, c=55.9)))) == ()
    (flag,) = implausible(measure("wide", jaw_of(arch_landmarks(a=26.8, b=51.2 + 4.2, c=55.9))))
    assert flag == "b = 55.4 mm, +3.2 SD from 51.19 mm"


def test_the_printed_column_f_repeats_b():
    for row in PRINTED_TABLE.values():
        assert abs(row["f"][0] - row["b"][0]) < 0.07
