"""Write GLB files. Blender, game engines and web viewers can read these files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bodycap_batch.core.arrays import FloatArray, json_numbers, true_spans
from bodycap_batch.formats.gltf.binary_buffer import (
    ARRAY_BUFFER,
    ELEMENT_ARRAY_BUFFER,
    UINT16,
    UINT32,
    BinaryBuffer,
)
from bodycap_batch.formats.mannequin import COLOUR_RGB, make_mannequin
from bodycap_batch.formats.y_up import Y_UP_FROM_WORLD, in_other_axes
from bodycap_batch.model.geometry import continuous_quat_xyzw, invert, make_transform, quat_xyzw_from_rotation
from bodycap_batch.model.measured_parts import JointSource, joint_sources
from bodycap_batch.model.skeleton import Motion, SkeletonModel, rest_pose
from bodycap_batch.model.take import Take

_MAX_SHORT_VERTICES = 65_535
"""Number of vertices below which an index fits into 16 bits. Source: glTF 2.0 specification, 3.7.2.1."""


def write_glb(
    path: Path | str,
    motion: Motion,
    *,
    file_from_up: FloatArray | None = None,
    earth: Mapping[str, Any] | None = None,
    take: Take | None = None,
    sigma_m: FloatArray | None = None,
) -> None:
    """Write a motion as a skinned, animated mannequin.

    The joints are nodes below a node ``Armature``. The mesh is bound to the joints in the T-pose. Every joint
    has a LINEAR rotation channel. The root also has a translation channel. If the hips move freely relative
    to the root, the hips have a translation channel too. The time of frame k is k / fps seconds.

    Args:
        path: Path of the file, which is replaced atomically.
        motion: The motion, in world axes and metres.
        file_from_up: (3,3) additional rotation of the whole scene; None for no rotation. It is needed if a
            converter, such as Blender, applies the inverse rotation to the scene.
        earth: Place of the world on the Earth as plain JSON values, for the extras of the file; None if it is
            unknown. Its transform starts from the world (z up), not from the axes of the file.
        take: Name, exact rate and timecode, for the extras of the file; None if they are unknown.
        sigma_m: (T,J) standard deviation per axis of each joint's centre, metres, for the extras of the
            joints; NaN if it is unknown. None leaves it out.

    Raises:
        StoreError: The file cannot be written.
    """
    import pygltflib as gl

    buffer = BinaryBuffer()
    turn = make_transform(np.eye(3) if file_from_up is None else file_from_up, np.zeros(3))
    body = _body_primitive(motion.skeleton, turn, buffer)
    name = "Motion" if take is None or not take.name else take.name
    animation = _motion_animation(motion, turn, buffer, name)
    rest = turn @ _poses_in_file_axes(rest_pose(motion.skeleton))
    binds = buffer.add(np.swapaxes(invert(rest), -1, -2).reshape(-1, 16), "MAT4")
    joints = len(motion.skeleton.joints)
    buffer.save(
        Path(path),
        scenes=[gl.Scene(nodes=[joints + 1])],
        nodes=[
            *_joint_nodes(motion, rest, sigma_m),
            gl.Node(name="Mannequin", mesh=0, skin=0),
            gl.Node(name="Armature", children=[0, joints]),
        ],
        skins=[gl.Skin(name="Armature", joints=list(range(joints)), skeleton=0, inverseBindMatrices=binds)],
        meshes=[gl.Mesh(name="Mannequin", primitives=[body])],
        materials=[
            gl.Material(
                name="Mannequin",
                pbrMetallicRoughness=gl.PbrMetallicRoughness(
                    baseColorFactor=[*COLOUR_RGB, 1.0], metallicFactor=0.0, roughnessFactor=0.7
                ),
            )
        ],
        animations=[animation],
        extras={
            "fps": motion.fps,
            "start_s": motion.start_ns / 1e9,
            **({} if take is None else take.figures()),
            **({} if earth is None else {"earth": dict(earth)}),
        },
    )


def _poses_in_file_axes(world_from_joint: FloatArray) -> FloatArray:
    """Convert poses (...,4,4) from world axes to file axes. The axes of the joint are converted too."""
    rotation = in_other_axes(Y_UP_FROM_WORLD, world_from_joint[..., :3, :3])
    return make_transform(rotation, world_from_joint[..., :3, 3] @ Y_UP_FROM_WORLD.T)


def _joint_nodes(motion: Motion, rest: FloatArray, sigma_m: FloatArray | None) -> list[Any]:
    """Return one node per joint, in the T-pose.

    Args:
        motion: The motion, with J joints.
        rest: (J,4,4) joint poses in the T-pose, in file axes.
        sigma_m: (T,J) standard deviation of each joint's centre, metres; None if it is unknown.
    """
    import pygltflib as gl

    skeleton = motion.skeleton
    parents = skeleton.parents.tolist()
    local = np.array([rest[j] if p < 0 else invert(rest[p]) @ rest[j] for j, p in enumerate(parents)])
    quats = quat_xyzw_from_rotation(local[:, :3, :3])
    return [
        gl.Node(
            name=name,
            translation=local[joint, :3, 3].tolist(),
            rotation=quats[joint].tolist(),
            children=[child for child, parent in enumerate(parents) if parent == joint],
            extras=_properties(motion, joint, None if sigma_m is None else sigma_m[:, joint]),
        )
        for joint, name in enumerate(skeleton.joints)
    ]


def _properties(motion: Motion, joint: int, sigma_m: FloatArray | None) -> dict[str, Any]:
    """Return the custom properties of a joint.

    They are its role, ``motion_source`` (measured or filled), ``observed: false`` if it was never measured,
    and, with a standard deviation, the first and the last frame of each span in which it was measured, and
    the standard deviation of each frame.
    """
    role = motion.skeleton.roles[joint]
    out: dict[str, Any] = {"role": role} if role else {}
    source = joint_sources(motion)[joint]
    out["motion_source"] = source.value
    if source is JointSource.FILLED:
        out["observed"] = False
    elif sigma_m is not None:
        out["measured_frames"] = true_spans(motion.observed[:, joint])
        out["sigma_m"] = json_numbers(sigma_m, 5)
    return out


def _body_primitive(skeleton: SkeletonModel, turn: FloatArray, buffer: BinaryBuffer) -> Any:
    """Return the mannequin as a primitive. Each vertex is bound to one joint or two.

    Args:
        skeleton: The skeleton.
        turn: (4,4) rotation of the whole scene.
        buffer: The buffer to which the arrays are appended.
    """
    import pygltflib as gl

    body = make_mannequin(skeleton)
    axes = (turn[:3, :3] @ Y_UP_FROM_WORLD).T
    joints, weights = np.zeros((2, len(body.vertices_m), 4))
    weights[:, :2] = body.weights
    joints[:, :2] = np.where(body.weights > 0.0, body.joints, 0)  # the joint of a zero weight must be 0
    attributes = gl.Attributes(
        POSITION=buffer.add(body.vertices_m @ axes, "VEC3", target=ARRAY_BUFFER),
        NORMAL=buffer.add(body.normals @ axes, "VEC3", target=ARRAY_BUFFER),
        JOINTS_0=buffer.add(joints, "VEC4", target=ARRAY_BUFFER, component=UINT16),
        WEIGHTS_0=buffer.add(weights, "VEC4", target=ARRAY_BUFFER),
    )
    small = len(body.vertices_m) < _MAX_SHORT_VERTICES
    faces = buffer.add(
        body.faces.reshape(-1),
        "SCALAR",
        target=ELEMENT_ARRAY_BUFFER,
        component=UINT16 if small else UINT32,
    )
    return gl.Primitive(attributes=attributes, indices=faces, material=0)


def _motion_animation(motion: Motion, turn: FloatArray, buffer: BinaryBuffer, name: str) -> Any:
    """Return the animation: rotations of all joints, translations of the root and of freely moving hips.

    Args:
        motion: The motion.
        turn: (4,4) rotation of the whole scene.
        buffer: The buffer to which the arrays are appended.
        name: Name of the animation.
    """
    local = make_transform(motion.local_rotation, motion.local_position_m())
    local = _poses_in_file_axes(local)
    local[:, 0] = turn @ local[:, 0]
    quats, position = continuous_quat_xyzw(local[..., :3, :3]), local[..., :3, 3]
    curves = [(joint, "rotation", quats[:, joint]) for joint in range(quats.shape[1])]
    translated = range(1 if motion.hips_in_root_m is None else 2)
    curves += [(joint, "translation", position[:, joint]) for joint in translated]
    return buffer.animation(name, motion.fps, curves)
