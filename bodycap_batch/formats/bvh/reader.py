"""Read BVH files.

The skeleton and the order of the channels are arbitrary. Tabs, CRLF line ends and irregular spaces are
accepted.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.formats.bvh.axes import world_from_file_points, world_from_file_rotations
from bodycap_batch.formats.bvh.euler import rotation_from_angles
from bodycap_batch.formats.bvh.parser import FileJoint, parse_bvh
from bodycap_batch.formats.bvh.roles import assign_roles
from bodycap_batch.model.skeleton import Motion, SkeletonModel

logger = logging.getLogger(__name__)

_MAX_METRE_EXTENT = 10.0
"""Limit for the extent of the zero pose, file units. If the extent is smaller, the file is in metres;
otherwise it is in centimetres. Derivation: the extent of a body is 1 to 2 m, which is 100 to 200 cm."""

_MOTION_THRESHOLD = 1e-3
"""A joint whose position relative to its parent changes by less than this threshold is treated as not moving.
Unit: file unit. Derivation: the threshold is 10 µm for a file in centimetres. This is larger than the
rounding error of numbers with the usual six decimals."""

_WARNING_THRESHOLD = 1.0
"""If the position of a joint relative to its parent changes by more than this threshold, a warning is logged.
Unit: file unit. Derivation: the threshold is 1 cm for a file in centimetres; such a change is visible."""


def read_bvh(path: Path | str, *, units: str = "auto") -> tuple[SkeletonModel, Motion | None]:
    """Read a BVH file and convert it to world axes and metres.

    Position channels replace the OFFSET, as in Blender and MotionBuilder:

    - Root: the position channels give the motion of the root.
    - Hips, if they are the first child of the root: the position channels give the motion of the hips
      relative to the root.
    - Any other joint: constant position channels give the offset of the joint. Position channels that change
      are ignored, and the OFFSET is used.

    Args:
        path: Path of the file.
        units: Unit of length of the file: "cm", "m", or "auto". With "auto", the unit is the metre if the
            extent of the zero pose is smaller than 10 units. Otherwise it is the centimetre.

    Returns:
        The skeleton, and its motion. The motion is None if the file has no frames. `Motion.start_ns` is 0,
        and every joint is marked as observed.

    Raises:
        JobError: The file is missing or malformed. The error names the line.
    """
    path = Path(path)
    text = parse_bvh(path)
    joints, values = text.joints, text.values
    offsets = np.array([joint.offset for joint in joints])
    if values is not None:
        offsets = _offsets_from_channels(path, joints, offsets, values)
    units = _detect_units(joints, offsets) if units == "auto" else units
    skeleton = _skeleton(path.stem, joints, offsets, units)
    if values is None:
        return skeleton, None
    columns = _channel_slices(joints)
    root = world_from_file_points(_positions(joints[0], values[:, columns[0]], offsets[0]), units)
    hips = None
    if _have_hips_own_translation(joints, values):
        hips = world_from_file_points(_positions(joints[1], values[:, columns[1]], offsets[1]), units)
    return skeleton, Motion(
        skeleton=skeleton,
        fps=rate_from_frame_time(text.frame_time),
        start_ns=0,
        root_in_world_m=root,
        local_rotation=world_from_file_rotations(_rotations(joints, values)),
        observed=np.ones((len(values), len(joints)), dtype=bool),
        hips_in_root_m=hips,
    )


def rate_from_frame_time(frame_time: str) -> float:
    """Return the frame rate, frames per second, for a Frame Time.

    If the Frame Time is a rounded value, the nominal frame rate is returned. For example, 0.033333 means
    30 Hz and not 30.0003 Hz. Without this correction, the times would be wrong by 0.04 s after one hour.

    Args:
        frame_time: Value of the Frame Time as text, seconds.
    """
    seconds = float(frame_time.replace(",", "."))
    if seconds == 0:
        return 30.0  # the file has a single pose, whose rate is not used
    mantissa = frame_time.lower().partition("e")[0].replace(",", ".")
    digits = len(mantissa.replace(".", "").lstrip("+-0"))
    resolution = 10.0 ** -len(mantissa.partition(".")[2])
    for nominal in (float(round(1 / seconds)), round(1.001 / seconds) * 1000.0 / 1001.0):
        if "e" in frame_time.lower() or digits < 3 or nominal <= 0:
            break
        if abs(1.0 / nominal - seconds) <= resolution and abs(nominal * seconds - 1.0) < 2e-3:
            return nominal
    return 1.0 / seconds


def _channel_slices(joints: list[FileJoint]) -> list[slice]:
    """Return, for each joint, the slice of a frame's values that belongs to the channels of the joint."""
    ends = np.cumsum([len(joint.channels) for joint in joints]).tolist()
    return [slice(end - len(joint.channels), end) for end, joint in zip(ends, joints, strict=True)]


def _have_hips_own_translation(joints: list[FileJoint], values: FloatArray) -> bool:
    """Return True if the first child of the root is the hips, and the position of the hips changes."""
    parents = [joint.parent for joint in joints]
    if len(joints) < 2 or assign_roles([joint.name for joint in joints], parents)[:2] != ("", "Hips"):
        return False
    moving = [name.endswith("position") for name in joints[1].channels]
    return any(moving) and bool(
        np.ptp(values[:, _channel_slices(joints)[1]][:, moving], axis=0).max() > _MOTION_THRESHOLD
    )


def _offsets_from_channels(
    path: Path, joints: list[FileJoint], offsets: FloatArray, values: FloatArray
) -> FloatArray:
    """Replace the offsets of joints whose position channels are constant and not zero.

    Args:
        path: Path of the file, for warnings.
        joints: The joints of the file.
        offsets: (J,3) OFFSET of each joint, in file axes and units.
        values: (T, channels) values of all frames.

    Returns:
        The offsets (J,3), in file axes and units.
    """
    out = offsets.copy()
    for index, (joint, columns) in enumerate(zip(joints, _channel_slices(joints), strict=True)):
        if index == 0 or not any(name.endswith("position") for name in joint.channels):
            continue
        if index == 1 and _have_hips_own_translation(joints, values):
            continue
        positions = _positions(joint, values[:, columns], offsets[index])
        spread = float(np.ptp(positions, axis=0).max())
        if spread > _WARNING_THRESHOLD:
            logger.warning(
                "%s: the position of joint %s relative to its parent changes by %.3g units in the motion; "
                "the joint's OFFSET is used instead",
                path,
                joint.name,
                spread,
            )
        if (
            spread < _MOTION_THRESHOLD
            and positions.any()
            and not np.allclose(positions[0], offsets[index], atol=1e-3)
        ):
            out[index] = positions[0]
    return out


def _positions(joint: FileJoint, values: FloatArray, offset: FloatArray) -> FloatArray:
    """Return the positions (T,3) of a joint relative to its parent, in file axes and units.

    A coordinate without a position channel is taken from the OFFSET.
    """
    out = np.tile(offset, (len(values), 1))
    for column, name in enumerate(joint.channels):
        if name.endswith("position"):
            out[:, "XYZ".index(name[0])] = values[:, column]
    return out


def _rotations(joints: list[FileJoint], values: FloatArray) -> FloatArray:
    """Return the local rotations (T,J,3,3) of all joints in file axes."""
    out = np.empty((len(values), len(joints), 3, 3))
    for index, (joint, columns) in enumerate(zip(joints, _channel_slices(joints), strict=True)):
        rotating = [i for i, name in enumerate(joint.channels) if name.endswith("rotation")]
        axes = "".join(joint.channels[i][0] for i in rotating)
        out[:, index] = rotation_from_angles(axes, np.deg2rad(values[:, columns][:, rotating]))
    return out


def _detect_units(joints: list[FileJoint], offsets: FloatArray) -> str:
    """Return the unit of length, "m" or "cm", that fits the extent of the zero pose with offsets (J,3)."""
    centres = np.zeros_like(offsets)
    for index, joint in enumerate(joints[1:], start=1):
        centres[index] = centres[joint.parent] + offsets[index]
    extent = float(np.ptp(centres, axis=0).max())
    return "m" if 0.0 < extent < _MAX_METRE_EXTENT else "cm"


def _skeleton(name: str, joints: list[FileJoint], offsets: FloatArray, units: str) -> SkeletonModel:
    """Return the skeleton with these joints and offsets (J,3), which are in file axes and units."""
    ends = np.full((len(joints), 3), np.nan)
    for index, joint in enumerate(joints):
        if joint.children == 0:
            ends[index] = 0.0 if joint.end is None else joint.end
    names = tuple(joint.name for joint in joints)
    parents = [joint.parent for joint in joints]
    offsets_m = world_from_file_points(offsets, units)
    return SkeletonModel(
        name=name,
        joints=names,
        parents=np.array(parents),
        offsets_m=offsets_m,
        end_offsets_m=world_from_file_points(ends, units),
        roles=assign_roles(names, parents, offsets_m),
        bvh_channels=tuple(joint.channels for joint in joints),
    )
