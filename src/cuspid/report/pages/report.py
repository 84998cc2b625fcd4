"""The report of a folder: one HTML page for whatever lies in it."""

from __future__ import annotations

from typing import assert_never

from cuspid.report.pages.calibration import calibration_page
from cuspid.report.pages.panorama import panorama_page, score_page
from cuspid.report.pages.scan import ReportOptions, scan_page
from cuspid.report.pages.scanner_study import scanner_study_page
from cuspid.report.pages.shape import shape_page
from cuspid.report.pages.study import study_page
from cuspid.storage import (
    CalibrationResult,
    PanoramaResult,
    Result,
    ScannerStudyResult,
    ScanResult,
    ScoreResult,
    ShapeResult,
    StudyResult,
)


def report_page(result: Result, options: ReportOptions = ReportOptions()) -> str:
    """The HTML of a result, one file with everything in it. Raises InputError where there is nothing to show."""
    match result:
        case ScanResult():
            return scan_page(result, options)
        case ShapeResult():
            return shape_page(result)
        case StudyResult():
            return study_page(result)
        case ScannerStudyResult():
            return scanner_study_page(result)
        case PanoramaResult():
            return panorama_page(result)
        case ScoreResult():
            return score_page(result)
        case CalibrationResult():
            return calibration_page(result)
        case _:
            assert_never(result)
