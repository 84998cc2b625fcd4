"""Rules that turn a figure of the thesis and one of ours into a verdict. No verdict is given but by one of them.

A rule holds what the thesis states and says in one sentence how it decides. *Better* and *falls short* are only for
figures that have a good side (errors, shares); of the others there is *reproduced* or *differs*.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

from cuspid.runtime.errors import InputError
from cuspid.runtime.values import quote

Verdict = Literal["better", "reproduced", "differs", "falls short", "not run", "not known"]
"""``not run``: we have no figure yet. ``not known``: what the thesis shows is lost in our copy."""
FAVOUR: tuple[Verdict, ...] = ("falls short", "differs", "reproduced", "better")
"""Verdicts of figures, the least favourable first."""
TIE_PCT = 5.0
"""Figures that are no farther apart than this are level."""

Figure = float | tuple[float, ...] | bool
"""A number, the ends of an interval or the parts of a vector, or whether something holds."""


@dataclass(frozen=True, kw_only=True)
class LessIsBetter:
    """For errors and times."""

    thesis: float
    """As printed; positive."""

    def __post_init__(self) -> None:
        if not self.thesis > 0:
            raise InputError(f"rule: only a positive value can be undercut, not {self.thesis:g}")

    @property
    def text(self) -> str:
        """How it decides."""
        return f"better: smaller by more than {TIE_PCT:g} %; reproduced: within {TIE_PCT:g} %; falls short: larger"

    def verdict(self, ours: float) -> Verdict:
        """Of a figure."""
        if abs(ours - self.thesis) <= TIE_PCT / 100 * self.thesis:
            return "reproduced"
        return "better" if ours < self.thesis else "falls short"


@dataclass(frozen=True, kw_only=True)
class Exceeds:
    """For shares of which the thesis says no more than that they exceed a limit."""

    thesis: float
    """The limit."""

    @property
    def text(self) -> str:
        """How it decides."""
        return f"reproduced: more than {self.thesis:g}; falls short: not more"

    def verdict(self, ours: float) -> Verdict:
        """Of a figure."""
        return "reproduced" if ours > self.thesis else "falls short"


@dataclass(frozen=True, kw_only=True)
class Equals:
    """For what is neither good nor bad."""

    thesis: float | tuple[float, ...]
    """As printed: a number, or the ends of an interval."""
    within: float
    """Largest difference, in the same unit."""
    meaning: str = ""
    """What that difference is, where it is another one for each row."""

    @property
    def text(self) -> str:
        """How it decides."""
        if self.within < 1e-6:
            return "reproduced: the same number; otherwise it differs"
        each = " at each end" if isinstance(self.thesis, tuple) else ""
        return f"reproduced: within {self.meaning or f'{self.within:.3g}'} of it{each}; otherwise it differs"

    def verdict(self, ours: float | tuple[float, ...]) -> Verdict:
        """Of a figure of the same kind. Raises InputError for one of another kind."""
        pairs = list(zip(_parts(self.thesis), _parts(ours), strict=False))
        if len(_parts(self.thesis)) != len(_parts(ours)):
            raise InputError(f"rule: {self.thesis} cannot be compared with {ours}")
        return "reproduced" if all(abs(a - b) <= self.within for a, b in pairs) else "differs"


@dataclass(frozen=True, kw_only=True)
class AtMost:
    """For what should vanish, or stay below a limit that the text implies."""

    limit: float
    """Largest figure with which the statement holds."""

    @property
    def text(self) -> str:
        """How it decides."""
        return f"reproduced: at most {self.limit:.3g}; otherwise it differs"

    def verdict(self, ours: float) -> Verdict:
        """Of a figure."""
        return "reproduced" if ours <= self.limit else "differs"


@dataclass(frozen=True, kw_only=True)
class AtLeast:
    """For what should reach a limit that the text implies."""

    limit: float
    """Smallest figure with which the statement holds."""

    @property
    def text(self) -> str:
        """How it decides."""
        return f"reproduced: at least {self.limit:.3g}; otherwise it differs"

    def verdict(self, ours: float) -> Verdict:
        """Of a figure."""
        return "reproduced" if ours >= self.limit else "differs"


@dataclass(frozen=True, kw_only=True)
class Holds:
    """For a statement that is true or false."""

    condition: str
    """When it counts as true."""

    @property
    def text(self) -> str:
        """How it decides."""
        return f"reproduced: {self.condition}; otherwise it differs"

    def verdict(self, ours: bool) -> Verdict:
        """Of the statement."""
        return "reproduced" if ours else "differs"


Rule = LessIsBetter | Exceeds | Equals | AtMost | AtLeast | Holds
RULES: Mapping[str, tuple[type[Rule], str]] = MappingProxyType(
    {
        "less_is_better": (LessIsBetter, "thesis"),
        "exceeds": (Exceeds, "thesis"),
        "equals": (Equals, "thesis"),
        "at_most": (AtMost, "limit"),
        "at_least": (AtLeast, "limit"),
        "holds": (Holds, "condition"),
    }
)
"""By the keys of the catalogue; and the field that the value of the key is for."""


def _parts(figure: Figure) -> tuple[float | bool, ...]:
    return figure if isinstance(figure, tuple) else (figure,)


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """A figure of the thesis beside ours."""

    quantity: str
    """What is compared, without its unit."""
    unit: str = ""
    """Empty where there is none."""
    printed: str
    """As the thesis has it."""
    ours: Figure | None
    """None where it was not run."""
    rule: Rule
    """How the two are judged."""
    because: str = ""
    """Why ours differs or falls short, if it does."""
    shown: str = ""
    """Our figure in words, where the number alone would not tell."""
    source: str = ""
    """Name of the results that it comes from."""
    quick: bool = False
    """From a reduced run."""

    def __post_init__(self) -> None:
        if self.ours is not None and not all(isinstance(part, (int, float)) for part in _parts(self.ours)):
            raise TypeError(f"{quote(self.ours)} is no figure")

    @property
    def verdict(self) -> Verdict:
        """By the rule."""
        return "not run" if self.ours is None else self.rule.verdict(self.ours)  # type: ignore[arg-type]


def least_favourable(verdicts: Iterable[Verdict]) -> Verdict:
    """Of the figures that there are; ``not run`` where there is none."""
    known = [verdict for verdict in verdicts if verdict in FAVOUR]
    return min(known, key=FAVOUR.index) if known else "not run"
