"""What the figures of a study say beyond its own scans: intervals, comparisons of scanners, and the next sample size.

*Means* over scans: bootstrap within each specimen, percentiles widened to what Student's t has for so few scans (T.
Hesterberg, *What teachers should know about the bootstrap*, Am. Stat. 69, 2015). *Precision* over pairs: all pairs
share scans, so scans are left out one by one (jackknife of a U-statistic, J. Arvesen, Ann. Math. Stat. 40, 1969), on
the logarithm, with Student's t.

*Scanners*: a mixed model (scanner fixed; specimen and operator random, crossed; REML by statsmodels). Its Wald test is
read as F with the residual degrees of freedom, which is exact for balanced designs with equal variances. It assumes
normal residuals (Shapiro and Wilk), equal variances (Brown and Forsythe), and that scanners differ alike on all
specimens (F test of the interaction). Where one of the first two fails, the ranks decide (Kruskal and Wallis; pairs by
Mann and Whitney), of values from which the mean of their specimen was subtracted. Pairs are corrected by Holm.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from itertools import combinations
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import stats

from cuspid.runtime.errors import MissingDependencyError

LEVEL = 0.95
"""Of all intervals."""
ALPHA = 0.05
"""At which an assumption is taken to fail."""
_DRAWS = 2000
_LEAST_SCANS = 3
_LEAST_SPANS = 5
POWER = 0.8
"""Of the next study."""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A value with its 95 % interval."""

    value: float
    low: float | None
    """Lower end; None with too few scans."""
    high: float | None


@dataclass(frozen=True, kw_only=True)
class Assumption:
    """What a test assumes."""

    what: str
    holds: bool | None
    """None where it could not be tested."""
    told: str
    """The test of it and its p."""


@dataclass(frozen=True, kw_only=True)
class Contrast:
    """The difference of two scanners."""

    first: str
    second: str
    difference: Estimate
    """First minus second, in the unit of the figure, from the model; by Welch where variances are not equal."""
    p: float
    """Of the test that decides, corrected for the number of pairs (Holm)."""
    effect: Estimate
    """Hedges' g by the model; Cliff's delta by ranks."""
    effect_name: str


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """How scanners differ in one figure."""

    figure: str
    test: str
    """The test that decides: by the model, or by ranks."""
    statistic: float
    p: float
    p_holm: float
    """Corrected for the number of figures that were compared."""
    model_p: float
    rank_p: float
    assumptions: tuple[Assumption, ...]
    components: Mapping[str, float]
    """Standard deviations: of specimens, operators, and the residual."""
    contrasts: tuple[Contrast, ...]
    scans: int


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """Two methods on the same distances (J. Bland and D. Altman, Lancet 327, 1986)."""

    first: str
    second: str
    count: int
    bias: Estimate
    """Mean difference, first minus second, um."""
    lower: Estimate
    """Limit of agreement: bias - 1.96 SD."""
    upper: Estimate
    assumptions: tuple[Assumption, ...]
    means_um: tuple[float, ...]
    """For the plot: mean error of both, of each distance."""
    differences_um: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class SampleSize:
    """What the next study needs to see a difference."""

    difference_um: float
    scans: int | None
    """For each scanner; None where no reasonable number suffices."""


# --- intervals --------------------------------------------------------------------------------------------------------


def mean_estimate(groups: Sequence[Float[np.ndarray, "_"]], rng: np.random.Generator) -> Estimate:
    """The mean over specimens of the mean over scans, for these specimens; each group is the scans of one."""
    value = float(np.mean([group.mean() for group in groups]))
    freedom = sum(len(group) - 1 for group in groups)
    if freedom < _LEAST_SCANS - 1:
        return Estimate(value=value, low=None, high=None)
    draws = np.mean([group[rng.integers(0, len(group), (_DRAWS, len(group)))].mean(axis=1) for group in groups], axis=0)
    size = len(groups) + freedom
    reach = float(stats.t.ppf(0.5 + LEVEL / 2, freedom)) * np.sqrt(size / freedom)
    share = float(stats.norm.cdf(-reach))
    low, high = np.quantile(draws, [share, 1 - share])
    return Estimate(value=value, low=float(low), high=float(high))


def precision_estimate(groups: Sequence[Float[np.ndarray, "_ _"]]) -> Estimate:
    """The mean over specimens of the mean over all pairs; each group is the symmetric matrix of the figure of pairs."""
    means = [_mean_of_pairs(group) for group in groups]
    value = float(np.mean(means))
    parts = [_leave_one_out(group, means, k) for k, group in enumerate(groups) if len(group) >= _LEAST_SCANS]
    variances = np.array([(len(part) - 1) / len(part) * np.sum((part - part.mean()) ** 2) for part in parts])
    if len(parts) < len(groups) or not variances.sum() > 0:
        return Estimate(value=value, low=None, high=None)
    freedom = variances.sum() ** 2 / np.sum(variances**2 / (np.array([len(part) for part in parts]) - 1))
    reach = float(stats.t.ppf(0.5 + LEVEL / 2, freedom) * np.sqrt(variances.sum()))
    return Estimate(value=value, low=value * np.exp(-reach), high=value * np.exp(reach))


def _mean_of_pairs(matrix: Float[np.ndarray, "n n"]) -> float:
    return float(matrix[np.triu_indices(len(matrix), 1)].mean())


def _leave_one_out(matrix: Float[np.ndarray, "n n"], means: Sequence[float], which: int) -> Float[np.ndarray, "n"]:
    """Logarithms of the mean over specimens without each scan of one of them."""
    others = sum(means) - means[which]
    keep = [np.delete(np.arange(len(matrix)), k) for k in range(len(matrix))]
    return np.log([(others + _mean_of_pairs(matrix[np.ix_(each, each)])) / len(means) for each in keep])


# --- scanners ---------------------------------------------------------------------------------------------------------


def compare_scanners(
    figure: str,
    values: Float[np.ndarray, "n"],
    scanners: Sequence[str],
    specimens: Sequence[str],
    operators: Sequence[str | None],
    rng: np.random.Generator,
) -> Comparison | None:
    """How scanners differ in a figure of each scan; None for fewer than two scanners with three scans each.

    The correction for the number of figures is left to :func:`correct_p_values`. Raises MissingDependencyError without
    statsmodels.
    """
    counts = {name: list(scanners).count(name) for name in dict.fromkeys(map(str, scanners))}
    names = tuple(name for name, count in counts.items() if count >= _LEAST_SCANS)
    chosen = np.isin(np.array(scanners), names) & np.isfinite(values)
    if len(names) < 2 or np.ptp(values[chosen]) == 0:
        return None
    data = {
        "y": values[chosen],
        "scanner": np.array(scanners)[chosen],
        "specimen": np.array(specimens)[chosen],
        "operator": np.array([each or "" for each in operators])[chosen],
    }
    model = _fit_model(data, names)
    groups = [_subtract_means(data)[data["scanner"] == name] for name in names]
    assumptions = _assumptions(model, groups, data)
    by_ranks = any(each.holds is False for each in assumptions[:2])
    rank = stats.kruskal(*groups)
    return Comparison(
        figure=figure,
        test="Kruskal-Wallis on ranks" if by_ranks else "mixed model, F",
        statistic=float(rank.statistic) if by_ranks else model.statistic,
        p=float(rank.pvalue) if by_ranks else model.p,
        p_holm=float(rank.pvalue) if by_ranks else model.p,
        model_p=model.p,
        rank_p=float(rank.pvalue),
        assumptions=assumptions,
        components=model.components,
        contrasts=_contrasts(model, names, groups, by_ranks=by_ranks, equal=assumptions[1].holds is not False, rng=rng),
        scans=int(chosen.sum()),
    )


def correct_p_values(comparisons: Sequence[Comparison]) -> tuple[Comparison, ...]:
    """The comparisons with p corrected for their number (Holm)."""
    if not comparisons:
        return ()
    adjusted = holm([each.p for each in comparisons])
    return tuple(replace(each, p_holm=float(p)) for each, p in zip(comparisons, adjusted, strict=True))


def holm(p: Sequence[float]) -> Float[np.ndarray, "n"]:
    """Correction of p for multiple tests (S. Holm, Scand. J. Stat. 6, 1979)."""
    # As statsmodels' multipletests, which collects all garbage of the process each time.
    order = np.argsort(p)
    steps = np.maximum.accumulate(np.asarray(p)[order] * np.arange(len(p), 0, -1))
    return np.minimum(steps, 1.0)[np.argsort(order)]


@dataclass(frozen=True, eq=False, kw_only=True)
class _Model:
    """The fitted model."""

    means: Float[np.ndarray, "k"]
    covariance: Float[np.ndarray, "k k"]
    freedom: float
    residuals: Float[np.ndarray, "n"]
    sd: float
    components: Mapping[str, float]

    @property
    def statistic(self) -> float:
        """F of equal means."""
        contrast = np.eye(len(self.means))[1:] - np.eye(len(self.means))[0]
        middle = contrast @ self.covariance @ contrast.T
        difference = contrast @ self.means
        return float(difference @ np.linalg.solve(middle, difference) / len(contrast))

    @property
    def p(self) -> float:
        """Of that F."""
        return float(stats.f.sf(self.statistic, len(self.means) - 1, self.freedom))


def _statsmodels(name: str) -> ModuleType:
    try:
        return import_module(name)
    except ImportError as error:
        raise MissingDependencyError("statistics need statsmodels: pip install 'cuspid[study]'") from error


def _dummies(levels: np.ndarray) -> Float[np.ndarray, "n l"]:
    return (levels[:, None] == np.unique(levels)[None]).astype(np.float64)


def _fit_model(data: Mapping[str, np.ndarray], names: Sequence[str]) -> _Model:
    """Mean of each scanner; specimens and operators as random effects where there are several."""
    design = np.stack([data["scanner"] == name for name in names], axis=1).astype(np.float64)
    random = {name: _dummies(data[name]) for name in ("specimen", "operator") if len(np.unique(data[name])) > 1}
    freedom = len(data["y"]) - np.linalg.matrix_rank(np.concatenate([design, *random.values()], axis=1))
    fixed = (
        _statsmodels("statsmodels.api")
        .OLS(data["y"], np.concatenate([design, *(each[:, 1:] for each in random.values())], axis=1))
        .fit()
    )
    sd = float(np.sqrt(max(float(fixed.ssr), 1e-300) / max(freedom, 1)))
    if not random:
        return _Model(
            means=np.asarray(fixed.params),
            covariance=np.asarray(fixed.cov_params()),
            freedom=float(freedom),
            residuals=np.asarray(fixed.resid),
            sd=sd,
            components={"residual": sd},
        )
    fitted = _fit_mixed(data["y"], design, random)
    if fitted is None:  # no variance beside the residual, or too few levels to find it
        ols = _statsmodels("statsmodels.api").OLS(data["y"], design).fit()
        return _Model(
            means=np.asarray(ols.params),
            covariance=np.asarray(ols.cov_params()),
            freedom=float(max(freedom, 1)),
            residuals=np.asarray(ols.resid),
            sd=sd,
            components={"residual": float(np.sqrt(ols.scale)), **dict.fromkeys(random, 0.0)},
        )
    count = len(names)
    return _Model(
        means=np.asarray(fitted.fe_params)[:count],
        covariance=np.asarray(fitted.cov_params())[:count, :count],
        freedom=float(max(freedom, 1)),
        residuals=np.asarray(fixed.resid),
        sd=sd,
        components={
            **dict(zip(random, map(float, np.sqrt(np.maximum(fitted.vcomp, 0))), strict=True)),
            "residual": float(np.sqrt(fitted.scale)),
        },
    )


def _fit_mixed(
    y: Float[np.ndarray, "n"], design: Float[np.ndarray, "n k"], random: Mapping[str, Float[np.ndarray, "n l"]]
) -> Any:
    """REML with crossed variance components; None where it does not converge."""
    mixed = _statsmodels("statsmodels.regression.mixed_linear_model")
    components = mixed.VCSpec(
        list(random),
        [[[f"{name}{k}" for k in range(each.shape[1])]] for name, each in random.items()],
        [[each] for each in random.values()],
    )
    scale = float(np.std(y)) or 1.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            fitted = mixed.MixedLM(y, design, groups=np.ones(len(y)), exog_vc=components).fit(reml=True)
        except (np.linalg.LinAlgError, ValueError, ZeroDivisionError):
            return None
    good = fitted.converged and np.isfinite(np.asarray(fitted.cov_params())).all() and fitted.scale > 1e-12 * scale**2
    return fitted if good and np.all(np.diag(np.asarray(fitted.cov_params()))[: design.shape[1]] > 0) else None


def _subtract_means(data: Mapping[str, np.ndarray]) -> Float[np.ndarray, "n"]:
    """Values without the mean of their specimen."""
    y = data["y"].astype(np.float64).copy()
    for specimen in np.unique(data["specimen"]):
        y[data["specimen"] == specimen] -= y[data["specimen"] == specimen].mean()
    return y


def _assumptions(
    model: _Model, groups: Sequence[Float[np.ndarray, "_"]], data: Mapping[str, np.ndarray]
) -> tuple[Assumption, ...]:
    normal = float(stats.shapiro(model.residuals).pvalue) if np.ptp(model.residuals) > 0 else 1.0
    equal = float(stats.levene(*groups, center="median").pvalue)
    found = [
        Assumption(what="normal residuals", holds=normal >= ALPHA, told=f"Shapiro-Wilk, p = {normal:.3g}"),
        Assumption(what="equal variances", holds=equal >= ALPHA, told=f"Brown-Forsythe, p = {equal:.3g}"),
    ]
    alike = _interaction_p(data)
    if alike is not None:
        found.append(
            Assumption(
                what="scanners differ alike on all specimens",
                holds=alike >= ALPHA,
                told=f"F test of the interaction, p = {alike:.3g}",
            )
        )
    elif len(np.unique(data["specimen"])) == 1:
        found.append(Assumption(what="holds for other specimens", holds=None, told="one specimen only: not known"))
    return tuple(found)


def _interaction_p(data: Mapping[str, np.ndarray]) -> float | None:
    """Of scanners differing by specimen; None where the design does not tell."""
    y, scanner, specimen = data["y"], _dummies(data["scanner"]), _dummies(data["specimen"])
    if specimen.shape[1] < 2:
        return None
    additive = np.concatenate([scanner, specimen[:, 1:]], axis=1)
    cells = np.stack([a * b for a in scanner.T for b in specimen.T], axis=1)
    ranks = [int(np.linalg.matrix_rank(each)) for each in (additive, cells)]
    more, left = ranks[1] - ranks[0], len(y) - ranks[1]
    if more < 1 or left < 1:
        return None
    squares = [float(np.sum((y - each @ np.linalg.lstsq(each, y, rcond=None)[0]) ** 2)) for each in (additive, cells)]
    if squares[1] <= 0:
        return None
    return float(stats.f.sf((squares[0] - squares[1]) / more / (squares[1] / left), more, left))


def _contrasts(
    model: _Model,
    names: Sequence[str],
    groups: Sequence[Float[np.ndarray, "_"]],
    *,
    by_ranks: bool,
    equal: bool,
    rng: np.random.Generator,
) -> tuple[Contrast, ...]:
    pairs = list(combinations(range(len(names)), 2))
    pooled = float(stats.t.ppf(0.5 + LEVEL / 2, model.freedom))
    found, p = [], []
    for a, b in pairs:
        difference, reach = float(model.means[a] - model.means[b]), pooled
        variance = model.covariance[a, a] + model.covariance[b, b] - 2 * model.covariance[a, b]
        error = float(np.sqrt(max(variance, 1e-300)))
        if not equal:
            error, reach = _welch(groups[a], groups[b])
        if by_ranks:
            p.append(float(stats.mannwhitneyu(groups[a], groups[b]).pvalue))
        else:
            p.append(float(2 * stats.t.sf(abs(difference) / error, model.freedom)))
        effect = (
            cliffs_delta(groups[a], groups[b], rng)
            if by_ranks
            else hedges_g(difference, model.sd, len(groups[a]), len(groups[b]), model.freedom)
        )
        found.append(
            (a, b, Estimate(value=difference, low=difference - reach * error, high=difference + reach * error), effect)
        )
    return tuple(
        Contrast(
            first=names[a],
            second=names[b],
            difference=difference,
            p=float(each),
            effect=effect,
            effect_name="Cliff's delta" if by_ranks else "Hedges' g",
        )
        for (a, b, difference, effect), each in zip(found, holm(p), strict=True)
    )


def _welch(one: Float[np.ndarray, "n"], other: Float[np.ndarray, "m"]) -> tuple[float, float]:
    """Standard error of a difference of means where variances are not equal, and how many of them reach to the ends of
    its interval (B. Welch, Biometrika 34, 1947)."""
    parts = np.array([each.var(ddof=1) / len(each) for each in (one, other)])
    freedom = parts.sum() ** 2 / np.sum(parts**2 / (np.array([len(one), len(other)]) - 1))
    return float(np.sqrt(parts.sum())), float(stats.t.ppf(0.5 + LEVEL / 2, freedom))


def hedges_g(difference: float, sd: float, one: int, other: int, freedom: float) -> Estimate:
    """The difference in residual standard deviations, corrected for few scans, with its large-sample interval (L.
    Hedges and I. Olkin, 1985)."""
    g = difference / sd * (1 - 3 / (4 * freedom - 1))
    error = np.sqrt((one + other) / (one * other) + g**2 / (2 * (one + other)))
    reach = float(stats.norm.ppf(0.5 + LEVEL / 2)) * float(error)
    return Estimate(value=float(g), low=float(g - reach), high=float(g + reach))


def cliffs_delta(one: Float[np.ndarray, "n"], other: Float[np.ndarray, "m"], rng: np.random.Generator) -> Estimate:
    """How much more often a value of the first is larger than smaller, -1 to 1, with its bootstrap interval."""

    def delta(a: Float[np.ndarray, "d n"], b: Float[np.ndarray, "d m"]) -> Float[np.ndarray, "d"]:
        return np.sign(a[:, :, None] - b[:, None, :]).mean(axis=(1, 2))

    a, b = (each[rng.integers(0, len(each), (_DRAWS, len(each)))] for each in (one, other))
    low, high = np.quantile(delta(a, b), [0.5 - LEVEL / 2, 0.5 + LEVEL / 2])
    return Estimate(value=float(delta(one[None], other[None])[0]), low=float(low), high=float(high))


# --- two methods ------------------------------------------------------------------------------------------------------


def bland_altman(
    first: str, second: str, one_um: Float[np.ndarray, "n"], other_um: Float[np.ndarray, "n"]
) -> Agreement | None:
    """The limits of agreement of two methods, from the error of each distance by both; None for fewer than five.

    Intervals of the limits: t times sqrt(3 / n) SD (Bland and Altman).
    """
    count = len(one_um)
    difference, mean = one_um - other_um, (one_um + other_um) / 2
    if count < _LEAST_SPANS or np.ptp(difference) == 0:
        return None
    bias, sd = float(difference.mean()), float(difference.std(ddof=1))
    reach = float(stats.t.ppf(0.5 + LEVEL / 2, count - 1)) * sd

    def estimate(value: float, factor: float) -> Estimate:
        return Estimate(value=value, low=value - reach * factor, high=value + reach * factor)

    normal = float(stats.shapiro(difference).pvalue)
    slope = float(stats.linregress(mean, difference).pvalue) if np.ptp(mean) > 0 else 1.0
    return Agreement(
        first=first,
        second=second,
        count=count,
        bias=estimate(bias, np.sqrt(1 / count)),
        lower=estimate(bias - 1.96 * sd, np.sqrt(3 / count)),
        upper=estimate(bias + 1.96 * sd, np.sqrt(3 / count)),
        assumptions=(
            Assumption(what="normal differences", holds=normal >= ALPHA, told=f"Shapiro-Wilk, p = {normal:.3g}"),
            Assumption(
                what="no trend with the size of the error", holds=slope >= ALPHA, told=f"regression, p = {slope:.3g}"
            ),
            Assumption(
                what="independent distances", holds=None, told="distances of one scan share their points: not tested"
            ),
        ),
        means_um=tuple(map(float, mean)),
        differences_um=tuple(map(float, difference)),
    )


# --- the next study ---------------------------------------------------------------------------------------------------


def scans_needed(sd_um: float, difference_um: float, pairs: int) -> int | None:
    """Scans of each scanner to see a difference of means with a power of 80 %, two-sided at 5 % over so many pairs
    (Bonferroni), by the t test. Raises MissingDependencyError without statsmodels."""
    power = _statsmodels("statsmodels.stats.power").TTestIndPower()
    for count in range(2, 10_001):
        reached = power.power(difference_um / sd_um, count, ALPHA / pairs, ratio=1.0, alternative="two-sided")
        if reached >= POWER:
            return count
    return None


def scans_for_precision(ratio: float) -> int:
    """Scans of one scanner until the 95 % interval of a standard deviation (normal values) has this ratio of its ends
    at most."""
    for freedom in range(2, 100_000):
        low, high = stats.chi2.ppf([0.5 - LEVEL / 2, 0.5 + LEVEL / 2], freedom)
        if np.sqrt(high / low) <= ratio:
            return freedom + 1
    return 100_000
