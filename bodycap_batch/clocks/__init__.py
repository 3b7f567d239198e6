"""The clocks of the cameras: offsets and drifts between them, from their sound and from their motion."""

from bodycap_batch.clocks.capture_clocks import (
    clock_notes,
    clocks_from_motion_notes,
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
    stated_offsets,
)
from bodycap_batch.clocks.motion_evidence import add_motion
from bodycap_batch.clocks.motion_offsets import motion_clocks
from bodycap_batch.clocks.motion_signals import CameraPath
from bodycap_batch.clocks.registered_paths import clocks_from_paths

__all__ = [
    "CameraPath",
    "ClockEstimate",
    "ClockEstimates",
    "SoundEvidence",
    "add_motion",
    "clock_notes",
    "clocks_from_motion_notes",
    "clocks_from_paths",
    "combine_evidence",
    "decide_clocks",
    "describe_clock",
    "describe_clocks",
    "estimate_clocks",
    "measure_sound",
    "motion_clocks",
    "stated_offsets",
    "with_known_offsets",
]
