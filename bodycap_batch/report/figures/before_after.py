"""Draw the skeleton before and after its optimisation, viewed from the front.

Source: M. Vo, Kim, Choudhary, "Motion Capture using Body Mounted Cameras in an Unknown Environment",
    figure 8.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.model.geometry import interpolate_pose, invert
from bodycap_batch.model.merge_data import MergeResult
from bodycap_batch.report.figures.svg import element, path_through, svg_image, text
from bodycap_batch.report.report_inputs import ReportInputs

_COLUMNS = 4
"""Number of times at which the skeleton is drawn, side by side."""
_MAX_INTERVAL_S = 0.1
"""Maximum time (seconds) between two measured poses for interpolation between them.

This is the duration of three frames of a camera with 30 fps.
"""
_CELL_WIDTH, _CELL_HEIGHT, _UNITS_PER_M = 236.0, 250.0, 112.0
"""Width and height of one drawing (SVG units), and number of SVG units per metre.

A person of 2 m fits into the drawing.
"""
_TOP_HEIGHT_M = 1.95
"""Height above the floor (metres) that is drawn at the upper edge of a drawing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class UnoptimisedBone:
    """A bone before the optimisation, placed only by the measured poses and the assumed mount of one camera.

    Attributes:
        camera: Name of the camera on the bone.
        joint: Index of the bone's joint.
        ticks: (N,) indices of the motion's ticks at which the camera has a measured or interpolated pose.
        world_from_joint: (N,4,4) pose of the bone's joint at these ticks.
    """

    camera: str
    joint: int
    ticks: IntArray
    world_from_joint: FloatArray

    def distance_m(self, world_from_joint: FloatArray) -> FloatArray:
        """Return how far the bone's joint is from the same joint of the solved motion.

        Args:
            world_from_joint: (T,J,4,4) joint poses of the solved motion.

        Returns:
            (N,) distance at each tick of `ticks`, metres.
        """
        solved = world_from_joint[self.ticks, self.joint, :3, 3]
        return np.asarray(np.linalg.norm(self.world_from_joint[:, :3, 3] - solved, axis=1))


def find_unoptimised_bones(inputs: ReportInputs) -> list[UnoptimisedBone]:
    """Return the bone of each camera on the body, placed only by the camera's poses and assumed mount.

    The list is empty without a body. A camera without poses in the world is omitted.
    """
    merge = inputs.merge
    if merge is None:
        return []
    bones = []
    for mount in inputs.mounts:
        joint = merge.skeleton.index_of_role(mount.role)
        path = inputs.path(mount.camera)
        if joint is None or path is None or path.gauge != "world":
            continue
        times = inputs.clocks[mount.camera].common_times_ns(path.times_ns)[path.localised]
        poses = path.gauge_from_cam[path.localised]
        ticks = merge.times_ns()
        if len(times) == 0:
            continue
        right = np.clip(np.searchsorted(times, ticks), 0, len(times) - 1)
        left = np.where(times[right] == ticks, right, np.maximum(right - 1, 0))
        interval = times[right] - times[left]
        inside = (ticks >= times[0]) & (ticks <= times[-1]) & (interval <= _MAX_INTERVAL_S * 1e9)
        measured_ticks = np.flatnonzero(inside)
        if len(measured_ticks) == 0:
            continue
        alpha = (ticks - times[left])[measured_ticks] / np.maximum(interval[measured_ticks], 1)
        world_from_cam = interpolate_pose(poses[left[measured_ticks]], poses[right[measured_ticks]], alpha)
        bones.append(
            UnoptimisedBone(
                camera=mount.camera,
                joint=joint,
                ticks=measured_ticks,
                world_from_joint=world_from_cam @ invert(mount.joint_from_cam),
            )
        )
    return bones


def draw_before_and_after(inputs: ReportInputs, colours: dict[str, str]) -> str:
    """Draw the body at a few times, viewed from the body's front.

    Bones before the optimisation have the colours of their cameras. Bones after the optimisation have the
    text colour.

    Args:
        inputs: The results of the job.
        colours: Colour ``#rrggbb`` of each camera, by camera name.

    Returns:
        The drawing as SVG; "" without a body.
    """
    merge = inputs.merge
    bones = find_unoptimised_bones(inputs)
    if merge is None or not bones:
        return ""
    common_ticks = bones[0].ticks
    for bone in bones[1:]:
        common_ticks = np.intersect1d(common_ticks, bone.ticks)
    ticks = common_ticks if len(common_ticks) >= _COLUMNS else bones[0].ticks
    if len(ticks) == 0:
        return ""
    chosen = ticks[np.linspace(0, len(ticks) - 1, _COLUMNS + 2)[1:-1].round().astype(int)]
    poses = merge.motion.world_from_joint()[chosen]
    parts = [
        _draw_tick(merge, bones, int(tick), poses[column], column, colours)
        for column, tick in enumerate(chosen)
    ]
    title = "Skeleton before (coloured, dashed) and after optimisation, from the front, at four times"
    return svg_image(_COLUMNS * _CELL_WIDTH, _CELL_HEIGHT + 24.0, "".join(parts), title, class_="bodies")


def _draw_tick(
    merge: MergeResult,
    bones: list[UnoptimisedBone],
    tick: int,
    world_from_joint: FloatArray,
    column: int,
    colours: dict[str, str],
) -> str:
    root = world_from_joint[0]
    left = root[:3, 0] * [1.0, 1.0, 0.0]
    across = left / max(float(np.linalg.norm(left)), 1e-9)

    def to_drawing(points: FloatArray) -> list[tuple[float, float]]:
        # Viewed from the front, the body's left side appears on the right.
        x = (points - root[:3, 3]) @ across * _UNITS_PER_M + (column + 0.5) * _CELL_WIDTH
        y = 18.0 + (_TOP_HEIGHT_M - points[:, 2]) * _UNITS_PER_M
        return list(zip(x.tolist(), y.tolist(), strict=True))

    skeleton, parts = merge.skeleton, []
    for joint, parent in enumerate(skeleton.parents):
        if parent >= 0:
            ends = world_from_joint[[parent, joint], :3, 3]
            style_class = "bone" if merge.solved[joint] and merge.solved[parent] else "bone guessed"
            parts.append(element("path", class_=style_class, d=path_through(to_drawing(ends))))
    for joint in np.flatnonzero(np.isfinite(skeleton.end_offsets_m).all(axis=1)).tolist():
        style_class = "bone" if merge.solved[joint] else "bone guessed"
        ends = _bone_ends(world_from_joint[joint], skeleton.end_offsets_m[joint])
        parts.append(element("path", class_=style_class, d=path_through(to_drawing(ends))))
    for bone in bones:
        index = np.flatnonzero(bone.ticks == tick)
        if len(index) == 0:
            continue
        pose, colour = bone.world_from_joint[index[0]], colours[bone.camera]
        for offset in _far_end_offsets(merge, bone.joint):
            parts.append(
                element(
                    "path",
                    class_="bone before",
                    style=f"stroke:{colour}",
                    d=path_through(to_drawing(_bone_ends(pose, offset))),
                )
            )
        x, y = to_drawing(pose[None, :3, 3])[0]
        parts.append(element("circle", cx=x, cy=y, r=3.5, fill=colour))
    seconds = merge.times_ns()[tick] * 1e-9
    middle = (column + 0.5) * _CELL_WIDTH
    return "".join(parts) + text(
        middle, _CELL_HEIGHT + 18.0, f"{seconds:.2f} s", class_="tick", text_anchor="middle"
    )


def _bone_ends(pose: FloatArray, offset: FloatArray) -> FloatArray:
    """Return the two ends (2,3) of a bone, first the end at the joint.

    Args:
        pose: (4,4) pose of the joint.
        offset: (3,) offset of the far end in the frame of the joint.
    """
    return np.stack([pose[:3, 3], pose[:3, :3] @ offset + pose[:3, 3]])


def _far_end_offsets(merge: MergeResult, joint: int) -> list[FloatArray]:
    """Return the offsets (3,) of a joint's children, in the frame of the joint.

    For a joint without children, return the offset of the tip of its bone.
    """
    skeleton = merge.skeleton
    children = np.flatnonzero(skeleton.parents == joint)
    if len(children):
        return [skeleton.offsets_m[child] for child in children]
    return [skeleton.end_offsets_m[joint]]
