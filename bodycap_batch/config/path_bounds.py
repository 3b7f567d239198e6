"""Bounds beyond which the positions of a path say nothing."""

from __future__ import annotations

MAX_UNCERTAINTY = 0.25
"""Largest sigma of the positions, as a share of the extent of the longest path, with which the shape of
a path is not noise. Evidence: docs/decisions/report.md."""
MAX_CONTRADICTED = 0.05
"""Largest share of the compared frames that the video contradicts in a path that is not poor. Evidence:
docs/decisions/report.md."""
