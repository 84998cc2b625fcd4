"""Rigid motions, and the models by which cameras project."""

from cuspid.geometry.rigid import (
    Rigid3,
    axes_about,
    best_similarity,
    compose_motions,
    distinct_rows,
    freeze,
    lengths_along,
    read_only,
    unit,
)

__all__ = [
    "Rigid3",
    "axes_about",
    "best_similarity",
    "compose_motions",
    "distinct_rows",
    "freeze",
    "lengths_along",
    "read_only",
    "unit",
]
