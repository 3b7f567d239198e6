"""The height of the floor below straight legs, for a capture in which no floor was measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.fill.contacts import LEFT, RIGHT, STAND, Contacts
from bodycap_batch.fill.leg_geometry import LegGeometry

_STRAIGHT_SHARE = 0.985
"""Distance between hip and ankle at the middle of the time on one foot, and while standing, as a share of the
length of the leg. Derivation: a knee that is bent by 15°, as in M. P. Murray and others, 1964."""
_SIGMA_SHARE = 0.02
"""Standard deviation of this share. Evidence: none."""
_HIGH_PERCENTILE = 75.0
"""Percentile of the heights that is taken as the height of the hips over straight legs. A person who crouches
is lower. Evidence: none."""


@dataclass(frozen=True, slots=True)
class FloorHeight:
    """The floor that the filled feet stand on.

    Attributes:
        height_m: Height in the world, metres.
        sigma_m: Standard deviation of the height, metres; 0 if the floor was measured.
        source: ``measured`` or ``legs``.
    """

    height_m: float
    sigma_m: float
    source: str


def floor_below_legs(
    world: FloatArray, contacts: Contacts, legs: tuple[LegGeometry, LegGeometry]
) -> FloorHeight:
    """Return the floor below the straight legs of the person.

    Args:
        world: (T,J,4,4) poses of the joints in the world with an upright pelvis, metres.
        contacts: Which feet stand.
        legs: The legs.
    """
    hips = 0.5 * (world[:, legs[0].hip, 2, 3] + world[:, legs[1].hip, 2, 3])
    length = 0.5 * (legs[0].length_m + legs[1].length_m)
    ankle = 0.5 * (legs[0].ankle_height_m + legs[1].ankle_height_m)
    used = np.isin(contacts.state, (LEFT, RIGHT, STAND))
    heights = hips[used] if used.any() else hips
    high = float(np.percentile(heights, _HIGH_PERCENTILE))
    spread = float(np.median(np.abs(heights - np.median(heights))))
    return FloorHeight(
        high - _STRAIGHT_SHARE * length - ankle,
        float(np.hypot(_SIGMA_SHARE * length, spread)),
        "legs",
    )
