"""Factors on the orientation of the trunk: upright in walking, facing the direction of walking.

A person with a tilted trunk keeps this tilt, so the error of these factors is equal at all ticks. All factors
of one kind therefore count together as one observation, for any number of ticks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gtsam
import numpy as np

from bodycap_batch.merging.body.bones import Bone
from bodycap_batch.merging.graph.factors import bone_key
from bodycap_batch.merging.graph.posture import Posture

UPRIGHT_SIGMA_RAD, HEADING_SIGMA_RAD = float(np.radians(5.0)), float(np.radians(8.0))
"""Sigmas (radians) of the mean orientation of a walker's chest. First: tilt from the vertical. Second: angle
between the heading of the chest and the direction of walking. The sigmas allow for the person's systematic
tilt of the trunk, and for the skeleton's definition of the axes of the chest. Evidence: none."""
STANDING_SIGMA_RAD = float(np.radians(7.0))
"""Sigma (radians) of the tilt of a chest at its highest position, in a capture without walking. A person who
bends and lifts things stands upright between these movements. The sigma combines the 5 degrees of a walker
with about 5 degrees of bending that the height of the chest does not show."""
_TRUNK = ("Spine1", "Spine", "Hips")
"""Roles of the bones that the factors constrain."""
_OWN_UP, _OWN_LEFT = gtsam.Unit3(np.array([0.0, 0.0, 1.0])), gtsam.Unit3(np.array([1.0, 0.0, 0.0]))
"""Up axis and left axis of a trunk bone in its own frame."""


class AttitudeFactors:
    """The factors that keep the trunk upright, and make it face the direction of walking.

    Args:
        bones: The graph's bones.
        posture: Posture at the ticks of the graph.
    """

    def __init__(self, bones: Sequence[Bone], posture: Posture) -> None:
        self._posture = posture
        self._trunk = [position for position, bone in enumerate(bones) if bone.role in _TRUNK]
        upright = posture.walking | posture.t_pose
        with_heading = np.isfinite(posture.walking_direction[:, 0])
        self._upright = _noise_for_one_observation(UPRIGHT_SIGMA_RAD, int(upright.sum()))
        self._standing = _noise_for_one_observation(STANDING_SIGMA_RAD, int(posture.standing.sum()))
        self._heading = _noise_for_one_observation(HEADING_SIGMA_RAD, int(with_heading.sum()))

    def add(self, graph: Any, tick: int) -> None:
        """Add the factors of one tick to a graph.

        The factors align the trunk's up axis with the vertical. They align the trunk's left axis with the
        horizontal direction to the left of the direction of walking.
        """
        posture = self._posture
        upright = posture.walking[tick] or posture.t_pose[tick]
        if posture.up is None or not (upright or posture.standing[tick]):
            return
        noise = self._upright if upright else self._standing
        for bone in self._trunk:
            key = bone_key(tick, bone)
            graph.add(gtsam.AttitudeFactorPose3(key, gtsam.Unit3(posture.up), noise, _OWN_UP))
            if np.isfinite(posture.walking_direction[tick, 0]):
                left = gtsam.Unit3(np.cross(posture.up, posture.walking_direction[tick]))
                graph.add(gtsam.AttitudeFactorPose3(key, left, self._heading, _OWN_LEFT))


def _noise_for_one_observation(sigma: float, count: int) -> Any:
    """Return the noise of each of `count` factors that together count as one observation with `sigma`."""
    return gtsam.noiseModel.Isotropic.Sigma(2, sigma * float(np.sqrt(max(count, 1))))
