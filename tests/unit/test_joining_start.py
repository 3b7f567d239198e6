"""Where maps that share no view start: what tells the metric scale of the trunk's map."""

from __future__ import annotations

import numpy as np
import pytest

from bodycap_batch.merging.bones import graph_bones
from bodycap_batch.merging.choosing import choices
from bodycap_batch.merging.common_walk import starts_of
from bodycap_batch.merging.tracks import make_track
from bodycap_batch.synthetic import SynthOptions
from tests.bench.joining import SPLITS
from tests.bench.posed import posed


def _starts(split, seed):
    """The starts, and the scale they found over the true one."""
    options = SynthOptions(seconds=20.0, cameras=tuple(SPLITS[split]), seed=seed, poses_only=True)
    capture = posed(options, SPLITS[split])
    inputs, (main, further) = capture.inputs, choices(capture.inputs)[0]
    bones = graph_bones(inputs.skeleton, {mount.role for mount in inputs.mounts})
    index = {bone.role: place for place, bone in enumerate(bones)}
    groups = {}
    for each in (*main, *further):
        track = make_track(inputs, each, index[inputs.mount_of(each.camera).role])
        groups.setdefault(each.gauge, []).append(track)
    (gauge, first), *others = groups.items()
    found = starts_of(bones, first, others, {mount.camera: mount for mount in inputs.mounts})
    return found, found.metric * capture.gauges[gauge].scale


@pytest.mark.parametrize("split", ["an arm each", "upper arms, palms"])
@pytest.mark.parametrize("seed", [0, 1])
def test_upper_arms_tell_the_scale_that_palms_in_another_map_do_not(split, seed):
    found, off = _starts(split, seed)
    assert found.told
    assert set(found.places) == set(SPLITS[split].values()) - {"a"}
    # Two mounts 5 cm off, 25 cm apart, on two sides: one sigma is 20 %. Palms drew it to 0.63 (log -0.46).
    assert abs(np.log(off)) < 0.3


def test_palms_in_maps_of_their_own_tell_no_scale():
    found, _ = _starts("a palm each", 0)
    assert not found.told
    assert np.isfinite(found.metric)
