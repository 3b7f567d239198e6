"""The height of the floor below straight legs, for a capture in which no floor was measured."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.fill.contacts import LEFT, RIGHT, STAND, Contacts
from bodycap_batch.fill.leg_geometry import LegGeometry
from bodycap_batch.model.fill_data import Footsteps

_STRAIGHT_SHARE = 0.985
"""Distance between hip and ankle at the middle of the time on one foot, and while standing, as a share of the
length of the leg. Derivation: a knee that is bent by 15°, as in M. P. Murray and others, 1964."""
_REACH_SHARE = 0.992
"""Maximum distance between hip and ankle, as a share of the length of the leg. Derivation: the limit at which
the knee is kept from a sudden stop."""
_SIGMA_SHARE = 0.02
"""Standard deviation of this share. Evidence: none."""
_HIGH_PERCENTILE = 75.0
"""Percentile of the heights that is taken as the height of the hips over straight legs. A person who crouches
is lower. Evidence: none."""


_MAX_LIFT_M = {"measured": 0.005, "legs": 0.03}
"""By origin of the floor, maximum height (metres) by which the feet stand above it so that the legs reach
them. Derivation: for a measured floor, a sole stays within 1 cm of it; else, 1.5 sigmas of the floor."""
_LIFT_PERCENTILE = 75.0
"""Percentile of the missing heights that the lift makes up for. Evidence: none."""


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


def lifted_steps(
    steps: Footsteps,
    floor: FloorHeight,
    world: FloatArray,
    contacts: Contacts,
    legs: tuple[LegGeometry, LegGeometry],
) -> tuple[Footsteps, FloorHeight]:
    """Return footsteps and floor, raised a little if the legs do not reach the feet while one foot stands.

    A measured floor keeps its height; the feet then stand some millimetres above it.

    Args:
        steps: Where and when the feet stand.
        floor: The floor.
        world: (T,J,4,4) poses of the joints in the world with an upright pelvis, metres.
        contacts: Which feet stand.
        legs: The legs.
    """
    missing: list[float] = []
    for index, side in enumerate(steps.side.tolist()):
        own = np.arange(steps.start_tick[index], steps.end_tick[index])
        own = own[contacts.state[own] == (LEFT if side == 0 else RIGHT)]
        away = world[own, legs[side].hip, :3, 3] - steps.ankle_in_world_m[index]
        longest = (_REACH_SHARE * legs[side].length_m) ** 2 - (away[:, :2] ** 2).sum(axis=1)
        missing += (away[:, 2] - np.sqrt(np.maximum(longest, 0.0))).tolist()
    if not missing:
        return steps, floor
    lift = float(np.clip(np.percentile(missing, _LIFT_PERCENTILE), 0.0, _MAX_LIFT_M[floor.source]))
    raised = replace(steps, ankle_in_world_m=steps.ankle_in_world_m + np.array([0.0, 0.0, lift]))
    if floor.source == "measured":
        return raised, floor
    return raised, replace(floor, height_m=floor.height_m + lift)
