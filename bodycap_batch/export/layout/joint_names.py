"""Change joint names and the number of spine joints to match a common animation skeleton."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from importlib import resources
from typing import Any

import numpy as np
import yaml

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.core.unique_names import unique_name
from bodycap_batch.model.geometry import quat_xyzw_from_rotation, so3_exp
from bodycap_batch.model.skeleton import Motion, SkeletonModel
from bodycap_batch.model.skeleton_presets import split_side


@cache
def naming_preset(preset: str) -> dict[str, Any]:
    """Return the settings of a naming preset from ``names.yaml``."""
    text = resources.files("bodycap_batch.presets").joinpath("names.yaml").read_text(encoding="utf-8")
    return dict(yaml.safe_load(text)[preset])


def rename_joints(motion: Motion, preset: str) -> Motion:
    """Return the motion with the joint names, spine joints and neck joints of a naming preset.

    Added joints divide a bone into equal parts. They rotate only about this bone. The twist of the joint at
    the bone's end is divided equally among the added joints and this joint. Therefore no existing joint moves
    or rotates in the world.

    Args:
        motion: The motion.
        preset: Name of the naming preset.
    """
    chosen = naming_preset(preset)
    prefix, spine, neck = chosen.get("prefix", ""), chosen["spine"], chosen["neck"]
    joints = tuple(
        _name_of_role(role, chosen) if role else prefix + name
        for name, role in zip(motion.skeleton.joints, motion.skeleton.roles, strict=True)
    )
    motion = replace(motion, skeleton=replace(motion.skeleton, joints=joints))
    motion = _insert_joints(motion, "Spine", "Spine1", [prefix + name for name in spine[1:-1]])
    return _insert_joints(motion, "Neck", "Head", [prefix + name for name in neck[1:]])


def rename_roles(motion: Motion, preset: str) -> Motion:
    """Return the motion with the joint names of a naming preset for all joints that have a role.

    Joints without a role keep their names; a number is appended to a name that another joint has now. No
    joints are added. This suits a skeleton of the user, whose hierarchy must stay.

    Args:
        motion: The motion.
        preset: Name of the naming preset.
    """
    chosen = naming_preset(preset)
    skeleton = motion.skeleton
    used = {_name_of_role(role, chosen) for role in skeleton.roles if role}
    joints: list[str] = []
    for name, role in zip(skeleton.joints, skeleton.roles, strict=True):
        joints.append(_name_of_role(role, chosen) if role else unique_name(name, used))
        used.add(joints[-1])
    return replace(motion, skeleton=replace(skeleton, joints=tuple(joints)))


def _name_of_role(role: str, chosen: dict[str, Any]) -> str:
    """Return the name of the joint with a role, with the preset's prefix.

    Args:
        role: The role of the joint.
        chosen: The settings of the naming preset.
    """
    trunk = {"Spine": chosen["spine"][0], "Spine1": chosen["spine"][-1], "Neck": chosen["neck"][0]}
    side, part = split_side(role)
    name = trunk.get(role) or chosen.get("names", {}).get(part, part)
    sided = f"{name}{chosen['sides'][side]}" if side and "sides" in chosen else f"{side}{name}"
    return str(chosen.get("prefix", "")) + sided


def _insert_joints(motion: Motion, lower: str, upper: str, names: list[str]) -> Motion:
    """Return the motion with new joints on the bone between a parent joint and a child joint.

    The motion is returned unchanged if one of the joints does not exist, or if they are not parent and child.

    Args:
        motion: The motion.
        lower: Role of the parent joint.
        upper: Role of the child joint.
        names: Names of the new joints, in the order from the parent to the child.
    """
    skeleton = motion.skeleton
    start, end = skeleton.index_of_role(lower), skeleton.index_of_role(upper)
    if not names or start is None or end is None or skeleton.parents[end] != start:
        return motion
    parts = len(names) + 1
    bone = skeleton.offsets_m[end]
    partial_twist = so3_exp(
        _twist_rad(motion.local_rotation[:, end], bone)[:, None] / parts * _unit_vector(bone)
    )
    untwist = np.linalg.matrix_power(np.swapaxes(partial_twist, -1, -2), parts - 1)
    local = motion.local_rotation.copy()
    local[:, end] = untwist @ local[:, end]
    added = np.repeat(partial_twist[:, None], len(names), axis=1)
    observed = np.repeat(motion.observed[:, end, None], len(names), axis=1)
    return replace(
        motion,
        skeleton=_skeleton_with_joints(skeleton, end, names),
        local_rotation=np.concatenate([local[:, :end], added, local[:, end:]], axis=1),
        observed=np.concatenate([motion.observed[:, :end], observed, motion.observed[:, end:]], axis=1),
    )


def _skeleton_with_joints(skeleton: SkeletonModel, end: int, names: list[str]) -> SkeletonModel:
    """Return the skeleton with new, evenly spaced joints on the bone that ends at the joint `end`.

    Args:
        skeleton: The skeleton without the new joints.
        end: Index of the joint at the bone's end.
        names: Names of the new joints, in the order from the parent to the joint `end`.
    """
    count = len(names)
    shifted = np.where(skeleton.parents >= end, skeleton.parents + count, skeleton.parents)
    chain = [int(skeleton.parents[end]), *range(end, end + count)]
    shifted[end] = chain[-1]
    bones = np.array(skeleton.offsets_m)
    bones[end] /= count + 1
    parents = np.concatenate([shifted[:end], chain[:-1], shifted[end:]])
    return insert_joints(skeleton, end, names, parents, np.insert(bones, [end] * count, bones[end], axis=0))


def insert_joints(
    skeleton: SkeletonModel, at: int, names: Sequence[str], parents: IntArray, offsets_m: FloatArray
) -> SkeletonModel:
    """Return the skeleton with new joints, which have no role, no end and no rotation in the T-pose.

    Args:
        skeleton: The skeleton with J joints.
        at: Index of the first new joint.
        names: (K,) names of the new joints.
        parents: (J+K,) index of the parent of each joint.
        offsets_m: (J+K,3) joint centres in the frames of the parents, metres.
    """
    places, tpose = [at] * len(names), skeleton.tpose_rotation
    return SkeletonModel(
        name=skeleton.name,
        joints=(*skeleton.joints[:at], *names, *skeleton.joints[at:]),
        parents=parents,
        offsets_m=offsets_m,
        end_offsets_m=np.insert(skeleton.end_offsets_m, places, np.nan, axis=0),
        roles=(*skeleton.roles[:at], *("" for _ in names), *skeleton.roles[at:]),
        bvh_channels=(*skeleton.bvh_channels[:at], *(() for _ in names), *skeleton.bvh_channels[at:]),
        tpose_rotation=None if tpose is None else np.insert(tpose, places, np.eye(3), axis=0),
    )


def _twist_rad(rotation: FloatArray, axis: FloatArray) -> FloatArray:
    """Return the twist angle (T,) of rotations (T,3,3) about an axis (3,), continuous over time.

    Source: swing-twist decomposition of a quaternion.
    """
    quat = quat_xyzw_from_rotation(rotation)
    half = np.arctan2(quat[:, :3] @ _unit_vector(axis), quat[:, 3])
    return np.asarray(np.unwrap(2.0 * half))


def _unit_vector(vector: FloatArray) -> FloatArray:
    """Return the unit vector of a vector (3,); the zero vector is returned unchanged."""
    return np.asarray(vector / (np.linalg.norm(vector) or 1.0))
