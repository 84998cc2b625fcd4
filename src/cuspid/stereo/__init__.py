"""Depth within one exposure: needs the rig, not the motion."""

from cuspid.stereo.matching import DepthEstimator, StereoOptions

__all__ = ["DepthEstimator", "StereoOptions"]
