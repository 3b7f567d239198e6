"""Read BVH files.

The skeleton and the order of the channels are arbitrary. Tabs, CRLF line ends and irregular spaces are
accepted.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.formats.bvh.axes import UNITS_PER_METRE, world_from_file_points
from bodycap_batch.formats.bvh.euler import rotation_from_angles
from bodycap_batch.formats.bvh.parser import FileJoint, parse_bvh
from bodycap_batch.formats.bvh.roles import assign_roles
from bodycap_batch.formats.y_up import WORLD_FROM_Y_UP, in_other_axes
from bodycap_batch.model.skeleton import Motion, SkeletonModel
from bodycap_batch.model.skeleton_presets import rest_positions, stature_from_limbs

_MAX_METRE_STATURE = 10.0
"""Limit for the stature of the body, file units. If the stature is smaller, the file is in metres; otherwise
it is in centimetres. Derivation: the stature of a person is 1 to 2 m, which is 100 to 200 cm."""

_MOTION_THRESHOLD = 1e-3
"""A joint whose position relative to its parent changes by less than this threshold is treated as not moving.
Unit: file unit. Derivation: the threshold is 10 µm for a file in centimetres. This is larger than the
rounding error of numbers with the usual six decimals."""

_MAX_NOISE_RATIO = 0.1
"""Maximum standard deviation of a joint's position relative to its parent, as a part of its mean distance,
for a bone of constant length. Derivation: noise of recordings is below 1 %; a joint that travels has more."""

_WARNING_THRESHOLD = 1.0
"""If the position of a joint relative to its parent changes by more than this threshold, the user is warned.
Unit: file unit. Derivation: the threshold is 1 cm for a file in centimetres; such a change is visible."""


def read_bvh(path: Path | str, *, units: str = "auto") -> tuple[SkeletonModel, Motion | None]:
    """Read a BVH file and convert it to world axes and metres.

    Position channels replace the OFFSET, as in Blender and MotionBuilder:

    - Root: the position channels give the motion of the root.
    - Hips, if they are the first child of the root: the position channels give the motion of the hips
      relative to the root.
    - Any other joint: the mean of position channels that are constant except for noise gives the offset of
      the joint. If the position channels change more, the OFFSET is used; the mean if the OFFSET is zero and
      the joint is below the hips.

    Args:
        path: Path of the file.
        units: Unit of length of the file: "cm", "m", or "auto". With "auto", the unit is the metre if the
            stature of the body is smaller than 10 units (the extent of the zero pose if there are no limbs).
            Otherwise it is the centimetre.

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
    notes: list[str] = []
    warnings: list[str] = []
    if values is not None:
        offsets, notes, warnings = _offsets_from_channels(joints, offsets, values)
    skeleton = _skeleton(path.stem, joints, offsets)
    units = _detect_units(skeleton) if units == "auto" else units
    skeleton = replace(
        skeleton,
        offsets_m=skeleton.offsets_m / UNITS_PER_METRE[units],
        end_offsets_m=skeleton.end_offsets_m / UNITS_PER_METRE[units],
        notes=tuple(notes),
        warnings=tuple(warnings),
    )
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
        local_rotation=in_other_axes(WORLD_FROM_Y_UP, _rotations(joints, values)),
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
    if len(joints) < 2 or _roles(joints)[:2] != ("", "Hips"):
        return False
    moving = [name.endswith("position") for name in joints[1].channels]
    return any(moving) and bool(
        np.ptp(values[:, _channel_slices(joints)[1]][:, moving], axis=0).max() > _MOTION_THRESHOLD
    )


def _roles(joints: list[FileJoint]) -> tuple[str, ...]:
    """Return the roles of joints by their names alone."""
    return assign_roles([joint.name for joint in joints], [joint.parent for joint in joints])


def _offsets_from_channels(
    joints: list[FileJoint], offsets: FloatArray, values: FloatArray
) -> tuple[FloatArray, list[str], list[str]]:
    """Replace the offsets of joints whose position channels give the lengths of bones.

    Args:
        joints: The joints of the file.
        offsets: (J,3) OFFSET of each joint, in file axes and units.
        values: (T, channels) values of all frames.

    Returns:
        The offsets (J,3), in file axes and units, notes about them, and warnings.
    """
    out, replaced, moving = offsets.copy(), [], []
    placed = [index for index, joint in enumerate(joints) if index and _has_position(joint)]
    roles = _roles(joints) if placed else ()
    hips = roles.index("Hips") if "Hips" in roles else 0
    own_way = bool(placed) and _have_hips_own_translation(joints, values)
    columns = _channel_slices(joints)
    for index in placed:
        if index == 1 and own_way:
            continue
        positions = _positions(joints[index], values[:, columns[index]], offsets[index])
        mean, offset = positions.mean(axis=0), offsets[index]
        noise, distance = float(np.linalg.norm(positions.std(axis=0))), float(np.linalg.norm(mean))
        is_constant = noise <= max(_MAX_NOISE_RATIO * distance, _MOTION_THRESHOLD)
        if np.ptp(positions, axis=0).max() > _WARNING_THRESHOLD and not is_constant and index > hips:
            moving.append(joints[index].name)
        may_replace = is_constant or (index > hips and not offset.any())
        if may_replace and distance > 0.0 and not np.allclose(mean, offset, atol=max(1e-3, noise)):
            out[index] = mean
            replaced.append(joints[index].name)
    notes, warnings = [], []
    if replaced:
        notes.append(f"the position channels, not the OFFSETs, give the place of {_some(replaced)}")
    if moving:
        warnings.append(
            f"the positions of {_some(moving)} relative to the parent change in the motion; the skeleton "
            "keeps one length for each bone"
        )
    return out, notes, warnings


def _some(names: list[str]) -> str:
    """Return a list of names as text; only the first ones of a long list."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more joints" if len(names) > 3 else "")


def _has_position(joint: FileJoint) -> bool:
    return any(name.endswith("position") for name in joint.channels)


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


def _detect_units(in_metres: SkeletonModel) -> str:
    """Return the unit of length, "m" or "cm", that fits a skeleton whose lengths are read as metres."""
    stature = stature_from_limbs(in_metres) or float(np.ptp(rest_positions(in_metres), axis=0).max())
    return "m" if 0.0 < stature < _MAX_METRE_STATURE else "cm"


def _skeleton(name: str, joints: list[FileJoint], offsets: FloatArray) -> SkeletonModel:
    """Return the skeleton with these joints and offsets (J,3), which are in file axes, read as metres."""
    ends = np.full((len(joints), 3), np.nan)
    for index, joint in enumerate(joints):
        if joint.children == 0:
            ends[index] = 0.0 if joint.end is None else joint.end
    names = tuple(joint.name for joint in joints)
    parents = [joint.parent for joint in joints]
    offsets_m, ends_m = world_from_file_points(offsets, "m"), world_from_file_points(ends, "m")
    return SkeletonModel(
        name=name,
        joints=names,
        parents=np.array(parents),
        offsets_m=offsets_m,
        end_offsets_m=ends_m,
        roles=assign_roles(names, parents, offsets_m, ends_m),
        bvh_channels=tuple(joint.channels for joint in joints),
    )
