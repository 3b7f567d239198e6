"""Find the moments at which the feet of a moving body touch the floor."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.synthetic.moving_body import MovingBody, joint_poses_at
from bodycap_batch.synthetic.stance_walk import StanceWalk

_RATE_HZ = 100.0
"""Number of examined poses per second. Origin: a step in the sound is then right to 10 ms."""
_MOVING_M_S = 0.8
"""Speed of an ankle, metres per second, above which the foot swings. Origin: the foot of a walking person
swings with 2 to 4 m/s."""
_RESTING_M_S = 0.4
"""Speed of an ankle, metres per second, below which the foot stands after a swing. Evidence: none."""


def footstep_times(motion: MovingBody, start_s: float, end_s: float) -> FloatArray:
    """Return the common times (N,), seconds, at which a foot comes to rest after a swing, in ascending order.

    Args:
        motion: The moving body.
        start_s: Start of the examined time on the common clock, seconds.
        end_s: End of this time, seconds.
    """
    if isinstance(motion, StanceWalk):
        strikes = np.concatenate([rows[:, 0] for rows in motion.contacts(start_s, end_s).values()])
        return np.sort(strikes[(strikes >= start_s) & (strikes < end_s)])
    times_s = np.arange(start_s, end_s, 1.0 / _RATE_HZ)
    feet = [motion.skeleton.index_of_role(role) for role in ("LeftFoot", "RightFoot")]
    if len(times_s) < 2:
        return np.zeros(0)
    position_m = joint_poses_at(motion, times_s)[..., :3, 3]
    steps: list[float] = []
    for foot in feet:
        if foot is None:
            continue
        speed_m_s = np.linalg.norm(np.diff(position_m[:, foot], axis=0), axis=1) * _RATE_HZ
        swings = False
        for time_s, speed in zip(times_s[1:].tolist(), speed_m_s.tolist(), strict=True):
            if swings and speed < _RESTING_M_S:
                steps.append(time_s)
                swings = False
            swings = swings or speed > _MOVING_M_S
    return np.sort(np.array(steps, dtype=np.float64))
