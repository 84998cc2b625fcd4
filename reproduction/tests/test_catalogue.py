"""The thesis as data: what is wrong in it is told with the name of the item, what it repeats is true."""

from __future__ import annotations

from string import Formatter

import numpy as np
import pytest

from cuspid.runtime.errors import InputError
from cuspid_thesis.catalogue import BY_ID, ITEMS, TABLE_3_2, MadeRows, Row, read_items
from cuspid_thesis.computed import FIGURES, ROWS, TABLES
from cuspid_thesis.judging import judge
from cuspid_thesis.results import in_words, value_at
from cuspid_thesis.rules import AtMost, Equals, Holds

ITEM = """
[[item]]
id = "fig-9.1"
section = "9"
title = "A figure"
states = "A length."
"""
ROW = """
[[item.row]]
quantity = "length"
thesis = "12"
"""
JUDGED = 'ours = "lengths.first_mm"\nequals = 12\nwithin = 1\n'


def only_item(text: str):
    return read_items(text, "figures.toml")[0]


def test_a_row_is_read_into_a_rule_and_a_path():
    (row,) = only_item(ITEM + ROW + JUDGED).rows
    assert row == Row(quantity="length", thesis="12", ours=("lengths.first_mm",), rule=Equals(thesis=12.0, within=1.0))


def test_what_equals_a_number_equals_it_to_rounding():
    (row,) = only_item(ITEM + ROW + 'ours = "a"\nequals = 12\n').rows
    assert [row.rule.verdict(ours) for ours in (12.0, 12.0 + 1e-10, 12.0 + 1e-8)] == ["reproduced"] * 2 + ["differs"]


def test_rows_have_what_the_item_says_for_each_unless_they_say_otherwise():
    each = '[item.each]\nunit = "mm"\nequals = [12, 13]\nwithin = 1\n'
    own = ROW + 'unit = "um"\nours = "a"\nat_most = 0.5\n'
    one, other = only_item(ITEM + each + ROW + 'ours = ["a", "b"]\n' + own).rows
    assert (one.unit, one.rule, one.ours) == ("mm", Equals(thesis=(12.0, 13.0), within=1.0), ("a", "b"))
    assert (other.unit, other.rule) == ("um", AtMost(limit=0.5))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (ITEM.replace("states", "state"), "fig-9.1: unknown key 'state'; did you mean states"),
        (ITEM.replace('section = "9"', "section = 9"), "fig-9.1: section cannot be 9"),
        (ITEM.replace('section = "9"', ""), "fig-9.1: section is missing"),
        (ITEM.replace("fig-9.1", "figure 9"), "figure 9: an id is fig-"),
        (ITEM.replace('id = "fig-9.1"', ""), "an item without an id: id is missing"),
        (ITEM + 'pictures = ["a.png"]', "fig-9.1: a picture must be a file and what it shows"),
        (ITEM + ROW + JUDGED.replace("equals", "equal"), "fig-9.1: unknown key 'equal'"),
        (ITEM + ROW + 'ours = "a"', "fig-9.1: length: no rule given; give exactly one of"),
        (ITEM + ROW + JUDGED + "at_most = 3", "fig-9.1: length: equals and at_most given; give exactly one of"),
        (ITEM + ROW + 'ours = "a"\nat_most = 12\nwithin = 1', "fig-9.1: length: 'within' can only be used with"),
        (ITEM + ROW + 'ours = "a"\nequals = ["twelve"]\nwithin = 1', "fig-9.1: length: "),
        (ITEM + ROW + 'ours = "a"\nless_is_better = 0', "fig-9.1: length: rule: only a positive value"),
        (ITEM + ROW + "at_most = 3", "fig-9.1: length: give either 'ours', a path, or 'computed'"),
        (ITEM + ROW + JUDGED + 'computed = "ratio"', "fig-9.1: length: give either 'ours', a path, or 'computed'"),
        (ITEM + ROW.replace('thesis = "12"', "") + JUDGED, "fig-9.1: length: thesis is missing"),
        (ITEM + '[[item.note]]\nsource = "x"', "fig-9.1: text is missing"),
        (ITEM + 'printed = [{ part = "A" }]', "fig-9.1: .* is missing"),
        (ITEM + "row = [1]", "fig-9.1: 1 is not a table"),
        ("[[items]]", "figures.toml: unknown key 'items'"),
        ("[[item]", "figures.toml: not valid TOML"),
    ],
)
def test_what_is_wrong_is_told_with_the_name_of_the_item(text, message):
    with pytest.raises(InputError, match=message):
        read_items(text, "figures.toml")


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (ROW + 'computed = "rato"\nat_most = 1', "fig-9.1: unknown function 'rato'"),
        (ROW + 'computed = "ratio"\nwith = { of = "a" }\nat_most = 1', "fig-9.1: ratio: .*'to'"),
        ('[[item.row]]\nrows = "columns"', "fig-9.1: unknown function 'columns'"),
        ('table = "none"', "fig-9.1: unknown function 'none'"),
    ],
)
def test_functions_that_are_not_there_are_told_before_anything_is_run(row, message):
    with pytest.raises(InputError, match=message):
        judge({}, [only_item(ITEM + row)])


def test_a_note_says_what_the_results_say_or_else_another_thing():
    note = '[[item.note]]\nsource = "x"\ntext = "{length.mm:.1f} mm"\notherwise = "no length"\n'
    item = only_item(ITEM + note)
    assert judge({"x": {"length": {"mm": 12.34}}}, [item])[0].notes == ("12.3 mm",)
    assert judge({}, [item])[0].notes == ("no length",)


def test_of_several_results_the_first_that_is_there_counts():
    item = only_item(ITEM + ROW + JUDGED + 'source = ["large", "small"]\nshown = "{ours:.1f}"\n')
    small, large = ({"lengths": {"first_mm": value}} for value in (12, 14))
    for results, source, verdict in (
        ({}, "small", "not run"),
        ({"small": small}, "small", "reproduced"),
        ({"small": small, "large": large}, "large", "differs"),
    ):
        (found,) = judge(results, [item])[0].comparisons
        assert (found.source, found.verdict) == (source, verdict)
    assert found.shown == "14.0"


def test_a_path_leads_through_names_and_places():
    result = {"groups": [{"a": 1.0}, {"a": 2.0}], "50": 3}
    assert (value_at(result, "groups.1.a"), value_at(result, "50")) == (2.0, 3)
    assert in_words("{ours:.0f} of {groups.0.a:.1f}", result, {"ours": 7.0}) == "7 of 1.0"
    with pytest.raises(KeyError):
        value_at(result, "group.1")


def test_every_function_is_asked_for_by_the_catalogue():
    rows = [row for item in ITEMS for row in item.rows]
    assert {row.computed for row in rows if isinstance(row, Row)} - {""} == set(FIGURES)
    assert {row.function for row in rows if isinstance(row, MadeRows)} == set(ROWS)
    assert {item.table for item in ITEMS} - {""} == set(TABLES)


def test_words_for_ours_have_fields_and_rules_say_what_holds():
    for row in (row for item in ITEMS for row in item.rows if isinstance(row, Row)):
        fields = [name for _, name, _, _ in Formatter().parse(row.shown) if name]
        assert bool(fields) == bool(row.shown), row.quantity
        assert not isinstance(row.rule, Holds) or row.rule.condition


def test_what_the_catalogue_repeats_of_table_3_2_follows_from_it():
    best = min(row.mean_um for row in TABLE_3_2)
    limits = {row.rule.limit for row in BY_ID["fig-3.13"].rows if row.computed == "thesis_pair"}
    assert limits == {best}
    excess = {
        row.part: row.std_um - np.sqrt((row.max_um - row.mean_um) * (row.mean_um - row.min_um)) for row in TABLE_3_2
    }
    parts = " and of ".join(f"{part} by {value:.1f} µm" for part, value in excess.items() if value > 0)
    assert f"that of {parts}." in BY_ID["table-3.2"].notes[-1].text
