"""Conditions for the recovery of lost frames, shared by the pipeline and registration."""

from __future__ import annotations

LEAST_LOST = 3
"""Lost frames from which recovery runs for a camera. Fewer do not justify decoding all keyframes again.
Evidence: none."""
LEAST_POSED = 20
"""Localised frames from which recovery runs for a camera. Fewer do not determine the motion prior.
Evidence: none."""
