"""Follow points through every frame of a video, and find what the tracks show without a map."""

from bodycap_batch.tracks.fixed_regions import find_fixed_regions, fixed_notes, fixed_regions_of
from bodycap_batch.tracks.lens_from_motion import estimate_lens
from bodycap_batch.tracks.tracker import PointTracker

__all__ = ["PointTracker", "estimate_lens", "find_fixed_regions", "fixed_notes", "fixed_regions_of"]
