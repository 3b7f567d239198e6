"""The clocks of the cameras: offsets and drifts between them, from their sound and from their motion."""

from bodycap_batch.clocks.capture_clocks import decide_clocks, with_known_offsets
from bodycap_batch.clocks.descriptions import (
    clock_notes,
    clocks_from_motion_notes,
    describe_clocks,
)
from bodycap_batch.clocks.estimate import (
    ClockEstimate,
    ClockEstimates,
    combine_evidence,
    estimate_clocks,
    stated_offsets,
)
from bodycap_batch.clocks.motion_evidence import add_motion
from bodycap_batch.clocks.motion_offsets import clocks_from_paths
from bodycap_batch.clocks.sound_evidence import SoundEvidence, measure_sound

__all__ = [
    "ClockEstimate",
    "ClockEstimates",
    "SoundEvidence",
    "add_motion",
    "clock_notes",
    "clocks_from_motion_notes",
    "clocks_from_paths",
    "combine_evidence",
    "decide_clocks",
    "describe_clocks",
    "estimate_clocks",
    "measure_sound",
    "stated_offsets",
    "with_known_offsets",
]
