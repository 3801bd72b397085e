"""Figures, self-contained HTML reports, and the summary of a calibration in words."""

from lsvision.report.experiment_pages import calibration_report, product_report
from lsvision.report.pages import Headline, Page, ReportFigure, Table, write_report
from lsvision.report.study_figures import TiltMap
from lsvision.report.study_pages import Study, study_report
from lsvision.report.summary import calibration_summary
from lsvision.report.sweep_pages import SweepJob, sweep_report

__all__ = [
    "Headline",
    "Page",
    "ReportFigure",
    "Study",
    "SweepJob",
    "Table",
    "TiltMap",
    "calibration_report",
    "calibration_summary",
    "product_report",
    "study_report",
    "sweep_report",
    "write_report",
]
