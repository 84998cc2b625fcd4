"""Depth from one frame, which needs only the rig, and from two, which also needs the motion."""

from cuspid.mvs.across import AcrossOptions
from cuspid.mvs.matching import DepthEstimator, StereoOptions

__all__ = ["AcrossOptions", "DepthEstimator", "StereoOptions"]
