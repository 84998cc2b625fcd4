"""Depth from one frame, which needs only the rig, and from two, which also needs the motion."""

from cuspid.stereo.across import AcrossOptions
from cuspid.stereo.matching import DepthEstimator, StereoOptions

__all__ = ["AcrossOptions", "DepthEstimator", "StereoOptions"]
