"""Write BVH files. Blender, MotionBuilder and retargeting tools can read these files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.formats.atomic_files import atomic_replacement
from bodycap_batch.formats.bvh.axes import file_from_world_points
from bodycap_batch.formats.bvh.euler import continuous_angles
from bodycap_batch.formats.y_up import Y_UP_FROM_WORLD, in_other_axes
from bodycap_batch.model.skeleton import Motion, SkeletonModel

_POSITION_CHANNELS = ("Xposition", "Yposition", "Zposition")


def write_bvh(path: Path | str, motion: Motion, *, units: str = "cm", euler_order: str = "ZXY") -> None:
    """Write a motion as a BVH file.

    A skeleton that was read from a BVH file keeps the hierarchy, the OFFSETs and the channel order of that
    file. If the channels of a joint do not permit every rotation, the missing rotation channels are appended.
    The root always has position channels.

    Args:
        path: Path of the file, which is replaced atomically.
        motion: The motion, in world axes and metres.
        units: Unit of length of the file, "cm" or "m".
        euler_order: Order of the rotation channels for joints whose channels are not given by the skeleton.

    Raises:
        StoreError: The file cannot be written.
    """
    skeleton = motion.skeleton
    channels = _joint_channels(skeleton, euler_order, 1 if motion.hips_in_root_m is None else 2)
    order = _depth_first_order(skeleton)
    values = _frame_values(motion, channels, order, units)
    row = " ".join(["%.6f" if units == "cm" else "%.8f"] * values.shape[1]) + "\n"
    with (
        atomic_replacement(Path(path)) as temporary,
        open(temporary, "w", encoding="utf-8", newline="\n") as handle,
    ):
        handle.write("HIERARCHY\n")
        handle.writelines(_hierarchy_lines(motion, channels, order, units))
        handle.write(f"MOTION\nFrames: {len(values)}\nFrame Time: {1.0 / motion.fps:.10f}\n")
        handle.writelines(row % tuple(frame) for frame in values)


def _depth_first_order(skeleton: SkeletonModel) -> list[int]:
    """Return the joint indices in the order of the file: all descendants of a joint follow the joint."""
    children: list[list[int]] = [[] for _ in skeleton.joints]
    for joint, parent in enumerate(skeleton.parents.tolist()[1:], start=1):
        children[parent].append(joint)
    order, waiting = [], [0]
    while waiting:
        order.append(waiting.pop())
        waiting.extend(reversed(children[order[-1]]))
    return order


def _joint_channels(skeleton: SkeletonModel, euler_order: str, position_count: int) -> list[tuple[str, ...]]:
    """Return the channel names of each joint. The first `position_count` joints get position channels."""
    out = []
    for index, channels in enumerate(skeleton.bvh_channels):
        names = channels or tuple(f"{axis}rotation" for axis in euler_order)
        positions = tuple(name for name in names if name.endswith("position"))
        rotations = tuple(name for name in names if name.endswith("rotation"))
        if len(set(rotations)) != 3 or len(rotations) != 3:
            unique = tuple(dict.fromkeys(rotations))
            rotations = unique + tuple(f"{axis}rotation" for axis in "ZXY" if f"{axis}rotation" not in unique)
            names = positions + rotations
        if index < position_count and len(positions) != 3:
            names = _POSITION_CHANNELS + rotations
        out.append(names)
    return out


def _frame_values(
    motion: Motion, channels: list[tuple[str, ...]], order: list[int], units: str
) -> FloatArray:
    """Return the values (T, channels) of all frames, in file axes and units. Angles are in degrees.

    Args:
        motion: The motion.
        channels: (J,) channel names of each joint.
        order: (J,) joint indices in the order of the file.
        units: Unit of length of the file.
    """
    orders = tuple("".join(name[0] for name in names if name.endswith("rotation")) for names in channels)
    rotation = in_other_axes(Y_UP_FROM_WORLD, motion.local_rotation)
    angles = np.rad2deg(continuous_angles(orders, rotation))
    position = file_from_world_points(motion.local_position_m(), units)
    columns = []
    for joint in order:
        for name in channels[joint]:
            if name.endswith("rotation"):
                columns.append(angles[:, joint, orders[joint].index(name[0])])
            else:
                columns.append(position[:, joint, "XYZ".index(name[0])])
    return np.stack(columns, axis=1) + 0.0


def _hierarchy_lines(
    motion: Motion, channels: list[tuple[str, ...]], order: list[int], units: str
) -> list[str]:
    """Return the lines of the joints in the HIERARCHY block."""
    skeleton = motion.skeleton
    offsets = file_from_world_points(skeleton.offsets_m, units)
    ends = file_from_world_points(np.nan_to_num(skeleton.end_offsets_m), units)
    if not any(skeleton.bvh_channels):
        offsets[0] = (
            0.0  # with OFFSET zero, readers that add it to the position agree with readers that ignore it
        )
    if motion.hips_in_root_m is not None:
        offsets[1] = 0.0
    has_child = set(skeleton.parents.tolist())
    lines: list[str] = []
    open_joints: list[int] = []

    def close() -> None:
        open_joints.pop()
        lines.append("\t" * len(open_joints) + "}\n")

    for joint in order:
        while open_joints and open_joints[-1] != skeleton.parents[joint]:
            close()
        tabs = "\t" * len(open_joints)
        lines.append(f"{tabs}{'JOINT' if open_joints else 'ROOT'} {skeleton.joints[joint]}\n{tabs}{{\n")
        lines.append(f"{tabs}\tOFFSET {_format_vector(offsets[joint])}\n")
        lines.append(f"{tabs}\tCHANNELS {len(channels[joint])} {' '.join(channels[joint])}\n")
        open_joints.append(joint)
        if joint not in has_child:
            lines.append(
                f"{tabs}\tEnd Site\n{tabs}\t{{\n{tabs}\t\tOFFSET {_format_vector(ends[joint])}\n{tabs}\t}}\n"
            )
    while open_joints:
        close()
    return lines


def _format_vector(vector: FloatArray) -> str:
    """Return three lengths as text, each with six to twelve decimals. Zero has no minus sign."""
    return " ".join(_format_length(float(value)) for value in vector)


def _format_length(value: float) -> str:
    """Return a length as text with six to twelve decimals."""
    text = f"{round(value, 12) + 0.0:.12f}".rstrip("0")
    whole, _, decimals = text.partition(".")
    return f"{whole}.{decimals:0<6}"
