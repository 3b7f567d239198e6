"""Read GLB files that `write_glb` has written, or files with the same structure."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.errors import JobError
from bodycap_batch.formats.gltf.binary_buffer import read_accessor
from bodycap_batch.formats.y_up import WORLD_FROM_Y_UP, Y_UP_FROM_WORLD, in_other_axes
from bodycap_batch.model.geometry import rotation_from_quat_xyzw
from bodycap_batch.model.skeleton import Motion, SkeletonModel


def read_glb(path: Path | str) -> Motion:
    """Read the animated skeleton of a file that `write_glb` has written.

    The rest pose of the nodes becomes the T-pose of the skeleton. In the zero pose, all rotations are the
    identity. The far ends of bones and the BVH channels are missing, because the file does not contain them.

    Raises:
        JobError: The file is not a GLB file with exactly one skin and one animation.
    """
    import pygltflib as gl

    try:
        document = gl.GLTF2.load_binary(str(path))
        if document is None or len(document.skins) != 1 or len(document.animations) != 1:
            raise JobError(
                "the file does not contain exactly one skin and one animation",
                path=path,
                hint="give the motion.glb of a results folder",
            )
        return _read_motion(document, Path(path).stem)
    except (OSError, struct.error, ValueError, LookupError, TypeError, AttributeError) as error:
        raise JobError(
            f"the file cannot be read as GLB: {error}",
            path=path,
            hint="give the motion.glb of a results folder",
        ) from error


def _read_motion(document: Any, name: str) -> Motion:
    """Return the motion of a parsed file."""
    skin, animation = document.skins[0], document.animations[0]
    joint_of_node = {node: joint for joint, node in enumerate(skin.joints)}
    skeleton = _read_skeleton(document, name, joint_of_node)
    times = read_accessor(document, animation.samplers[0].input)[:, 0]
    shape = (len(times), len(joint_of_node))
    local = np.tile(np.eye(3), (*shape, 1, 1))
    position: dict[int, FloatArray] = {}
    for channel in animation.channels:
        values = read_accessor(document, animation.samplers[channel.sampler].output)
        joint = joint_of_node[channel.target.node]
        if channel.target.path == "rotation":
            local[:, joint] = in_other_axes(WORLD_FROM_Y_UP, rotation_from_quat_xyzw(values))
        else:
            position[joint] = values @ Y_UP_FROM_WORLD
    return Motion(
        skeleton=skeleton,
        fps=float(document.extras["fps"]),
        start_ns=round(float(document.extras["start_s"]) * 1e9),
        root_in_world_m=position[0],
        local_rotation=local,
        observed=np.ones(shape, dtype=bool),
        hips_in_root_m=position.get(1),
    )


def _read_skeleton(document: Any, name: str, joint_of_node: dict[int, int]) -> SkeletonModel:
    """Return the skeleton of a parsed file.

    Args:
        document: The parsed file.
        name: Name of the skeleton.
        joint_of_node: Index of the joint for each node. The keys are the indices of the nodes.
    """
    nodes = [document.nodes[node] for node in joint_of_node]
    parents = np.full(len(nodes), -1)
    for joint, node in enumerate(nodes):
        for child in node.children or ():
            parents[joint_of_node[child]] = joint
    offsets = np.array([node.translation for node in nodes]) @ Y_UP_FROM_WORLD
    rest = rotation_from_quat_xyzw([node.rotation for node in nodes])
    return SkeletonModel(
        name=name,
        joints=tuple(node.name for node in nodes),
        parents=parents,
        offsets_m=offsets,
        end_offsets_m=np.full((len(nodes), 3), np.nan),
        roles=tuple((node.extras or {}).get("role", "") for node in nodes),
        bvh_channels=((),) * len(nodes),
        tpose_rotation=in_other_axes(WORLD_FROM_Y_UP, rest),
    )
