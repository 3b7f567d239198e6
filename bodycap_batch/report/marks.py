"""What is drawn over a picture: the inlier points behind its pose, and the solved skeleton where in view."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.merge_data import MergeResult
from bodycap_batch.model.scene import Trajectory
from bodycap_batch.overlay import Body, CameraView, bone_lines, camera_views
from bodycap_batch.report.inputs import ReportInputs
from bodycap_batch.report.packing import pack_scaled

_MAX_INLIERS = 120
_LINE_POINTS = 6
"""Of the points that a bone's line is projected with: a lens bends it, but never much within a picture."""


class Marks:
    """What is drawn over every camera's pictures.

    Args:
        inputs: The results.
    """

    def __init__(self, inputs: ReportInputs) -> None:
        self._inputs = inputs
        views = camera_views(inputs.registrations, inputs.maps, inputs.clocks, inputs.merge)
        self._views = {view.camera: view for view in views}
        self._body = None if inputs.merge is None else solved_body(inputs.merge)

    def over(self, camera: str, frames: Iterable[int]) -> list[dict[str, Any]]:
        """What is known of frames of a camera: index, status, inliers and error, and what to draw over them.

        Points and bones in fractions of the picture's width and height.
        """
        view, path = self._views.get(camera), self._inputs.path(camera)
        return [
            {
                **_told(path, index),
                "inliersAt": pack_scaled(np.zeros((0, 2)) if view is None else _inliers(view, index)),
                "bones": [] if view is None else self._bones(view, index),
            }
            for index in frames
        ]

    def part(self, camera: str, first: int, count: int) -> list[dict[str, Any]]:
        """`over` so many frames from the first one on; fewer where the camera ends, none behind its end."""
        path = self._inputs.path(camera)
        return [] if path is None else self.over(camera, range(first, min(first + count, len(path.status))))

    def _bones(self, view: CameraView, index: int) -> list[list[float]]:
        pose = view.cam_from_frame(index)
        bones = None if self._body is None else self._body.at(int(view.times_ns[index]))
        if pose is None or bones is None or view.frame != "world":
            return []
        size = np.array([view.lens.width_px, view.lens.height_px], dtype=np.float64)
        lines = []
        for line in bone_lines(view.lens, pose, bones):
            points = line.px[np.linspace(0, len(line.px) - 1, _LINE_POINTS).round().astype(int)] / size
            lines.append([round(float(value), 4) for value in points.ravel()])
        return lines


def _told(path: Trajectory | None, index: int) -> dict[str, Any]:
    """What registration says of a frame."""
    if path is None:
        return {"i": index, "status": "", "inliers": 0, "error": None}
    error = float(path.error_px[index])
    return {
        "i": index,
        "status": path.status[index].value,
        "inliers": int(path.inliers[index]),
        "error": round(error, 3) if np.isfinite(error) else None,
    }


def solved_body(merge: MergeResult) -> Body:
    """The bones between solved joints, in the motion that all outputs show."""
    skeleton, poses, solved = merge.skeleton, merge.motion.world_from_joint(), merge.solved
    centres = poses[..., :3, 3]
    pairs: list[FloatArray] = []
    turned_by: list[int] = []
    for joint, parent in enumerate(skeleton.parents.tolist()):
        if parent >= 0 and solved[joint] and solved[parent]:
            pairs.append(np.stack([centres[:, parent], centres[:, joint]], axis=1))
            turned_by.append(parent)
        if solved[joint] and np.isfinite(skeleton.end_offsets_m[joint]).all():
            tip = poses[:, joint, :3, :3] @ skeleton.end_offsets_m[joint] + centres[:, joint]
            pairs.append(np.stack([centres[:, joint], tip], axis=1))
            turned_by.append(joint)
    joints = np.array(turned_by, dtype=np.int64)
    return Body(
        joint=joints,
        side=("",) * len(pairs),
        times_ns=merge.times_ns(),
        ends_in_world=np.stack(pairs, axis=1) if pairs else np.zeros((len(poses), 0, 2, 3)),
        observed=merge.observed[:, joints],
    )


def _inliers(view: CameraView, index: int) -> FloatArray:
    """(N,2) where the picture shows the points behind a frame's pose; at most so many, evenly picked."""
    seen = view.points_at(index).observed_px
    step = max(1, -(-len(seen) // _MAX_INLIERS))
    return np.asarray(seen[::step] / np.array([view.lens.width_px, view.lens.height_px]))
