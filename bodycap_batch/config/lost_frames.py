"""Conditions for the work on lost frames, shared by pipeline, mapping and registration."""

from __future__ import annotations

LEAST_LOST = 3
"""Minimum number of lost frames of a camera. Recovery does not run for a camera with fewer lost frames.
Reason: recovery decodes all keyframes again, which costs too much for so few frames. Evidence: none."""
LEAST_POSED = 20
"""Minimum number of localised frames of a camera. Recovery does not run for a camera with fewer localised
frames. Reason: fewer frames do not determine the prior of the camera's motion. Evidence: none."""
LEAST_MAPPED = 10
"""Minimum number of keyframes of a further map, which is made of lost frames. Source: COLMAP's default
size of a model."""
