"""The pelvis and the lower spine: between the measured trunk and the feet."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.fill.contacts import STAND, Contacts
from bodycap_batch.fill.trunk_signals import TrunkSignals, low_pass
from bodycap_batch.model.fill_data import Footsteps
from bodycap_batch.model.geometry import interpolate_pose, make_transform, so3_exp
from bodycap_batch.model.skeleton import SkeletonModel

_YAW_RAD = np.radians(4.5)
"""Amplitude of the pelvis's yaw with each stride, at 1.3 m/s. Source: M. P. Murray, A. B. Drought, R. C.
Kory, "Walking patterns of normal men", Journal of Bone and Joint Surgery 46-A, 1964: 9 to 10° in all."""
_LIST_RAD = np.radians(3.5)
"""Amplitude of the pelvis's list with each stride, at 1.3 m/s. Source: as `_YAW_RAD`."""
_FULL_SPEED = 1.3
"""Speed (m/s) for which these amplitudes hold. They are proportional to the speed."""
_FADE_HZ = 1.5
"""Cutoff frequency (Hz) of the start and the end of these rotations. Evidence: none."""


def stride_phase_rad(steps: Footsteps, ticks: int) -> FloatArray:
    """Return the phase (T,) of the stride: 0 when the left foot touches the floor, π when the right one does.

    The phase is interpolated between steps, and constant before the first and after the last step.
    """
    events = [
        (int(start), int(side)) for start, side in zip(steps.start_tick, steps.side, strict=True) if start > 0
    ]
    if not events:
        return np.zeros(ticks)
    at: list[int] = []
    phase: list[float] = []
    last = -np.inf
    for start, side in sorted(events):
        if at and start <= at[-1]:
            continue
        wanted = np.pi * side
        while wanted <= last:
            wanted += 2.0 * np.pi
        at.append(start)
        phase.append(wanted)
        last = wanted
    return np.asarray(np.interp(np.arange(ticks), at, phase))


def pelvis_rotation(
    signals: TrunkSignals, contacts: Contacts, steps: Footsteps, has_gait: bool
) -> FloatArray:
    """Return the orientation (T,3,3) of the pelvis in the world.

    Args:
        signals: The signals of the trunk.
        contacts: Which feet stand.
        steps: Where the feet stand.
        has_gait: Whether the legs are filled.
    """
    ticks = len(signals.heading_rad)
    zero = np.zeros(ticks)
    yaw, tilt = signals.heading_rad, zero
    if has_gait:
        phase = stride_phase_rad(steps, ticks)
        walking = low_pass((contacts.state != STAND).astype(np.float64), _FADE_HZ, signals.fps)
        strength = np.clip(walking, 0.0, 1.0) * np.clip(signals.speed_m_per_s() / _FULL_SPEED, 0.0, 1.3)
        yaw = yaw - _YAW_RAD * strength * np.cos(phase)
        tilt = -_LIST_RAD * strength * np.sin(phase)
    turn = so3_exp(np.column_stack([zero, zero, yaw]))
    return np.asarray(turn @ so3_exp(np.column_stack([zero, tilt, zero])))


def bend_spine(
    skeleton: SkeletonModel, first: int, pelvis: FloatArray, world: FloatArray, filled: BoolArray
) -> None:
    """Write the poses of the joints above the first measured joint: root, lower spine and their helpers.

    Args:
        skeleton: The skeleton.
        first: Index of the first measured joint.
        pelvis: (T,3,3) orientation of the pelvis.
        world: (T,J,4,4) poses in the world; changed in place.
        filled: (J,) which joints are filled; changed in place.
    """
    chain = [first]
    while chain[-1] != 0:
        chain.append(int(skeleton.parents[chain[-1]]))
    last = len(chain) - 1
    bending = [step for step in range(1, len(chain)) if skeleton.roles[chain[step]] or step == last]
    trunk = make_transform(world[:, first, :3, :3], np.zeros(3))
    target = make_transform(pelvis, np.zeros(3))
    for step in range(1, len(chain)):
        child, joint = chain[step - 1], chain[step]
        fraction = np.full(len(world), (np.searchsorted(bending, step) + 1) / len(bending))
        rotation = interpolate_pose(trunk, target, fraction)[:, :3, :3]
        world[:, joint] = make_transform(
            rotation, world[:, child, :3, 3] - rotation @ skeleton.offsets_m[child]
        )
        filled[joint] = True
