"""Select skeletal keyframes (the reduced set of keyframes, Snavely's skeletal set) for a large map.

Every keyframe that is not selected overlaps with several selected keyframes.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import IntArray

SKELETAL_ABOVE = 1000
"""Maximum number of keyframes of a map that is built from all keyframes at once. A larger map is built from
skeletal keyframes, and the other keyframes are resected: repeated adjustments of all keyframes would take
hours. Evidence: docs/decisions/mapping.md."""
_MIN_MATCHES = 16
"""Minimum number of matches of two overlapping keyframes. Two keyframes with fewer matches are not treated as
overlapping. The number is four times `MIN_RETRIEVAL_MATCHES`. Evidence: docs/decisions/mapping.md."""
_MIN_SUPPORT = 6
"""A keyframe is selected if it overlaps with fewer selected keyframes than this number. So every keyframe
that is not selected overlaps with at least this number of selected keyframes.
Evidence: docs/decisions/mapping.md."""


def select_skeletal_keyframes(
    matches: npt.NDArray[np.int16],
    times: IntArray,
    *,
    min_matches: int = _MIN_MATCHES,
    min_support: int = _MIN_SUPPORT,
) -> IntArray:
    """Select skeletal keyframes, against which all other keyframes can be resected.

    Keyframes are processed in time order. A keyframe is selected if it overlaps with fewer than
    `min_support` selected keyframes.

    A component is a set of selected keyframes that are connected by overlaps. A keyframe that overlaps with
    several components links these components and is also selected. The linked components become one
    component in two cases: `min_support` keyframes linked them, or a keyframe that overlaps with fewer than
    `min_support` selected keyframes links them.

    Args:
        matches: (N,N) number of matches of all pairs of keyframes, symmetric.
        times: (N,) time of each keyframe, in any unit.
        min_matches: Minimum number of matches of two overlapping keyframes.
        min_support: A keyframe is selected if it overlaps with fewer selected keyframes than this number.
            The number also decides when linked components become one component.

    Returns:
        Indices of the selected keyframes, increasing.

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
