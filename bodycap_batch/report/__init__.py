"""The page a person reads after a job: verdict, viewer, figures; one file that works offline."""

from bodycap_batch.report.inputs import ReportInputs
from bodycap_batch.report.stage import REPORT_FILE, write_report

__all__ = ["REPORT_FILE", "ReportInputs", "write_report"]
