"""Follow points through every frame of a video, and find what the tracks show without a map."""

from bodycap_batch.tracks.fixed_regions import find_fixed_regions, fixed_notes, fixed_regions_of
from bodycap_batch.tracks.tracker import PointTracker

__all__ = ["PointTracker", "find_fixed_regions", "fixed_notes", "fixed_regions_of"]
