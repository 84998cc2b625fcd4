"""Rigid motions, and the models by which cameras project."""

from cuspid.geometry.rigid import (
    Rigid3,
    axes_about,
    best_similarity,
    composed,
    distinct_rows,
    lengths_along,
    owned,
    read_only,
    unit,
)

__all__ = [
    "Rigid3",
    "axes_about",
    "best_similarity",
    "composed",
    "distinct_rows",
    "lengths_along",
    "owned",
    "read_only",
    "unit",
]
