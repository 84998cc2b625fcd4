"""Depth from one frame, which needs only the rig, and from two, which also needs the motion."""

from cuspid.stereo.matching import DepthEstimator, StereoOptions
from cuspid.stereo.temporal import TemporalOptions, measure_temporal

__all__ = ["DepthEstimator", "StereoOptions", "TemporalOptions", "measure_temporal"]
