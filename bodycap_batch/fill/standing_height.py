"""The height of the hips over the floor, from the nearly straight legs of a person who walks or stands.

The height of the measured trunk over the floor has an error: the scale, the mount, the bones of the trunk and
the floor itself are not exact. Legs that have to absorb it would be crouched or would not reach the floor. A
person who walks or stands upright measures it, because the standing leg is nearly straight.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.fill.contacts import LEFT, RIGHT, STAND, Contacts
from bodycap_batch.fill.leg_geometry import LegGeometry
from bodycap_batch.model.fill_data import Footsteps
from bodycap_batch.model.skeleton import Motion

_WALKING = (0.967, 0.015)
"""Height of the hips over the standing ankle while the other foot swings, as a share of the length of the
leg: mean and standard deviation among people. Derivation: recorded walks have 0.957 to 0.978, walks of
published gait data 0.98 to 0.99. Evidence: docs/decisions/filling.md."""
_STANDING = (0.99, 0.012)
"""The same for a person who stands on both feet. Derivation: a knee that is bent by 5 to 15° gives 0.999 to
0.991, and ankles beside the hips lower them by 0.004."""
_HIGH_PERCENTILE = 90.0
"""Percentile of the heights over which the legs of a person who does not walk are straight. Such a person
crouches or sits most of the time. Evidence: none."""
_LEVEL_M = 0.02
"""Difference (metres) between the heights of two ankles on the same floor. Derivation: more than the left and
right leg of a skeleton differ, less than a stair."""
_OTHER_PER_M = 0.1
"""Density (1/m) of the height of a person who is not upright: who sits, squats or climbs. Derivation: one of
ten stances, somewhere within 1 m."""


@dataclass(frozen=True, slots=True)
class HeightSigmas:
    """What is known of the heights before the legs are straightened: standard deviations in metres.

    Attributes:
        floor_m: Of the floor below the trunk; infinite if the floor was not measured.
        pelvis_m: Of the pelvis below the trunk: the bones of the trunk, and the errors of a trunk whose floor
            is exact. 0 if the pelvis must keep its place.
    """

    floor_m: float
    pelvis_m: float


@dataclass(frozen=True, slots=True)
class StandingHeight:
    """The changes of the heights with which the standing legs are nearly straight, metres.

    Attributes:
        floor_m: Height of the floor in the world.
        floor_sigma_m: Standard deviation of this height.
        pelvis_m: Height by which the pelvis is raised against the trunk.
    """

    floor_m: float
    floor_sigma_m: float
    pelvis_m: float


def standing_height(
    steps: Footsteps,
    world: FloatArray,
    contacts: Contacts,
    legs: tuple[LegGeometry, LegGeometry],
    sigmas: HeightSigmas,
    floor_m: float,
) -> StandingHeight:
    """Return the floor and the pelvis with which the legs are as straight as those of an upright person.

    The mean of two normal distributions: what is known before, and what the standing legs measure. Floor and
    pelvis take the difference by the ratio of their variances.

    Args:
        steps: Where and when the feet stand on a floor at `floor_m`.
        world: (T,J,4,4) poses of the joints in the world with an upright pelvis, metres.
        contacts: Which feet stand.
        legs: The legs.
        sigmas: What is known before.
        floor_m: Height of the floor that is known or taken before, metres.
    """
    prior = float(np.hypot(sigmas.floor_m, sigmas.pelvis_m))
    hips = np.stack([world[:, leg.hip, :3, 3] for leg in legs], axis=1)
    low, spread, sure = _lowered_m(steps, hips, contacts, legs)
    if not len(low) or prior == 0.0:
        return StandingHeight(floor_m, sigmas.floor_m, 0.0)
    if sure.any():
        # A stance counts by the probability that the person is upright in it.
        low, spread = low[sure], spread[sure]
        width = np.hypot(spread, min(prior, 1.0))
        upright = np.exp(-0.5 * (low / width) ** 2) / (np.sqrt(2.0 * np.pi) * width)
        upright /= upright + _OTHER_PER_M
        exact = upright / spread**2
        lowered, weight = float((exact * low).sum() / (exact.sum() + 1e-9)), float(upright.mean())
    else:
        # The knees may be bent, but no leg is longer than straight.
        lowered, weight = min(float(np.median(low)), 0.0), 1.0
        if np.isinf(prior):
            lowered = float(np.percentile(low, 100.0 - _HIGH_PERCENTILE))
    sigma = float(np.hypot(np.mean(spread), np.median(np.abs(low - np.median(low)))))
    if np.isinf(prior):
        return StandingHeight(floor_m - lowered, sigma, 0.0)
    gain = weight / (prior**2 + sigma**2)
    return StandingHeight(
        floor_m - sigmas.floor_m**2 * gain * lowered,
        sigmas.floor_m * float(np.sqrt(1.0 - sigmas.floor_m**2 * gain)),
        sigmas.pelvis_m**2 * gain * lowered,
    )


def _lowered_m(
    steps: Footsteps, hips_m: FloatArray, contacts: Contacts, legs: tuple[LegGeometry, LegGeometry]
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return by stance how far the hips are below upright ones, with the sigma, and if it is certain (N,).

    A foot of an uncertain stance may stand beside the hips, so that a straight leg leans. Stances on stairs
    are left out, because their height follows from straight legs.
    """
    level = np.min(steps.ankle_in_world_m[:, 2], initial=np.inf)
    low, spread, sure = [], [], []
    for index, side in enumerate(steps.side.tolist()):
        leg = legs[side]
        own = np.arange(steps.start_tick[index], steps.end_tick[index])
        for alone, usual in ((LEFT if side == 0 else RIGHT, _WALKING), (STAND, _STANDING)):
            chosen = own[contacts.state[own] == alone]
            if not len(chosen) or steps.ankle_in_world_m[index, 2] > level + _LEVEL_M:
                continue
            sure.append(bool(contacts.is_sure[chosen].all()))
            share, sigma = usual if sure[-1] else _STANDING
            over_m = float(np.median(hips_m[chosen, :, 2])) - steps.ankle_in_world_m[index, 2]
            reach_m = share * leg.length_m
            if not sure[-1]:
                away = hips_m[chosen, side, :2] - steps.ankle_in_world_m[index, :2]
                away_m = float(np.median(np.linalg.norm(away, axis=1)))
                reach_m = float(np.sqrt(max(reach_m**2 - away_m**2, 0.0)))
            low.append(reach_m - over_m)
            spread.append(sigma * leg.length_m)
    return np.array(low), np.array(spread), np.array(sure, dtype=bool)


def raised_pelvis(motion: Motion, first: int, by_m: float) -> Motion:
    """Return the motion with a trunk that is shorter below its first measured joint, which keeps its poses.

    Args:
        motion: The motion.
        first: Index of the first measured joint; not the root.
        by_m: Distance (metres) by which the root is nearer to it.
    """
    skeleton = motion.skeleton
    chain = skeleton.path_to_root(first)[:-1]
    offsets = skeleton.offsets_m.copy()
    offsets[chain] *= 1.0 - by_m / float(np.linalg.norm(offsets[chain].sum(axis=0)))
    shorter = replace(motion, skeleton=replace(skeleton, offsets_m=offsets))
    moved = motion.world_from_joint()[:, first, :3, 3] - shorter.world_from_joint()[:, first, :3, 3]
    return replace(shorter, root_in_world_m=motion.root_in_world_m + moved)
