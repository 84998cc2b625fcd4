"""What can be computed in seconds: the equations of the thesis, its definitions, and small experiments of its figures.

Each check is a function without arguments that returns figures with units in their names.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

from cuspid_thesis.checks import cameras, experiments, mouth
from cuspid_thesis.results import Figures

CHECKS: Mapping[str, Callable[[], Figures]] = MappingProxyType(
    {
        check.__name__: check
        for check in (
            mouth.radius,
            mouth.sagittal_model,
            mouth.ramus_angle,
            mouth.hinge_distance,
            mouth.gap,
            mouth.landmarks,
            mouth.copied_column,
            cameras.projections,
            cameras.projection_matrices,
            cameras.epipolar,
            cameras.pair_parameters,
            cameras.likelihood,
            cameras.closed_form,
            cameras.baseline_bound,
            cameras.pair_grid,
            experiments.occlusion,
            experiments.baseline_terms,
            experiments.surfaces,
            experiments.designs,
            experiments.box_sizes,
            experiments.preparations,
            experiments.stereo_matches,
            experiments.free_path,
            experiments.rejections,
            experiments.normals,
            experiments.normal_map_features,
        )
    }
)
"""All of them, by name."""
