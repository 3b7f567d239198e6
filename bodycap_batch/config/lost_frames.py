"""Conditions for the recovery of lost frames and for a second pass, shared by pipeline and registration."""

from __future__ import annotations

LEAST_LOST = 3
"""Minimum number of lost frames of a camera. Recovery does not run for a camera with fewer lost frames.
Reason: recovery decodes all keyframes again, which costs too much for so few frames. Evidence: none."""
LEAST_POSED = 20
"""Minimum number of localised frames of a camera. Recovery does not run for a camera with fewer localised
frames. Reason: fewer frames do not determine the prior of the camera's motion. Evidence: none."""
LEAST_LOST_SHARE = 0.02
"""Minimum share of lost frames of a camera. If every camera in whose pictures the wearer covers much lost
fewer frames, map and registration are not repeated without the wearer. Reason: this takes as long as the
first time, and could not gain much. Evidence: none."""
