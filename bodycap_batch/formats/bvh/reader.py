"""Reading BVH files as they are met: any rig, any channel order, tabs, CRLF, odd spacing."""

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
"""A body's zero pose spans 100-200 cm or 1-2 m: a file below this many units is in metres."""

_MOTION_THRESHOLD = 1e-3
"""Joint translation, in file units, below which a joint holds still."""

_WARNING_THRESHOLD = 1.0
"""Joint translation, in file units, that is worth a warning."""


def read_bvh(path: Path | str, *, units: str = "auto") -> tuple[SkeletonModel, Motion | None]:
    """Read a BVH file into world axes and metres.

    Position channels are absolute, as Blender and MotionBuilder take them (they replace the OFFSET).
    Only the root travels, and hips that are its first child: where other joints have position channels that
    hold still, they are the bone; where they change, the OFFSET is kept.

    Args:
        path: The file.
        units: "cm", "m", or "auto" (centimetres unless the whole zero pose spans less than 10 units).

    Returns:
        The skeleton, and its motion or None when the file holds no frames. `Motion.start_ns` is 0 and
        every joint counts as observed.

    Raises:
        JobError: The file is missing or malformed; names the line.
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
    """Frames per second; a rounded Frame Time is taken for the nominal rate it stands for.

    0.0333333 means 30 Hz, not 30.00003: over an hour that is 0.1 s.
    """
    seconds = float(frame_time.replace(",", "."))
    if seconds == 0:
        return 30.0  # a single pose: the rate has no meaning
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
    """Where each joint's channels stand in a frame."""
    ends = np.cumsum([len(joint.channels) for joint in joints]).tolist()
    return [slice(end - len(joint.channels), end) for end, joint in zip(ends, joints, strict=True)]


def _have_hips_own_translation(joints: list[FileJoint], values: FloatArray) -> bool:
    """True where the root carries hips with a moving position of their own."""
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
    """Bones (J,3), taken from position channels that hold one value other than zero."""
    out = offsets.copy()
    for index, (joint, columns) in enumerate(zip(joints, _channel_slices(joints), strict=True)):
        if index == 0 or not any(name.endswith("position") for name in joint.channels):
            continue
        if index == 1 and _have_hips_own_translation(joints, values):
            continue
        positions = _positions(joint, values[:, columns], offsets[index])
        spread = float(np.ptp(positions, axis=0).max())
        if spread > _WARNING_THRESHOLD:
            logger.warning("%s: joint %s stretches by %.3g; its OFFSET is kept", path, joint.name, spread)
        if (
            spread < _MOTION_THRESHOLD
            and positions.any()
            and not np.allclose(positions[0], offsets[index], atol=1e-3)
        ):
            out[index] = positions[0]
    return out


def _positions(joint: FileJoint, values: FloatArray, offset: FloatArray) -> FloatArray:
    """Position (T,3) in file axes and units: the channels where there are any, else the OFFSET."""
    out = np.tile(offset, (len(values), 1))
    for column, name in enumerate(joint.channels):
        if name.endswith("position"):
            out[:, "XYZ".index(name[0])] = values[:, column]
    return out


def _rotations(joints: list[FileJoint], values: FloatArray) -> FloatArray:
    """Local rotations (T,J,3,3) in file axes."""
    out = np.empty((len(values), len(joints), 3, 3))
    for index, (joint, columns) in enumerate(zip(joints, _channel_slices(joints), strict=True)):
        turning = [i for i, name in enumerate(joint.channels) if name.endswith("rotation")]
        axes = "".join(joint.channels[i][0] for i in turning)
        out[:, index] = rotation_from_angles(axes, np.deg2rad(values[:, columns][:, turning]))
    return out


def _detect_units(joints: list[FileJoint], offsets: FloatArray) -> str:
    """Tell metres from centimetres by the size of the zero pose."""
    placed = np.zeros_like(offsets)
    for index, joint in enumerate(joints[1:], start=1):
        placed[index] = placed[joint.parent] + offsets[index]
    extent = float(np.ptp(placed, axis=0).max())
    return "m" if 0.0 < extent < _MAX_METRE_EXTENT else "cm"


def _skeleton(name: str, joints: list[FileJoint], offsets: FloatArray, units: str) -> SkeletonModel:
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
