"""The mannequin: closed parts around the skeleton, which move with its joints."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from bodycap_batch.config.options import ExportOptions
from bodycap_batch.export.layout import apply_layout
from bodycap_batch.formats.mannequin import Mannequin, make_mannequin
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.model.skeleton import SkeletonModel, forward_kinematics, rest_pose
from tests.bodies import reaching


@cache
def person(height_m: float = 1.75) -> tuple[SkeletonModel, Mannequin]:
    body = reaching(1).skeleton
    scale = height_m / 1.75
    body = replace(body, offsets_m=scale * body.offsets_m, end_offsets_m=scale * body.end_offsets_m)
    return body, make_mannequin(body)


def volume_m3(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def inside(mesh: Mannequin, points: np.ndarray) -> np.ndarray:
    """Return which points are inside of a part of the mannequin."""
    import open3d as o3d

    edges = mesh.faces[:, [0, 1]].T
    pairs = coo_array((np.ones(edges.shape[1]), edges), shape=(len(mesh.vertices_m),) * 2)
    count, part = connected_components(pairs, directed=False)
    found = np.zeros(len(points), dtype=bool)
    for index in range(count):
        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(
            o3d.core.Tensor(mesh.vertices_m.astype(np.float32)),
            o3d.core.Tensor(mesh.faces[part[mesh.faces[:, 0]] == index].astype(np.uint32)),
        )
        found |= scene.compute_occupancy(o3d.core.Tensor(points.astype(np.float32))).numpy() > 0.5
    return found


def body_volume_m3(mesh: Mannequin) -> float:
    """Return the volume of all parts together. Where parts overlap, the volume counts once."""
    low, high = mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0)
    cell = (high[2] - low[2]) / 87.0  # 2 cm: the standard error of the count is below 1 %
    axes = [np.arange(a + cell / 2.0, b, cell) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return float(inside(mesh, points).sum() * cell**3)


def test_the_parts_are_closed_and_its_normals_point_out() -> None:
    _, mesh = person()
    edges = np.concatenate([mesh.faces[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))])
    there = {tuple(edge) for edge in edges.tolist()}
    assert len(there) == len(edges)
    assert all((b, a) in there for a, b in there)
    corners = mesh.vertices_m[mesh.faces]
    faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = np.einsum("ij,ij->i", faces, mesh.normals[mesh.faces].sum(axis=1)) > 0
    assert outward.mean() > 0.995
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-6)


def test_it_has_the_size_of_a_person() -> None:
    _, mesh = person()
    # An adult of 1.75 m weighs 50 to 80 kg, and a body has nearly the density of water.
    assert 0.050 < body_volume_m3(mesh) < 0.080
    low, high = mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0)
    assert 1.70 < high[2] < 1.80
    assert low[2] >= 0.0
    assert low[2] < 0.005
    assert abs(high[0] + low[0]) < 0.03


def test_it_scales_with_the_person() -> None:
    ratio = volume_m3(person(1.40)[1].vertices_m, person(1.40)[1].faces) / volume_m3(
        person()[1].vertices_m, person()[1].faces
    )
    assert ratio == pytest.approx((1.40 / 1.75) ** 3, rel=0.03)


def test_every_joint_is_inside() -> None:
    body, mesh = person()
    found = inside(mesh, rest_pose(body)[:, :3, 3])
    assert found.all(), [name for name, is_inside in zip(body.joints, found, strict=True) if not is_inside]


def test_weights_are_shared_by_neighbours_and_smooth() -> None:
    body, mesh = person()
    np.testing.assert_allclose(mesh.weights.sum(axis=1), 1.0)
    assert mesh.weights.min() >= 0.0
    for first, second in np.unique(mesh.joints[mesh.weights[:, 1] > 0], axis=0).tolist():
        assert body.parents[first] == second
    dense = np.zeros((len(mesh.vertices_m), len(body.joints)))
    np.add.at(dense, (np.arange(len(dense))[:, None], mesh.joints), mesh.weights)
    edges = np.unique(np.sort(np.concatenate([mesh.faces[:, :2], mesh.faces[:, 1:]]), axis=1), axis=0)
    steps = np.abs(dense[edges[:, 0]] - dense[edges[:, 1]]).sum(axis=1) / 2.0
    # The narrowest transition, at a wrist, is 7 cm wide, and an edge is some 3 cm long.
    assert np.percentile(steps, 97) < 0.55


def test_bent_limbs_keep_their_surface() -> None:
    """Elbows and knees that bend by 90° change no edge. A trunk that bends by 30° at a joint tears none."""
    body, mesh = person()
    local = np.tile(np.eye(3), (1, len(body.joints), 1, 1))
    for role, turn in (
        ("LeftForeArm", [0, 0, -1.57]),
        ("RightForeArm", [0, 0, 1.57]),
        ("LeftLeg", [1.57, 0, 0]),
        ("RightArm", [0, 1.2, 0]),
        ("Spine", [0.52, 0, 0]),
    ):
        local[:, body.roles.index(role)] = so3_exp(turn)
    posed = forward_kinematics(body, body.offsets_m[:1], local)[0]
    moved = posed @ np.linalg.inv(rest_pose(body))
    at = np.concatenate([mesh.vertices_m, np.ones((len(mesh.vertices_m), 1))], axis=1)
    bent = np.einsum("vk,vkab,vb->va", mesh.weights, moved[mesh.joints], at)[:, :3]
    edges = np.unique(np.sort(np.concatenate([mesh.faces[:, :2], mesh.faces[:, 1:]]), axis=1), axis=0)
    before, after = (np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1) for x in (mesh.vertices_m, bent))
    blended = ((mesh.weights > 0.0).sum(axis=1) > 1)[edges].any(axis=1)
    np.testing.assert_allclose(after[~blended], before[~blended], atol=1e-9)
    # A ring at 11 cm from the axis of the bend moves by 0.52 · 11 cm = 6 cm, spread over a blend of 12 cm.
    assert np.ptp((after / before)[blended]) > 0.1
    assert (after / before)[blended].max() < 1.0 + 1.5 * 0.06 / 0.12
    assert volume_m3(bent, mesh.faces) == pytest.approx(volume_m3(mesh.vertices_m, mesh.faces), rel=0.06)


@pytest.mark.parametrize("target", ["unreal", "unity", "mixamo"])
def test_other_layouts_have_the_same_body(target: str) -> None:
    motion = apply_layout(reaching(1), ExportOptions.model_validate({"target": target}))
    mesh = make_mannequin(motion.skeleton)
    assert volume_m3(mesh.vertices_m, mesh.faces) == pytest.approx(
        volume_m3(person()[1].vertices_m, person()[1].faces), rel=0.05
    )
    if motion.skeleton.roles[0] == "":
        assert 0 not in mesh.joints[mesh.weights > 0]


def test_a_skeleton_without_roles_has_a_body() -> None:
    body = reaching(1).skeleton
    bare = replace(body, roles=("",) * len(body.joints))
    mesh = make_mannequin(bare)
    assert np.isfinite(mesh.vertices_m).all()
    assert len(mesh.faces) > 100


def test_a_skeleton_without_lengths_is_refused() -> None:
    body = reaching(1).skeleton
    point = replace(
        body,
        joints=("a",),
        parents=np.array([-1]),
        offsets_m=np.zeros((1, 3)),
        end_offsets_m=np.full((1, 3), np.nan),
        roles=("",),
        bvh_channels=((),),
    )
    with pytest.raises(ValueError, match="no bone has a length"):
        make_mannequin(point)


def hanging_arms(skeleton: SkeletonModel) -> SkeletonModel:
    """Return the same body with narrow shoulders and a zero pose whose arms hang along the trunk."""
    offsets, ends = skeleton.offsets_m.copy(), skeleton.end_offsets_m.copy()
    for joint, role in enumerate(skeleton.roles):
        if role in ("LeftArm", "RightArm"):
            offsets[joint, 0] *= 0.75
        if role.endswith("Hand"):
            ends[joint] = [0.0, 0.0, -np.linalg.norm(ends[joint])]
        if role.endswith(("ForeArm", "Hand")):
            offsets[joint] = [0.0, 0.0, -np.linalg.norm(offsets[joint])]
    return replace(skeleton, offsets_m=offsets, end_offsets_m=ends, tpose_rotation=None)


def test_hands_of_hanging_arms_do_not_hold_the_hips() -> None:
    skeleton = hanging_arms(person()[0])
    mesh = make_mannequin(skeleton)
    arm = np.array([role.endswith(("Shoulder", "Arm", "Hand")) for role in skeleton.roles])
    end = np.array([role.endswith(("ForeArm", "Hand")) for role in skeleton.roles])
    of_arm, of_end = (mask[mesh.joints[:, 0]][mesh.faces] for mask in (arm, end))
    joined = of_end.any(axis=1) & ~of_arm.all(axis=1)
    assert not joined.any(), "no triangle joins a hand or a forearm with the trunk or a leg"
    # Lifted arms are as far from the hips as their bones are, and nothing is stretched between them.
    local = np.tile(np.eye(3), (len(skeleton.joints), 1, 1))
    local[skeleton.roles.index("LeftArm")] = so3_exp([0.0, -np.pi / 2.0, 0.0])
    local[skeleton.roles.index("RightArm")] = so3_exp([0.0, np.pi / 2.0, 0.0])
    root = rest_pose(skeleton)[:1, :3, 3]
    moved = forward_kinematics(skeleton, root, local[None])[0] @ np.linalg.inv(rest_pose(skeleton))
    at = np.concatenate([mesh.vertices_m, np.ones((len(mesh.vertices_m), 1))], axis=1)
    lifted = np.einsum("vk,vkij,vj->vi", mesh.weights, moved[mesh.joints], at)[:, :3]
    edges = mesh.faces[:, [0, 1]]
    longest = np.linalg.norm(lifted[edges[:, 0]] - lifted[edges[:, 1]], axis=1).max()
    # A bone of the arm has no ring between its ends, and no edge is longer than the bone.
    assert longest < 1.01 * np.linalg.norm(skeleton.offsets_m[1:], axis=1).max()
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-6)
