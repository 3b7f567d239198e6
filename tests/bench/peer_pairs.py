"""The frame pairs that the peers match: one list for both mappers, linear in the number of frames."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

STEPS = (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 16, 32)
"""Steps between matched frames of one camera: COLMAP's sequential overlap of ten, then powers of two."""
OWN_AGAIN = 8
"""Number of retrieved frames of the same camera at other times, and of each other camera, as in our own
mapping. AWAY_NS is the least time difference for the same camera, nanoseconds."""
FROM_OTHER = 6
AWAY_NS = 2_000_000_000

IntArray = npt.NDArray[np.int64]


def pairs_of(
    cameras: npt.NDArray[np.str_], times_ns: IntArray, alike: npt.NDArray[np.float64]
) -> list[tuple[int, int]]:
    """Return pairs of rows (a < b), in order.

    Args:
        cameras: (N,) camera of each frame; frames of one camera are in the order of their times.
        times_ns: (N,) common times.
        alike: (N,N) similarity of the pictures.
    """
    chosen: set[tuple[int, int]] = set()
    rows_of = {name: np.flatnonzero(cameras == name) for name in np.unique(cameras)}
    for name, own in rows_of.items():
        for place, row in enumerate(own.tolist()):
            partners = {int(own[place + step]) for step in STEPS if place + step < len(own)}
            away = own[np.abs(times_ns[own] - times_ns[row]) > AWAY_NS]
            partners |= _most_alike(alike[row], away, OWN_AGAIN)
            for other_name, other in rows_of.items():
                if other_name != name:
                    partners.add(int(other[np.argmin(np.abs(times_ns[other] - times_ns[row]))]))
                    partners |= _most_alike(alike[row], other, FROM_OTHER)
            chosen |= {(min(row, other), max(row, other)) for other in partners}
    return sorted(chosen)


def _most_alike(alike: npt.NDArray[np.float64], rows: IntArray, count: int) -> set[int]:
    return {int(row) for row in rows[np.argsort(-alike[rows], kind="stable")[:count]]}
