"""The export stage: write the result files of a job, and verify the motion files by reading them back."""

from bodycap_batch.export.export_inputs import ExportInputs
from bodycap_batch.export.result_files import LEFT_OUT, export_results

__all__ = ["LEFT_OUT", "ExportInputs", "export_results"]
