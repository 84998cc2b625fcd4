"""Fuses depth maps into one clean mesh."""

from cuspid.fusion.cleaning import CleaningOptions, CleaningReport, clean
from cuspid.fusion.depth_fusion import FusionOptions, fuse

__all__ = ["CleaningOptions", "CleaningReport", "FusionOptions", "clean", "fuse"]
