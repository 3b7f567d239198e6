"""The clocks of the cameras: offsets and drifts between them, from the sound that all of them record."""

from bodycap_batch.clocks.capture_clocks import (
    clock_notes,
    decide_clocks,
    describe_clock,
    describe_clocks,
    with_known_offsets,
)
from bodycap_batch.clocks.estimate import (
    ClockEstimate,
    ClockEstimates,
    SoundEvidence,
    combine_evidence,
    estimate_clocks,
    measure_sound,
)

__all__ = [
    "ClockEstimate",
    "ClockEstimates",
    "SoundEvidence",
    "clock_notes",
    "combine_evidence",
    "decide_clocks",
    "describe_clock",
    "describe_clocks",
    "estimate_clocks",
    "measure_sound",
    "with_known_offsets",
]
