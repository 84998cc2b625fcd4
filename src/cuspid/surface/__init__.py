"""From depth maps to one clean mesh."""

from cuspid.surface.cleaning import CleaningOptions, CleaningReport, clean
from cuspid.surface.fusion import FusionOptions, fuse

__all__ = ["CleaningOptions", "CleaningReport", "FusionOptions", "clean", "fuse"]
