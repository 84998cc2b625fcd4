"""From results to verdicts: for every item of the catalogue what we find beside what the thesis states.

Nothing is computed here but what follows from the results, and no verdict is given but by a rule of
:mod:`cuspid.thesis.rules`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

from cuspid.thesis import (
    camera_findings,
    design_findings,
    mouth_findings,
    panorama_findings,
    trueness_findings,
)
from cuspid.thesis.catalogue import ITEMS, Item
from cuspid.thesis.findings import Finder, Finding, Results

FINDERS: Mapping[str, Finder] = MappingProxyType(
    {
        **mouth_findings.FINDERS,
        **camera_findings.FINDERS,
        **design_findings.FINDERS,
        **trueness_findings.FINDERS,
        **panorama_findings.FINDERS,
    }
)
"""Of every item that is not lost."""


def judge(results: Results, items: Sequence[Item] = ITEMS) -> tuple[Finding, ...]:
    """The finding of each item. Raises InputError where a result lacks a field."""
    return tuple(FINDERS[item.id](item, results) if item.id in FINDERS else Finding(item=item) for item in items)
