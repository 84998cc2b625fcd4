"""Calibrations of other programs, read and written: a module for each format, and what they have in common."""

from cuspid.storage.calibrations.lenses import MOST_LOST_PX, Loss
from cuspid.storage.calibrations.registry import (
    FORMATS,
    CarriedOver,
    Name,
    ReadCalibration,
    fit_to_format,
    format_of_name,
    read_calibration,
    write_calibration,
)

__all__ = [
    "FORMATS",
    "MOST_LOST_PX",
    "CarriedOver",
    "Loss",
    "Name",
    "ReadCalibration",
    "fit_to_format",
    "format_of_name",
    "read_calibration",
    "write_calibration",
]
