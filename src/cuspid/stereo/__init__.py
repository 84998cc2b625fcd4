"""Depth from one frame, which needs the rig alone, and from two, which needs the motion too."""

from cuspid.stereo.matching import DepthEstimator, StereoOptions
from cuspid.stereo.temporal import TemporalOptions, measure_temporal

__all__ = ["DepthEstimator", "StereoOptions", "TemporalOptions", "measure_temporal"]
