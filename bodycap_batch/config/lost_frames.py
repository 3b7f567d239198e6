"""Conditions for the recovery of lost frames, shared by the pipeline and registration."""

from __future__ import annotations

LEAST_LOST = 3
"""Minimum number of lost frames of a camera; with fewer lost frames, recovery does not run for this camera. A
recovery of fewer frames does not justify that all keyframes are decoded again. Evidence: none."""
LEAST_POSED = 20
"""Minimum number of localised frames of a camera; with fewer localised frames, recovery does not run for this
camera. Fewer frames do not determine the prior of the camera's motion. Evidence: none."""
