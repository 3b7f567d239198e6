"""Which keyframes carry the map of a long capture: enough of them that every other one sees some again."""

from __future__ import annotations

from collections import Counter

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import IntArray

SKELETAL_ABOVE = 1000
"""Keyframes beyond which the map is built from some of them, and the others are placed in it."""
_MIN_MATCHES = 16
_MIN_SUPPORT = 6
"""Of 608 keyframes of three cameras, a minute in one room, 91 are chosen, and all stand 0.25 cm off (rms)
after 35 CPU seconds; 0.17 after 39 with all adjusted together, 0.14 after 95 with the map built from all."""


def select_skeletal_keyframes(
    alike: npt.NDArray[np.int16], times: IntArray, *, sure: int = _MIN_MATCHES, support: int = _MIN_SUPPORT
) -> IntArray:
    """Rows of keyframes that see all there is: each of the others is surely alike to some of them.

    In order of time who is alike to too few of those chosen before is chosen, so that what is chosen hangs
    together; and so are some of those that show two parts together which nothing joined yet.

    Args:
        alike: (N,N) `likeness` of all keyframes, symmetric.
        times: (N,) when each was taken.
        sure: Likeness from which two keyframes surely show the same.
        support: How many of the chosen each of the others is to be alike to, and how many join two parts.

    Returns:
        Increasing rows.
    """
    tied = alike >= sure
    part = np.full(len(times), -1)
    joints = Counter[tuple[int, ...]]()
    for row in np.argsort(times, kind="stable"):
        parts = part[tied[row] & (part >= 0)]
        found = np.unique(parts)
        if len(parts) >= support and len(found) == 1:
            continue
        part[row] = row if len(found) == 0 else found[0]
        joints[tuple(found)] += 1
        if len(parts) < support or joints[tuple(found)] >= support:
            part[np.isin(part, found)] = part[row]
    return np.flatnonzero(part >= 0)
