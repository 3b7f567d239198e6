"""Stage 5: the files a person opens, written, read back and verified."""

from bodycap_batch.export.inputs import ExportInputs

__all__ = ["ExportInputs"]
