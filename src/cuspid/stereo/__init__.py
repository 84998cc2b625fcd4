"""Depth within one exposure, which needs the rig alone, and between two, which needs the motion too."""

from cuspid.stereo.between import BetweenOptions, measure_between
from cuspid.stereo.matching import DepthEstimator, StereoOptions

__all__ = ["BetweenOptions", "DepthEstimator", "StereoOptions", "measure_between"]
