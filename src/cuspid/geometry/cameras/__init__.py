"""Camera models, under COLMAP's names where it has them: how a lens maps directions to the image, with derivatives and
inverse."""

from cuspid.geometry.cameras.models import GRID, LENSES, MODELS, LensModel, fold_radius
from cuspid.geometry.cameras.projection import (
    directions_through,
    distort,
    parameter_jacobian,
    point_jacobian,
    project,
    project_points,
    projection_derivatives,
)

__all__ = [
    "GRID",
    "LENSES",
    "MODELS",
    "LensModel",
    "directions_through",
    "distort",
    "fold_radius",
    "parameter_jacobian",
    "point_jacobian",
    "project",
    "project_points",
    "projection_derivatives",
]
