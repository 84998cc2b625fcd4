"""Calibration of the cameras of a handpiece from images of a board."""
