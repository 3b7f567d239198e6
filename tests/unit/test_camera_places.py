"""Which camera was where, from the motion of three cameras."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bodycap_batch.camera_places import TimedPoses, find_places
from bodycap_batch.model.geometry import Similarity, make_transform
from bodycap_batch.synthetic.camera_renderer import camera_poses_at
from bodycap_batch.synthetic.making import draw_subject
from bodycap_batch.synthetic.options import SynthOptions

PLACES = ("torso", "left_palm", "right_palm")
RATE = 15


def cameras(options: SynthOptions, names: dict[str, str]) -> dict[str, TimedPoses]:
    """Return noisy paths in a map of any scale and axes, by camera name; `names` gives the name by place."""
    rng = np.random.default_rng(options.seed)
    times_s = np.arange(round(options.seconds * RATE)) / RATE
    subject = draw_subject(options)
    gauge = Similarity(
        float(np.exp(rng.normal())), Rotation.random(random_state=1).as_matrix(), np.array([3.0, -2.0, 1.0])
    )
    found = {}
    for mount in subject.mounts:
        noise = make_transform(
            Rotation.from_rotvec(rng.normal(scale=0.005, size=(len(times_s), 3))).as_matrix(),
            rng.normal(scale=0.005, size=(len(times_s), 3)),
        )
        poses = gauge.apply_to_poses(camera_poses_at(subject.motion, mount, times_s) @ noise)
        times_ns = np.round(times_s * 1e9).astype(np.int64)
        found[names[mount.camera]] = TimedPoses(common_ns=times_ns, map_from_cam=poses)
    return found


def named(order: tuple[str, ...]) -> dict[str, str]:
    return {place: f"camera_{number}" for number, place in enumerate(order)}


@pytest.mark.parametrize("order", list(permutations(PLACES)))
def test_the_places_do_not_depend_on_names_and_order(order: tuple[str, ...]) -> None:
    names = named(order)
    paths = cameras(SynthOptions(seconds=8.0, walk="gait", seed=3), names)
    found = find_places({name: paths[name] for name in sorted(paths)}, {})
    assert found.by_camera == {name: place for place, name in names.items()}
    assert found.reason == ""


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"seconds": 1.0}, "for only"),
        ({"on_the_spot": True}, "does not walk where it looks"),
        ({"arms_ahead": 1.0}, "not below it"),
    ],
)
def test_a_motion_that_does_not_decide_gives_no_places(options: dict[str, object], reason: str) -> None:
    names = named(PLACES)
    found = find_places(cameras(SynthOptions.model_validate({"seconds": 6.0, **options}), names), {})
    assert found.by_camera == {}
    assert reason in found.reason


def test_an_answer_that_contradicts_a_stated_place_is_no_answer() -> None:
    names = named(PLACES)
    paths = cameras(SynthOptions(seconds=8.0, walk="gait", seed=3), names)
    assert find_places(paths, {names["torso"]: "torso"}).by_camera
    found = find_places(paths, {names["left_palm"]: "right_palm"})
    assert found.by_camera == {}
    assert "stated as right_palm" in found.reason


def test_a_torso_camera_that_looks_backwards_gives_no_places() -> None:
    names = {"torso_back": "a", "left_palm": "b", "right_palm": "c"}
    options = SynthOptions(seconds=8.0, walk="gait", seed=3, cameras=tuple(names))
    assert find_places(cameras(options, names), {}).by_camera == {}
