"""Which camera was where, from the motion of three cameras."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bodycap_batch.camera_places import TimedPoses, find_places, find_places_with
from bodycap_batch.clocks.motion_offsets import clocks_from_paths
from bodycap_batch.model.camera_clock import ClockRelation
from bodycap_batch.model.geometry import Similarity, make_transform
from bodycap_batch.model.scene import FrameStatus, Trajectory
from bodycap_batch.synthetic.making import draw_subject
from bodycap_batch.synthetic.moving_body import camera_poses_at
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


def trajectories(paths: dict[str, TimedPoses], offsets_s: dict[str, float]) -> list[Trajectory]:
    """Return the paths on the cameras' own clocks."""
    return [
        Trajectory(
            camera=name,
            gauge="map",
            frame_numbers=np.arange(len(path.common_ns)),
            times_ns=path.common_ns - round(offsets_s[name] * 1e9),
            gauge_from_cam=path.map_from_cam,
            covariance=np.tile(np.eye(6), (len(path.common_ns), 1, 1)),
            status=(FrameStatus.REGISTERED,) * len(path.common_ns),
            inliers=np.full(len(path.common_ns), 50),
            error_px=np.full(len(path.common_ns), 0.5),
        )
        for name, path in sorted(paths.items())
    ]


def clocks_of(paths: list[Trajectory], trunk: str) -> dict[str, ClockRelation]:
    """Return the clocks from the motion, if the camera `trunk` is taken for the one on the trunk."""
    found = clocks_from_paths(paths, {trunk: "Spine1"}, paths[0].camera)
    return {
        path.camera: ClockRelation(offset_s=found.clocks[path.camera].offset_s, source="motion")
        if path.camera in found.clocks
        else ClockRelation(source="common" if path is paths[0] else "none")
        for path in paths
    }


@pytest.mark.parametrize("seed", range(4))
def test_clocks_and_places_are_found_together(seed: int) -> None:
    names = named(PLACES)
    options = SynthOptions(seconds=8.0, walk="gait", seed=seed)
    offsets_s = dict(zip(names.values(), (0.3, -1.2, 2.1), strict=True))
    paths = trajectories(cameras(options, names), offsets_s)
    clocks = {path.camera: clocks_of(paths, path.camera) for path in paths}
    found = find_places_with(clocks, paths, {})
    assert found.by_camera == {name: place for place, name in names.items()}, found.reason


def test_clocks_that_no_hypothesis_gives_are_the_reason() -> None:
    names = named(PLACES)
    still = SynthOptions(seconds=4.0, seed=1)
    paths = trajectories(cameras(still, names), dict.fromkeys(names.values(), 0.0))
    found = find_places_with({path.camera: clocks_of(paths, path.camera) for path in paths}, paths, {})
    assert found.by_camera == {}
    assert "the clock of" in found.reason


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
