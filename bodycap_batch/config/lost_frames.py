"""Conditions for the recovery of lost frames, shared by the pipeline and registration."""

from __future__ import annotations

LEAST_LOST = 3
"""Minimum number of lost frames of a camera for recovery to run. Recovering fewer frames does not justify
decoding all keyframes again.
Evidence: none."""
LEAST_POSED = 20
"""Minimum number of localised frames of a camera for recovery to run. Fewer frames do not determine the
motion prior.
Evidence: none."""
