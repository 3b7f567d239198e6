"""Bounds beyond which the positions of a path say nothing."""

from __future__ import annotations

MAX_UNCERTAINTY = 0.25
"""Largest sigma of the positions, as a share of the extent of the longest path, with which the shape of
a path is not noise. Evidence: docs/decisions/report.md."""
MAX_WITHDRAWN = 0.25
"""Largest share of the compared frames of a path that are withdrawn because the video contradicts them. Of a
path with more of them, it is not known which part is wrong. Evidence: docs/decisions/tracks.md."""
MAX_CONTRADICTED = 0.05
"""Largest share of the compared frames that the video contradicts in a path that is not poor. Evidence:
docs/decisions/report.md."""
