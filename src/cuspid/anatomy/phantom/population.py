"""Populations of phantoms, drawn from measured dimensions of dental arches.

`a`, `b`, `c` are the distances between the cusp tips of the canines and between the buccal grooves of the first and of
the second molars; `f` is the length of the arch from the papilla to the middle between the second molars' grooves.

Mean and standard deviation of a, b and c are those of 432 CT models of jaws in four groups (table 2.1 of the thesis
that cuspid follows). The table has no correlations: a, b and c are drawn as jointly normal with one common correlation
(`CORRELATION`, an assumption: the size of the jaw is common to all). Its column f repeats column b and is not used.

For jaws of fourteen teeth f is drawn from published lengths of the arch (`LENGTHS`), independent of the widths: a
larger jaw is longer, but of two rows of like teeth the wider one is the shorter. For jaws of twelve teeth there is no
such source; f follows from the widths and from the sizes of the teeth in Wheeler's table. Sizes are changed as little
as the dimensions allow.

The jaws of twelve teeth lack their first premolars here: the table gives their second molars a width, and their first
molars stand 6 to 9 mm closer together than in jaws of fourteen, as after an extraction whose space was closed.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Literal

import numpy as np

from cuspid.anatomy.phantom.arrangement import can_stand
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.model.jaw import Arch
from cuspid.runtime.errors import InputError

GroupName = Literal["lower-14", "upper-14", "lower-12", "upper-12"]

CORRELATION = 0.6
"""Correlation between any two of the dimensions; an assumption."""
MOST_TRIES = 1000
"""Draws in a row that no row of teeth can meet, after which the group is given up."""


@dataclass(frozen=True, kw_only=True)
class Normal:
    """A normal distribution."""

    mean_mm: float
    """Mean."""
    sd_mm: float
    """Standard deviation."""


LENGTHS: Mapping[Arch, Normal] = MappingProxyType(
    {"lower": Normal(mean_mm=32.8, sd_mm=2.59), "upper": Normal(mean_mm=34.0, sd_mm=2.59)}
)
"""f of jaws of fourteen teeth.

From the incisal edges to the second molars it is 40.40 mm in lower and 44.13 mm in upper arches of 50 Koreans of 24 to
32 years (Park et al., J. Adv. Prosthodont. 9, 2017, 321-327). We read that as to the distal ends of the molars; the
abstract does not say. On the textbook phantoms the papilla lies 2.23 and 6.19 mm behind the edges and the grooves 5.52
and 4.66 mm before the ends, which leaves 32.65 and 33.28 mm, and 32.8 and 34.0 mm in space, for the papilla lies 3.32
and 6.90 mm lower than the grooves. The standard deviation is that of the length as far as the first molars of 54 lower
arches (Mina et al., Odontology 105, 2017, 229-236), taken for both arches."""


@dataclass(frozen=True, kw_only=True)
class Group:
    """A population of jaws."""

    arch: Arch
    """Which jaw."""
    missing: tuple[int, ...]
    """Teeth (FDI) that its jaws lack."""
    inter_canine: Normal
    """a."""
    inter_first_molar: Normal
    """b."""
    inter_second_molar: Normal
    """c."""
    arch_length: Normal | None = None
    """f, where it is drawn."""


GROUPS: Mapping[GroupName, Group] = MappingProxyType(
    {
        "lower-14": Group(
            arch="lower",
            missing=(),
            inter_canine=Normal(mean_mm=26.77, sd_mm=1.99),
            inter_first_molar=Normal(mean_mm=51.19, sd_mm=1.32),
            inter_second_molar=Normal(mean_mm=55.90, sd_mm=2.78),
            arch_length=LENGTHS["lower"],
        ),
        "upper-14": Group(
            arch="upper",
            missing=(),
            inter_canine=Normal(mean_mm=34.46, sd_mm=2.52),
            inter_first_molar=Normal(mean_mm=55.36, sd_mm=1.89),
            inter_second_molar=Normal(mean_mm=59.09, sd_mm=2.67),
            arch_length=LENGTHS["upper"],
        ),
        "lower-12": Group(
            arch="lower",
            missing=(34, 44),
            inter_canine=Normal(mean_mm=28.17, sd_mm=1.70),
            inter_first_molar=Normal(mean_mm=45.42, sd_mm=1.61),
            inter_second_molar=Normal(mean_mm=53.63, sd_mm=2.57),
        ),
        "upper-12": Group(
            arch="upper",
            missing=(14, 24),
            inter_canine=Normal(mean_mm=33.19, sd_mm=2.92),
            inter_first_molar=Normal(mean_mm=46.06, sd_mm=3.16),
            inter_second_molar=Normal(mean_mm=51.69, sd_mm=7.74),
        ),
    }
)


def draw_population(
    group: GroupName, count: int, rng: np.random.Generator, options: PhantomOptions = PhantomOptions()
) -> tuple[PhantomOptions, ...]:
    """Options of `count` jaws of a group, each an individual of its own; the rest is taken from `options`.

    f is drawn for jaws of fourteen teeth of free size; where teeth are missing or `tooth_size` is given, it follows.

    Raises:
        InputError: the count is less than one.
    """
    return draw_and_count(group, count, rng, options)[0]


def draw_and_count(
    group: GroupName, count: int, rng: np.random.Generator, options: PhantomOptions = PhantomOptions()
) -> tuple[tuple[PhantomOptions, ...], int]:
    """As `draw_population`, and how many draws were put back because no row of teeth can have such dimensions."""
    if count < 1:
        raise InputError(f"population: {count} jaws requested; ask for at least one")
    jaws: list[PhantomOptions] = []
    tries = 0
    while len(jaws) < count:
        jaw = _draw(GROUPS[group], rng, options)
        tries += 1
        if can_stand(jaw):
            jaws.append(jaw)
        elif tries > MOST_TRIES + 10 * len(jaws):
            raise InputError(f"population: no jaw of {group} is possible with these options; change tooth_size")
    return tuple(jaws), tries - count


def _draw(group: Group, rng: np.random.Generator, options: PhantomOptions) -> PhantomOptions:
    """One jaw, whether it can stand or not."""
    spreads = (group.inter_canine, group.inter_first_molar, group.inter_second_molar)
    common = rng.standard_normal()
    deviates = np.sqrt(CORRELATION) * common + np.sqrt(1 - CORRELATION) * rng.standard_normal(3)
    a, b, c = (spread.mean_mm + spread.sd_mm * z for spread, z in zip(spreads, deviates.tolist(), strict=True))
    missing = options.missing or group.missing
    gone = {fdi % 10 for fdi in missing}
    length = None if missing or options.tooth_size else group.arch_length
    return replace(
        options,
        arch=group.arch,
        seed=int(rng.integers(2**31)),
        missing=missing,
        inter_canine_mm=a,
        inter_first_molar_mm=None if 6 in gone else b,
        inter_second_molar_mm=None if 7 in gone else c,
        arch_length_mm=options.arch_length_mm if length is None else float(rng.normal(length.mean_mm, length.sd_mm)),
    )
