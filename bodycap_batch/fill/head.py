"""Neck and head: level, and turned to where the person goes or turns next."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.fill.trunk_signals import TrunkSignals, low_pass
from bodycap_batch.model.geometry import interpolate_rotation, rotation_angle_rad, so3_exp

_AHEAD_S = 0.25
"""Time (s) by which the head turns before the trunk. Source: R. Grasso and others, "Eye-head coordination for
the steering of locomotion in humans", Neuroscience Letters 253, 1998: 0.2 to 0.3 s."""
_MAX_TURN_RAD = np.radians(35.0)
"""Maximum angle between head and trunk. Evidence: none."""
_MAX_BEND_RAD = np.radians(60.0)
"""Maximum angle between head and trunk in all. Derivation: the neck extends by some 60°."""
_SMOOTH_HZ = 0.8
"""Cutoff frequency (Hz) of the head's yaw. Evidence: none."""
_NECK_SHARE = 0.5
"""Share of the head's rotation against the trunk that the neck takes. Evidence: none."""


def head_rotations(
    signals: TrunkSignals, trunk: FloatArray, reclined: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the orientations (T,3,3) of neck and head in the world.

    Args:
        signals: The signals of the trunk.
        trunk: (T,3,3) orientation of the joint that the neck starts from.
        reclined: (T,) 1 for a lying person, whose head continues the trunk.
    """
    ticks = len(trunk)
    later = np.minimum(np.arange(ticks) + round(_AHEAD_S * signals.fps), ticks - 1)
    look = low_pass(signals.heading_rad, _SMOOTH_HZ, signals.fps)[later]
    turn = np.clip(look - signals.heading_rad, -_MAX_TURN_RAD, _MAX_TURN_RAD)
    zero = np.zeros(ticks)
    head = so3_exp(np.column_stack([zero, zero, signals.heading_rad + turn]))
    # The head of a person who bows far, or lies, is not level.
    angle = rotation_angle_rad(np.swapaxes(trunk, -1, -2) @ head)
    bent = _MAX_BEND_RAD * np.tanh(angle / _MAX_BEND_RAD) / np.maximum(angle, 1e-9)
    share = (1.0 - reclined) * np.where(angle > 1e-6, bent, 1.0)
    head = interpolate_rotation(trunk, head, share)
    return interpolate_rotation(trunk, head, np.full(ticks, _NECK_SHARE)), head
