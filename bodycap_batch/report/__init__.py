"""The report page of a job: verdict, 3D viewer, drawings and tables in one file that works offline."""

from bodycap_batch.report.report_inputs import ReportInputs
from bodycap_batch.report.report_writer import REPORT_FILE, write_report

__all__ = ["REPORT_FILE", "ReportInputs", "write_report"]
