"""The initial alignment of maps without common views: what determines the scale of the main map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.core.errors import EstimationError
from bodycap_batch.merging.body.bones import kinematic_chain
from bodycap_batch.merging.body.provisional_scale import provisional_scale
from bodycap_batch.merging.cameras.track import make_track
from bodycap_batch.merging.main_map import candidate_main_maps
from bodycap_batch.merging.map_alignment.initial_alignment import align_maps_initially
from bodycap_batch.synthetic import SynthOptions
from tests.bench.joining import SPLITS
from tests.bench.posed import posed


def _groups(maps, seed):
    """Return bones, mounts, tracks by map (the trunk's first), and map units per metre of the main map."""
    capture = posed(SynthOptions(seconds=20.0, cameras=tuple(maps), seed=seed, poses_only=True), maps)
    inputs, (main, further) = capture.inputs, candidate_main_maps(capture.inputs, ())[0]
    bones = kinematic_chain(inputs.skeleton, {mount.role for mount in inputs.mounts})
    index = {bone.role: place for place, bone in enumerate(bones)}
    groups = {}
    for each in (*main, *further):
        track = make_track(inputs, each, index[inputs.mount_of(each.camera).role])
        groups.setdefault(each.gauge, []).append(track)
    return (
        bones,
        {mount.camera: mount for mount in inputs.mounts},
        groups,
        capture.gauges[main[0].gauge].scale,
    )


def _starts(maps, seed):
    """Return the initial alignment, and its scale over the true one."""
    bones, mounts, groups, units = _groups(maps, seed)
    (_, first), *others = groups.items()
    found = align_maps_initially(bones, first, others, mounts)
    return found, found.metres_per_unit * units


@pytest.mark.parametrize("split", ["an arm each", "upper arms, palms"])
@pytest.mark.parametrize("seed", [0, 1])
def test_upper_arms_determine_the_scale_that_palms_in_another_map_do_not(split, seed):
    found, off = _starts(SPLITS[split], seed)
    assert found.scale_observable
    assert set(found.main_from_gauge) == set(SPLITS[split].values()) - {"a"}
    # Two mounts 5 cm wrong, 25 cm apart, on two sides: one sigma is 20 %. Palms alone gave 0.63 (log -0.46).
    assert abs(np.log(off)) < 0.3


def test_palms_in_separate_maps_do_not_determine_the_scale():
    found, _ = _starts(SPLITS["a palm each"], 0)
    assert not found.scale_observable
    assert np.isfinite(found.metres_per_unit)


@pytest.mark.parametrize("limb", [("left_forearm", "left_palm"), ("left_shin", "left_foot")])
def test_cameras_of_one_limb_determine_the_scale_by_their_own_distance(limb):
    bones, usual, groups, _ = _groups({"torso": "a", **dict.fromkeys(limb, "b")}, 0)
    mounts = {camera: replace(mount, sigma_m=0.04) for camera, mount in usual.items()}
    found = align_maps_initially(bones, groups["a"], [("b", groups["b"])], mounts)
    # The two are 14 to 20 cm apart, each with a mount 4 cm wrong.
    assert not found.scale_observable
    # The scale from a pair in one map does not depend on the alignment of the map.
    alone = provisional_scale(bones, groups["b"], mounts)
    assert found.metres_per_unit * found.main_from_gauge["b"].scale == pytest.approx(alone, rel=1e-6)


def test_a_palm_in_the_trunks_map_determines_the_scale_without_alignment():
    maps = {"torso": "a", "left_upper_arm": "a", "left_palm": "b", "right_palm": "b"}
    assert not _starts(maps, 0)[0].one_map_spans_a_limb
    assert _starts({**maps, "right_palm": "a"}, 0)[0].one_map_spans_a_limb


def test_a_head_in_a_separate_map_does_not_determine_the_scale():
    arms = SPLITS["upper arms, palms"]
    bones, mounts, groups, _ = _groups({**arms, "head": "h"}, 0)
    head = ("h", groups.pop("h"))
    (_, first), *others = groups.items()
    beside, without = (align_maps_initially(bones, first, each, mounts) for each in ([*others, head], others))
    assert beside.scale_observable
    assert beside.metres_per_unit == without.metres_per_unit
    with pytest.raises(EstimationError, match="'head' and 'torso' are in different maps"):
        _starts({"torso": "a", "head": "b", "left_palm": "c", "right_palm": "d"}, 0)


def test_a_hardly_localised_camera_does_not_determine_the_scale():
    maps = {"torso": "a", "head": "a", "left_palm": "b", "right_palm": "c"}
    bones, mounts, groups, _ = _groups(maps, 0)
    (_, (trunk, head)), *others = groups.items()
    assert align_maps_initially(bones, [trunk, head], others, mounts).scale_observable
    seldom = align_maps_initially(bones, [trunk, head.keep(np.arange(len(head.frames)) < 9)], others, mounts)
    assert not seldom.scale_observable
    assert seldom.metres_per_unit == align_maps_initially(bones, [trunk], others, mounts).metres_per_unit
