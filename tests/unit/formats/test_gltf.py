"""GLB files: round trips, and the content as the specification of the format requires it."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bodycap_batch.core.errors import JobError
from bodycap_batch.formats.gltf import read_glb, write_glb
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.model.skeleton import Motion, rest_pose
from bodycap_batch.model.skeleton_presets import load_skeleton
from tests.bodies import reaching

# Single precision at 3 m from the origin, along seven joints.
POSITION_TOLERANCE_M = 7 * 3 * 6e-8
DTYPES = {5126: "<f4", 5123: "<u2", 5125: "<u4"}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Parsed:
    """A parser of GLB files, written after the specification of the format."""

    def __init__(self, path: Path) -> None:
        data = path.read_bytes()
        magic, version, length = struct.unpack_from("<4sII", data)
        assert (magic, version, length) == (b"glTF", 2, len(data))
        size, kind = struct.unpack_from("<I4s", data, 12)
        assert kind == b"JSON"
        self.json: dict[str, Any] = json.loads(data[20 : 20 + size])
        assert data[24 + size : 28 + size] == b"BIN\0"
        self.blob = data[28 + size :]

    def array(self, index: int) -> np.ndarray:
        accessor = self.json["accessors"][index]
        view = self.json["bufferViews"][accessor["bufferView"]]
        width = WIDTHS[accessor["type"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        values = np.frombuffer(self.blob, DTYPES[accessor["componentType"]], accessor["count"] * width, start)
        values = values.reshape(-1, width)
        np.testing.assert_array_equal(values.min(axis=0), np.array(accessor["min"], values.dtype))
        np.testing.assert_array_equal(values.max(axis=0), np.array(accessor["max"], values.dtype))
        return values


def hanging(ticks: int = 5) -> Motion:
    """Return a motion of a skeleton with hanging arms in the zero pose and a separate T-pose."""
    motion = reaching(ticks)
    tpose = np.tile(np.eye(3), (len(motion.skeleton.joints), 1, 1))
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        tpose[motion.skeleton.roles.index(f"{side}Arm")] = so3_exp([0.0, -sign * 1.5, 0.2])
    return replace(motion, skeleton=replace(motion.skeleton, tpose_rotation=tpose))


def on_the_floor(ticks: int = 20) -> Motion:
    """Return a motion with a root on the floor."""
    motion = reaching(ticks)
    body = motion.skeleton
    skeleton = replace(
        body,
        joints=("root", *body.joints),
        parents=np.array([-1, *(body.parents + 1)]),
        offsets_m=np.concatenate([np.zeros((1, 3)), body.offsets_m]),
        end_offsets_m=np.concatenate([np.full((1, 3), np.nan), body.end_offsets_m]),
        roles=("", *body.roles),
        bvh_channels=((), *body.bvh_channels),
    )
    still = np.broadcast_to(np.eye(3), (ticks, 1, 3, 3))
    return replace(
        motion,
        skeleton=skeleton,
        root_in_world_m=motion.root_in_world_m * [1.0, 1.0, 0.0],
        local_rotation=np.concatenate([still, motion.local_rotation], axis=1),
        observed=np.concatenate([motion.observed[:, :1], motion.observed], axis=1),
        hips_in_root_m=motion.root_in_world_m * [0.0, 0.0, 1.0],
    )


@pytest.mark.parametrize("motion", [reaching(20), hanging(), on_the_floor()], ids=["T", "hanging", "floor"])
def test_round_trip(tmp_path: Path, motion: Motion) -> None:
    write_glb(tmp_path / "a.glb", motion)
    back = read_glb(tmp_path / "a.glb")
    assert (back.skeleton.joints, back.skeleton.roles) == (motion.skeleton.joints, motion.skeleton.roles)
    assert (back.fps, back.start_ns) == (motion.fps, motion.start_ns)
    ours, theirs = motion.world_from_joint(), back.world_from_joint()
    np.testing.assert_allclose(theirs[..., :3, 3], ours[..., :3, 3], atol=POSITION_TOLERANCE_M)
    np.testing.assert_allclose(theirs[..., :3, :3], ours[..., :3, :3], atol=1e-6)
    np.testing.assert_allclose(rest_pose(back.skeleton), rest_pose(motion.skeleton), atol=1e-6)


@pytest.mark.parametrize("motion", [reaching(3), hanging(3)], ids=["T", "hanging"])
def test_the_place_on_the_earth_is_in_glb_and_usd_files(tmp_path: Path, motion: Motion) -> None:
    from pxr import Sdf
    from pygltflib import GLTF2

    from bodycap_batch.formats.usd import write_usd

    earth = {"latitude_deg": 48.1, "east_north_up_from_world": np.eye(4).tolist(), "fixes": 12}
    for name, place in (("with", earth), ("without", None)):
        write_glb(tmp_path / f"{name}.glb", motion, earth=place)
        write_usd(tmp_path / f"{name}.usda", motion, place)
        assert GLTF2().load(str(tmp_path / f"{name}.glb")).extras.get("earth") == place
        data = Sdf.Layer.FindOrOpen(str(tmp_path / f"{name}.usda")).customLayerData
        assert data.get("earth", {}).get("latitude_deg") == (None if place is None else 48.1)
    placed = Sdf.Layer.FindOrOpen(str(tmp_path / "with.usda")).customLayerData["earth"]
    np.testing.assert_allclose(placed["east_north_up_from_world"], np.eye(4).ravel())


@pytest.mark.parametrize("motion", [reaching(3), hanging(3)], ids=["T", "hanging"])
def test_the_skin_binds_every_joint_at_the_t_pose(tmp_path: Path, motion: Motion) -> None:
    write_glb(tmp_path / "a.glb", motion)
    parsed = Parsed(tmp_path / "a.glb")
    (skin,) = parsed.json["skins"]
    nodes = parsed.json["nodes"]
    assert [nodes[node]["name"] for node in skin["joints"]] == list(motion.skeleton.joints)
    inverse = parsed.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
    placed: dict[int, np.ndarray] = {}
    for node in skin["joints"]:
        parent = next((p for p in skin["joints"] if node in nodes[p].get("children", ())), None)
        x, y, z, w = nodes[node]["rotation"]
        local = np.eye(4)
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        local[:3, :3] = np.eye(3) + 2 * w * cross + 2 * cross @ cross
        local[:3, 3] = nodes[node]["translation"]
        placed[node] = local if parent is None else placed[parent] @ local
        np.testing.assert_allclose(inverse[node] @ placed[node], np.eye(4), atol=1e-6)
    by_role = dict(zip(motion.skeleton.roles, (placed[node][:3, 3] for node in skin["joints"]), strict=True))
    # Y is up, left is +X, toes point to +Z, metres; the arms are stretched out at the height of the shoulders
    assert 1.5 < by_role["Head"][1] < 1.7
    if motion.skeleton.tpose_rotation is None:
        assert by_role["LeftHand"][0] > 0.7 > -0.7 > by_role["RightHand"][0]
        assert abs(by_role["LeftHand"][1] - by_role["LeftArm"][1]) < 1e-6
    assert by_role["LeftToeBase"][2] > by_role["LeftFoot"][2] + 0.05


def test_every_vertex_follows_one_joint_or_two(tmp_path: Path) -> None:
    motion = reaching(3)
    write_glb(tmp_path / "a.glb", motion)
    parsed = Parsed(tmp_path / "a.glb")
    (primitive,) = parsed.json["meshes"][0]["primitives"]
    attributes = primitive["attributes"]
    weights, joints = (parsed.array(attributes[name]) for name in ("WEIGHTS_0", "JOINTS_0"))
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-6)
    assert (weights[:, 2:] == 0).all()
    # the specification wants joint 0 where the weight is 0
    assert (joints[weights == 0] == 0).all()
    # every joint has a bone: to its child, or to its end
    assert set(joints[weights > 0]) == set(range(len(motion.skeleton.joints)))
    normals = parsed.array(attributes["NORMAL"])
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)
    corners = parsed.array(attributes["POSITION"])
    faces = parsed.array(primitive["indices"]).reshape(-1, 3)
    # the volume is positive, so the faces are counter-clockwise from outside; parts overlap by a quarter
    volume = np.einsum("fi,fi->f", corners[faces[:, 0]], np.cross(corners[faces[:, 1]], corners[faces[:, 2]]))
    assert 0.05 < volume.sum() / 6 < 1.25 * 0.08
    # a small mesh
    assert len(corners) < 8000


def test_quaternions_never_jump_to_the_opposite_sign(tmp_path: Path) -> None:
    motion = reaching(200)
    turning = motion.local_rotation.copy()
    turning[:, 0] = so3_exp(np.linspace(0.0, 9.0, 200)[:, None] * [0.0, 0.0, 1.0])
    write_glb(tmp_path / "a.glb", replace(motion, local_rotation=turning))
    parsed = Parsed(tmp_path / "a.glb")
    (animation,) = parsed.json["animations"]
    assert {sampler["interpolation"] for sampler in animation["samplers"]} == {"LINEAR"}
    rotations = [c for c in animation["channels"] if c["target"]["path"] == "rotation"]
    assert len(rotations) == len(motion.skeleton.joints)
    for channel in rotations:
        quats = parsed.array(animation["samplers"][channel["sampler"]]["output"])
        assert ((quats[1:] * quats[:-1]).sum(axis=1) > 0.99).all()
        np.testing.assert_allclose(np.linalg.norm(quats, axis=1), 1.0, atol=1e-6)
    times = parsed.array(animation["samplers"][0]["input"])[:, 0]
    np.testing.assert_allclose(times, np.arange(200) / 30.0, atol=1e-6)


def test_a_still_body_without_length_is_written(tmp_path: Path) -> None:
    body = load_skeleton("upper_body")
    shrunk = replace(body, offsets_m=0.0 * body.offsets_m, end_offsets_m=0.0 * body.end_offsets_m)
    motion = replace(reaching(2), skeleton=shrunk)
    with pytest.raises(ValueError, match="no bone has a length"):
        write_glb(tmp_path / "a.glb", motion)


@pytest.mark.parametrize("content", [b"", b"glTF", b"nothing of the kind", b"glTF\2\0\0\0\x14\0\0\0"])
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.glb"
    path.write_bytes(content)
    with pytest.raises(JobError, match=r"GLB|skin"):
        read_glb(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(JobError, match="cannot be read"):
        read_glb(tmp_path / "a.glb")
