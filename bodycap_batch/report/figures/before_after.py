"""Draw the skeleton before and after its optimisation, viewed from the front.

Source: M. Vo, Kim, Choudhary, "Motion Capture using Body Mounted Cameras in an Unknown Environment",
    figure 8.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.model.geometry import invert, poses_at
from bodycap_batch.model.merge_data import MergeResult
from bodycap_batch.report.figures.svg import element, path_through, svg_image, text
from bodycap_batch.report.report_inputs import ReportInputs

_COLUMNS = 4
"""Number of times at which the skeleton is drawn, side by side."""
_MAX_INTERVAL_NS = 100_000_000
"""Maximum time (nanoseconds) between two measured poses for interpolation between them.

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
        times_ns = inputs.clocks[mount.camera].common_times_ns(path.times_ns)[path.localised]
        world_from_cam, measured = poses_at(
            times_ns, path.gauge_from_cam[path.localised], merge.times_ns(), max_gap_ns=_MAX_INTERVAL_NS
        )
        if not measured.any():
            continue
        bones.append(
            UnoptimisedBone(
                camera=mount.camera,
                joint=joint,
                ticks=np.flatnonzero(measured),
                world_from_joint=world_from_cam[measured] @ invert(mount.joint_from_cam),
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
    common_ticks = functools.reduce(np.intersect1d, [bone.ticks for bone in bones])
    ticks = common_ticks if len(common_ticks) >= _COLUMNS else bones[0].ticks
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
    root, skeleton = world_from_joint[0], merge.skeleton
    left = root[:3, 0] * [1.0, 1.0, 0.0]
    across = left / max(float(np.linalg.norm(left)), 1e-9)

    def to_drawing(points: FloatArray) -> FloatArray:
        # Viewed from the front, the body's left side appears on the right.
        x = (points - root[:3, 3]) @ across * _UNITS_PER_M + (column + 0.5) * _CELL_WIDTH
        return np.stack([x, 18.0 + (_TOP_HEIGHT_M - points[:, 2]) * _UNITS_PER_M], axis=1)

    def draw_bone(pose: FloatArray, offset_m: FloatArray, kind: str, style: str | None = None) -> str:
        """Draw a bone from its joint to an offset in the frame of the joint."""
        line = path_through(to_drawing(np.stack([pose[:3, 3], pose[:3, :3] @ offset_m + pose[:3, 3]])))
        return element("path", class_=kind, style=style, d=line)

    segments = [
        (parent, skeleton.offsets_m[joint], merge.solved[joint] and merge.solved[parent])
        for joint, parent in enumerate(skeleton.parents)
        if parent >= 0
    ]
    segments += [
        (joint, skeleton.end_offsets_m[joint], merge.solved[joint])
        for joint in np.flatnonzero(np.isfinite(skeleton.end_offsets_m).all(axis=1))
    ]
    parts = [
        draw_bone(world_from_joint[joint], offset_m, "bone" if is_solved else "bone guessed")
        for joint, offset_m, is_solved in segments
    ]
    for bone in bones:
        for pose in bone.world_from_joint[bone.ticks == tick]:
            colour = colours[bone.camera]
            offsets = skeleton.offsets_m[skeleton.parents == bone.joint]
            for offset in offsets if len(offsets) else skeleton.end_offsets_m[[bone.joint]]:
                parts.append(draw_bone(pose, offset, "bone before", f"stroke:{colour}"))
            x, y = to_drawing(pose[None, :3, 3])[0].tolist()
            parts.append(element("circle", cx=x, cy=y, r=3.5, fill=colour))
    middle, words = (column + 0.5) * _CELL_WIDTH, f"{merge.times_ns()[tick] * 1e-9:.2f} s"
    return "".join(parts) + text(middle, _CELL_HEIGHT + 18.0, words, class_="tick", text_anchor="middle")
