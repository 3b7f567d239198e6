"""Read job files; define the options of the stages."""

from bodycap_batch.config.options import (
    ExportOptions,
    KeyframeOptions,
    MapOptions,
    MergeOptions,
    RegistrationOptions,
)

__all__ = ["ExportOptions", "KeyframeOptions", "MapOptions", "MergeOptions", "RegistrationOptions"]
