"""The types of the body: invalid input, and forward kinematics against matrix products."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bodycap_batch.model.skeleton import Motion, SkeletonModel, forward_kinematics


def chain() -> SkeletonModel:
    return SkeletonModel(
        name="chain",
        joints=("root", "a", "b", "c"),
        parents=np.array([-1, 0, 1, 0]),
        offsets_m=np.array([[0, 0, 1.0], [0, 0, 0.5], [0.3, 0, 0], [0, 0.2, 0]]),
        end_offsets_m=np.array([[np.nan] * 3, [np.nan] * 3, [0.1, 0, 0], [0, 0.1, 0]]),
        roles=("Hips", "Spine", "", ""),
        bvh_channels=((),) * 4,
    )


def test_forward_kinematics_is_a_product_down_the_tree() -> None:
    rng = np.random.default_rng(0)
    local = Rotation.random(8, random_state=rng).as_matrix().reshape(2, 4, 3, 3)
    root = rng.normal(size=(2, 3))
    poses = forward_kinematics(chain(), root, local)
    for tick in range(2):
        turn = local[tick, 0] @ local[tick, 1]
        at_a = root[tick] + local[tick, 0] @ [0, 0, 0.5]
        np.testing.assert_allclose(poses[tick, 1, :3, 3], at_a)
        np.testing.assert_allclose(poses[tick, 2, :3, 3], at_a + turn @ [0.3, 0, 0])
        np.testing.assert_allclose(poses[tick, 2, :3, :3], turn @ local[tick, 2])
        np.testing.assert_allclose(poses[tick, 3, :3, 3], root[tick] + local[tick, 0] @ [0, 0.2, 0])


def test_zero_pose_is_the_sum_of_offsets() -> None:
    poses = forward_kinematics(chain(), np.zeros((1, 3)), np.tile(np.eye(3), (1, 4, 1, 1)))
    np.testing.assert_allclose(poses[0, 2, :3, 3], [0.3, 0, 0.5])
    np.testing.assert_allclose(poses[0, :, :3, :3], np.tile(np.eye(3), (4, 1, 1)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"parents": np.array([-1, 2, 1, 0])}, "parent before its children"),
        ({"parents": np.array([0, 0, 1, 0])}, "parent before its children"),
        ({"parents": np.array([-1, -1, 1, 0])}, "one root"),
        ({"parents": np.array([-1, 0, 1])}, "parents: shape"),
        ({"joints": ("root", "a", "a", "c")}, "name once"),
        ({"offsets_m": np.full((4, 3), np.nan)}, "NaN"),
        ({"roles": ("Hips",)}, "one entry per joint"),
    ],
)
def test_an_invalid_tree_is_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(chain(), **change)  # type: ignore[arg-type]


def test_roles_are_found() -> None:
    assert chain().index_of_role("Spine") == 1
    assert chain().index_of_role("Head") is None


def test_ticks_do_not_drift() -> None:
    """At 29.97 Hz tick 30 000 is 1001 s after the start, to the nanosecond."""
    ticks = 30_001
    motion = Motion(
        skeleton=replace(
            chain(),
            joints=("root",),
            parents=np.array([-1]),
            offsets_m=np.zeros((1, 3)),
            end_offsets_m=np.zeros((1, 3)),
            roles=("Hips",),
            bvh_channels=((),),
        ),
        fps=30000 / 1001,
        start_ns=7,
        root_in_world_m=np.zeros((ticks, 3)),
        local_rotation=np.tile(np.eye(3), (ticks, 1, 1, 1)),
        observed=np.ones((ticks, 1), dtype=bool),
    )
    assert motion.times_ns()[-1] == 7 + 1001 * 10**9
    assert not motion.local_rotation.flags.writeable
