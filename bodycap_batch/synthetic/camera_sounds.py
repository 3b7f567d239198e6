"""The sound of each camera of a synthetic capture."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.formats.mp4_writer import Sound
from bodycap_batch.synthetic.clocks import first_and_last_s, true_clocks
from bodycap_batch.synthetic.moving_body import MovingBody, joint_poses_at
from bodycap_batch.synthetic.options import SynthOptions
from bodycap_batch.synthetic.sound import Microphone, make_scene, record
from bodycap_batch.synthetic.stance_walk import StanceWalk

_POSE_RATE_HZ = 100.0
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
    times_s = np.arange(start_s, end_s, 1.0 / _POSE_RATE_HZ)
    feet = [motion.skeleton.index_of_role(role) for role in ("LeftFoot", "RightFoot")]
    if len(times_s) < 2:
        return np.zeros(0)
    position_m = joint_poses_at(motion, times_s)[..., :3, 3]
    steps: list[float] = []
    for foot in feet:
        if foot is None:
            continue
        speed_m_s = np.linalg.norm(np.diff(position_m[:, foot], axis=0), axis=1) * _POSE_RATE_HZ
        swings = False
        for time_s, speed in zip(times_s[1:].tolist(), speed_m_s.tolist(), strict=True):
            if swings and speed < _RESTING_M_S:
                steps.append(time_s)
                swings = False
            swings = swings or speed > _MOVING_M_S
    return np.sort(np.array(steps, dtype=np.float64))


_RATE_HZ = 48_000
"""Samples per second of the sound. Origin: usual rate of cameras."""
_GAIN_DB = (-20.0, 0.0)
"""Least and greatest gain of a camera, decibels. Evidence: none."""
_LOW_HZ, _HIGH_HZ = (80.0, 300.0), (4500.0, 7500.0)
"""Least and greatest values of the lower and of the upper limit of a camera's frequency band, Hz. Evidence:
none."""
_SEED_KEY = 102
"""Number that makes the random numbers of the sound independent of those of the rest of a capture."""


class CameraSounds:
    """The sound of a capture, as each camera records it.

    Args:
        options: The options of the capture.
        motion: The moving body, whose feet make the sound of the steps.
    """

    def __init__(self, options: SynthOptions, motion: MovingBody) -> None:
        self._options, self._clocks = options, true_clocks(options)
        first_s, last_s = first_and_last_s(options, self._clocks)
        skew_s = max(abs(clock.skew_s) for clock in self._clocks.values())
        start_s, end_s = first_s - skew_s, last_s + skew_s
        seed = int(np.random.SeedSequence([options.seed, _SEED_KEY]).generate_state(1)[0])
        self._scene = make_scene(
            start_s,
            end_s,
            seed=seed,
            rate_hz=_RATE_HZ,
            steps_s=footstep_times(motion, start_s, end_s),
        )

    def of_camera(self, camera: str) -> Sound:
        """Return the sound that a camera records, from camera time 0 to the end of its video."""
        clock, options = self._clocks[camera], self._options
        rng = np.random.default_rng([options.seed, _SEED_KEY, options.cameras.index(camera)])
        microphone = Microphone(
            seed=int(rng.integers(1 << 31)),
            seconds=options.frame_count / options.fps,
            offset_s=float(clock.common_s(np.array(-clock.skew_s))),
            drift_ppm=clock.drift_ppm,
            noise_ratio_db=options.sound_ratio_db,
            gain_db=float(rng.uniform(*_GAIN_DB)),
            band_hz=(float(rng.uniform(*_LOW_HZ)), float(rng.uniform(*_HIGH_HZ))),
        )
        return Sound(record(self._scene, microphone), _RATE_HZ)
