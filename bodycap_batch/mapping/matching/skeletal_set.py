"""Select the keyframes that a large map is built from: every other keyframe shows what some of them show."""

from __future__ import annotations

from collections import Counter

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import IntArray

SKELETAL_ABOVE = 1000
"""Number of keyframes above which a map is built from a skeletal set and the other keyframes are resected.
Adjusting that many keyframes together again and again would take hours.
Evidence: docs/decisions/mapping.md."""
_MIN_MATCHES = 16
"""Matches above which two keyframes surely show the same: four times `MIN_RETRIEVAL_MATCHES`.
Evidence: docs/decisions/mapping.md."""
_MIN_SUPPORT = 6
"""Selected keyframes that every other keyframe must match. Evidence: docs/decisions/mapping.md."""


def select_skeletal_keyframes(
    matches: npt.NDArray[np.int16],
    times: IntArray,
    *,
    min_matches: int = _MIN_MATCHES,
    min_support: int = _MIN_SUPPORT,
) -> IntArray:
    """Select keyframes that together show everything, so that the others can be resected against them.

    Keyframes are processed in time order. A keyframe is selected if it matches fewer than `min_support`
    selected keyframes; this keeps the selection connected. Up to `min_support` keyframes that link the same
    unconnected components are selected too.

    Args:
        matches: (N,N) number of matches of all pairs of keyframes, symmetric.
        times: (N,) time of each keyframe, any unit.
        min_matches: Matches above which two keyframes surely show the same.
        min_support: Selected keyframes that each other keyframe must match, and links between components.

    Returns:
        Rows of the selected keyframes, increasing.

    Source: Snavely et al., "Skeletal graphs for efficient structure from motion", CVPR 2008, for the idea.
    """
    matched = matches >= min_matches
    component = np.full(len(times), -1)
    links = Counter[tuple[int, ...]]()
    for row in np.argsort(times, kind="stable"):
        components = component[matched[row] & (component >= 0)]
        linked = np.unique(components)
        if len(components) >= min_support and len(linked) == 1:
            continue
        component[row] = row if len(linked) == 0 else linked[0]
        links[tuple(linked)] += 1
        if len(components) < min_support or links[tuple(linked)] >= min_support:
            component[np.isin(component, linked)] = component[row]
    return np.flatnonzero(component >= 0)
