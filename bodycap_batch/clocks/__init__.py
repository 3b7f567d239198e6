"""The clocks of the cameras: offsets and drifts between them, from the sound that all of them record."""

from bodycap_batch.clocks.estimate import ClockEstimate, ClockEstimates, estimate_clocks
from bodycap_batch.clocks.offset_check import offset_notes

__all__ = ["ClockEstimate", "ClockEstimates", "estimate_clocks", "offset_notes"]
