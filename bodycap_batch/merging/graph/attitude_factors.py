"""Factors of the trunk's attitude from the posture: upright in walking, facing the direction of walking.

Such knowledge is wrong by the same amount in every frame: a person who leans does so all the time. Each kind
of factor therefore counts as one observation, however many frames it is applied to.
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
"""Sigmas, in radians, of a walker's mean chest about the vertical and about the direction of walking. They
contain the person's systematic lean, and how the rig defines the axes of the chest. Evidence: none."""
STANDING_SIGMA_RAD = float(np.radians(7.0))
"""The same about the vertical for a chest at its highest in a capture without walking. A person who bends and
lifts stands up in between. It contains the 5 degrees of a walker, and about as many for the bend that the
height leaves undetermined."""
_TRUNK = ("Spine1", "Spine", "Hips")
"""Roles of the bones that the factors apply to."""
_OWN_UP, _OWN_LEFT = gtsam.Unit3(np.array([0.0, 0.0, 1.0])), gtsam.Unit3(np.array([1.0, 0.0, 0.0]))
"""Axes of a trunk bone in its own frame."""


class AttitudeFactors:
    """The attitude factors of the trunk.

    Args:
        bones: The graph's bones.
        posture: At the ticks of the graph.
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
        """Add the factors of one tick: the trunk's up, and its left at right angles to the way it walks."""
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
    """Return the noise of each of `count` factors that together count as one observation of this sigma."""
    return gtsam.noiseModel.Isotropic.Sigma(2, sigma * float(np.sqrt(max(count, 1))))
