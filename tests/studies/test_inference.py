"""Statistics of studies of scanners: what other programs say of the same numbers, and intervals that hold the truth."""

import numpy as np
import pytest
from scipy import stats

from cuspid.studies.scanners.inference import (
    bland_altman,
    cliffs_delta,
    compare_scanners,
    hedges_g,
    holm,
    mean_estimate,
    precision_estimate,
    scans_for_precision,
    scans_needed,
)
from cuspid.studies.scanners.statistics import plan

pytest.importorskip("statsmodels", reason="statsmodels is not installed: pip install 'cuspid[study]'")


def design(scans: int, specimens: int) -> tuple[list[str], list[str]]:
    scanner = [name for name in "ABC" for _ in range(scans * specimens)]
    return scanner, [str(k) for _ in "ABC" for k in range(specimens) for _ in range(scans)]


def test_one_specimen_is_analysis_of_variance():
    rng = np.random.default_rng(0)
    scanner, specimen = design(8, 1)
    values = rng.normal(size=24) + np.repeat([0.0, 0.5, 2.0], 8)
    found = compare_scanners("f", values, scanner, specimen, [None] * 24, rng)
    known = stats.f_oneway(values[:8], values[8:16], values[16:])
    assert found.model_p == pytest.approx(known.pvalue, rel=1e-9)
    assert found.test == "mixed model, F"
    assert found.contrasts[1].difference.value == pytest.approx(values[:8].mean() - values[16:].mean())


def test_specimens_that_differ_do_not_hide_scanners():
    rng = np.random.default_rng(1)
    scanner, specimen = design(4, 5)
    shift = np.tile(np.repeat(rng.normal(0, 20, 5), 4), 3)
    values = rng.normal(size=60) + np.repeat([0.0, 0.0, 1.5], 20) + shift
    found = compare_scanners("f", values, scanner, specimen, [None] * 60, rng)
    assert found.p < 0.001
    assert 8 < found.components["specimen"] < 45
    assert 0.7 < found.components["residual"] < 1.3
    assert found.contrasts[0].p > 0.05 > found.contrasts[1].p
    assert [each.what for each in found.assumptions][2].startswith("scanners differ alike")


def test_where_variances_are_not_equal_the_ranks_decide():
    rng = np.random.default_rng(2)
    scanner, specimen = design(20, 1)
    values = np.concatenate([rng.normal(0, 0.2, 20), rng.normal(0, 1, 20), rng.normal(0, 6, 20)])
    found = compare_scanners("f", values, scanner, specimen, [None] * 60, rng)
    assert found.test.startswith("Kruskal-Wallis")
    assert found.p == pytest.approx(stats.kruskal(*np.split(values, 3)).pvalue)
    assert found.contrasts[0].effect_name == "Cliff's delta"
    welch = stats.ttest_ind(values[:20], values[40:], equal_var=False).confidence_interval()
    assert found.contrasts[1].difference.low == pytest.approx(welch.low, rel=1e-6)


def test_equal_scanners_are_called_different_in_one_of_twenty_studies():
    rng = np.random.default_rng(3)
    scanner, specimen = design(5, 1)
    found = [compare_scanners("f", rng.normal(size=15), scanner, specimen, [None] * 15, rng) for _ in range(150)]
    share = np.mean([each.p < 0.05 for each in found if each is not None])
    assert 0.005 < share < 0.11


@pytest.mark.parametrize("groups", [1, 3])
def test_intervals_of_means_and_of_precision_hold_the_truth(groups):
    rng = np.random.default_rng(4)
    mean, precision = [], []
    for _ in range(150):
        drawn = [rng.normal(5, 2, 8) for _ in range(groups)]
        one = mean_estimate(drawn, rng)
        pairs = precision_estimate([np.abs(each[:, None] - each[None]) for each in drawn])
        mean.append(one.low <= 5 <= one.high)
        precision.append(pairs.low <= 4 / np.sqrt(np.pi) <= pairs.high)
    assert 0.88 <= np.mean(mean) <= 0.99
    assert 0.88 <= np.mean(precision) <= 0.995


def test_holm_is_that_of_statsmodels():
    multitest = pytest.importorskip("statsmodels.stats.multitest")
    for p in ([0.03], [0.01, 0.04, 0.03], [0.9, 0.2, 0.2, 0.001]):
        assert holm(p) == pytest.approx(multitest.multipletests(p, method="holm")[1])


def test_too_few_scans_have_no_interval():
    assert mean_estimate([np.array([1.0])], np.random.default_rng(0)).low is None
    assert precision_estimate([np.array([[0.0, 1.0], [1.0, 0.0]])]).high is None
    assert (
        compare_scanners("f", np.ones(4), ["A", "A", "B", "B"], ["m"] * 4, [None] * 4, np.random.default_rng(0)) is None
    )


def test_effects_have_their_textbook_values():
    # Borenstein et al., Introduction to Meta-Analysis (2009), chapter 4: d = 0.5970, n = 50 each: g = 0.5924.
    found = hedges_g(3.0, 3.0 / 0.5970, 50, 50, 98)
    assert found.value == pytest.approx(0.5924, abs=2e-4)
    assert (found.high - found.low) / (2 * 1.96) == pytest.approx(np.sqrt(0.0411), rel=0.02)
    delta = cliffs_delta(np.array([3.0, 4, 5]), np.array([1.0, 2, 3]), np.random.default_rng(0))
    assert delta.value == pytest.approx(8 / 9)


def test_limits_of_agreement_are_the_mean_and_1_96_sd():
    rng = np.random.default_rng(5)
    one, other = rng.normal(3, 4, 200), rng.normal(0, 4, 200)
    found = bland_altman("A", "B", one, other)
    assert found.bias.value == pytest.approx((one - other).mean())
    assert found.upper.value - found.lower.value == pytest.approx(2 * 1.96 * (one - other).std(ddof=1))
    assert found.lower.low < found.lower.value < found.lower.high < found.bias.low
    assert bland_altman("A", "B", one[:3], other[:3]) is None


def test_sample_sizes_are_those_of_tables():
    # Cohen (1988), table 2.4.1: power 0.80, two-sided 0.05: d = 0.5 needs 64, d = 0.8 needs 26, each.
    assert [scans_needed(1.0, d, 1) for d in (0.5, 0.8)] == [64, 26]
    assert scans_needed(1.0, 0.5, 3) > 64
    count = scans_for_precision(2.0)
    low, high = stats.chi2.ppf([0.025, 0.975], count - 1)
    assert np.sqrt(high / low) <= 2.0 < np.sqrt(stats.chi2.ppf(0.975, count - 2) / stats.chi2.ppf(0.025, count - 2))


@pytest.mark.parametrize("sd_um", [0.0, 0.3, 3.0])
def test_the_next_study_is_planned_from_the_scatter_of_repeats(sd_um):
    """However far scanners and specimens lie apart; where repeats do not scatter, two of them do."""
    rows = [
        {"scanner": scanner, "specimen": specimen, "mean_abs_um": 10.0 * number + sign * sd_um / np.sqrt(2)}
        for number, (scanner, specimen) in enumerate([("A", "m"), ("A", "n"), ("B", "m"), ("B", "n")])
        for sign in (-1, 1)
    ]
    planned = plan(rows, (), 0.5)
    assert planned["sd_um"] == pytest.approx(sd_um, abs=1e-9)
    assert (planned["freedom"], planned["pairs"]) == (4, 1)
    assert planned["scans"]["0.5"] == (scans_needed(sd_um, 0.5, 1) if sd_um else 2)
    assert plan(rows[::2], (), 0.5) is None
