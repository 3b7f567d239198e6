"""Stage 5: the files a person opens, written, read back and verified."""

from bodycap_batch.export.export_inputs import ExportInputs
from bodycap_batch.export.result_files import export_results

__all__ = ["ExportInputs", "export_results"]
