"""The sound of footsteps follows the feet."""

from __future__ import annotations

import numpy as np

from bodycap_batch.synthetic import SynthOptions
from bodycap_batch.synthetic.camera_sounds import footstep_times
from bodycap_batch.synthetic.making import draw_subject
from bodycap_batch.synthetic.moving_body import joint_poses_at
from bodycap_batch.synthetic.sound import make_scene


def test_a_step_is_where_a_foot_comes_to_rest():
    motion = draw_subject(SynthOptions(seconds=10.0)).motion
    times_s = footstep_times(motion, 0.0, 10.0)
    # People walk with 1.4 to 2.2 steps per second.
    assert 10 <= len(times_s) <= 24
    assert (np.diff(times_s) > 0.2).all()
    feet = [motion.skeleton.index_of_role(role) for role in ("LeftFoot", "RightFoot")]
    height_m = joint_poses_at(motion, np.arange(0.0, 10.0, 0.01))[:, feet, 2, 3]
    at_step = joint_poses_at(motion, times_s)[:, feet, 2, 3].min(axis=1)
    assert at_step.max() < np.quantile(height_m, 0.6)


def test_a_person_on_the_spot_makes_no_steps():
    motion = draw_subject(SynthOptions(seconds=6.0, on_the_spot=True)).motion
    assert len(footstep_times(motion, 0.0, 6.0)) == 0


def test_the_sound_of_the_steps_starts_at_the_given_times():
    given = np.array([-5.0, 0.5, 1.7, 99.0])
    scene = make_scene(0.0, 3.0, seed=1, rate_hz=16_000, sources=("steps",), steps_s=given)
    samples = np.abs(scene.sources["steps"])
    loud_s = scene.start_s + np.flatnonzero(samples > 0.0) / 16_000
    assert loud_s[0] >= 0.5 - 1e-3
    assert ((loud_s < 0.75) | (loud_s > 1.699)).all()
    assert loud_s[-1] < 1.95
    silent = make_scene(0.0, 3.0, seed=1, rate_hz=16_000, sources=("steps",), steps_s=np.zeros(0))
    assert not silent.sources["steps"].any()
