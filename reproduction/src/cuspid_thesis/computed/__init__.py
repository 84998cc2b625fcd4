"""What the catalogue names by a function, for a path alone does not find it.

A *figure* takes a result (or all, where the catalogue's source has a ``*``) and the arguments that the catalogue gives,
and returns ``ours`` and the names that ``shown`` uses; None where it was not run. *Rows* and *tables* take all results.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from cuspid_thesis.catalogue import Row
from cuspid_thesis.computed import arches, cameras, designs, panoramas, trueness
from cuspid_thesis.page_format import Table
from cuspid_thesis.results import Results

FIGURES: Mapping[str, Callable[..., Mapping[str, Any] | None]] = MappingProxyType(
    {
        figure.__name__: figure
        for figure in (
            arches.largest_miss_mm,
            cameras.covers,
            cameras.distance_and_best_angle,
            cameras.falls_with_the_baseline,
            cameras.more,
            cameras.ratio,
            cameras.refused,
            cameras.rises_with_the_baseline,
            designs.behind_the_best_pair,
            designs.gain_pct,
            designs.less_with_twelve,
            designs.rounds_until_still,
            designs.seen_by_two_pct,
            designs.thesis_pair,
            panoramas.beats_stitcher,
            panoramas.error_is_smaller_examined,
            panoramas.least_ssim,
            panoramas.ssim_is_larger_examined,
            panoramas.subjects,
        )
    }
)
ROWS: Mapping[str, Callable[..., tuple[Row, ...]]] = MappingProxyType(
    {
        "images": trueness.images,
        "jaws_scanned": arches.jaws_scanned,
        "phantoms_drawn": arches.phantoms_drawn,
        "trueness": trueness.trueness,
    }
)
TABLES: Mapping[str, Callable[[Results], Table | None]] = MappingProxyType(
    {
        "designs": designs.designs_table,
        "margins": trueness.margins_table,
        "panoramas": panoramas.panoramas_table,
        "trueness": trueness.trueness_table,
    }
)
