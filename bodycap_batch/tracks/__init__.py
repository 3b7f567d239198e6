"""Follow points through a video, and find what the tracks show without a map."""

from bodycap_batch.tracks.fixed_regions import find_fixed_regions, fixed_notes
from bodycap_batch.tracks.lens import estimate_lens
from bodycap_batch.tracks.moving_regions import find_moving_regions, find_moving_tracks
from bodycap_batch.tracks.pure_rotation import measure_pure_rotation, rotations_alone
from bodycap_batch.tracks.rotation_chain import measure_rotation_chain
from bodycap_batch.tracks.tracker import PointTracker
from bodycap_batch.tracks.video import track_video

__all__ = [
    "PointTracker",
    "estimate_lens",
    "find_fixed_regions",
    "find_moving_regions",
    "find_moving_tracks",
    "fixed_notes",
    "measure_pure_rotation",
    "measure_rotation_chain",
    "rotations_alone",
    "track_video",
]
