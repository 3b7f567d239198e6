"""Make the overlays of a camera's frames: the inlier points of each pose, and the visible bones."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.scene import Trajectory
from bodycap_batch.overlay import CameraView, bones_from_motion, make_camera_views, project_bones
from bodycap_batch.report.packing import pack_scaled
from bodycap_batch.report.report_inputs import ReportInputs

_MAX_INLIERS = 120
"""Maximum number of points that are drawn over one picture.

More points would hide the picture. Evidence: none.
"""
_LINE_POINTS = 6
"""Number of stored points on the line of one bone.

Lens distortion bends the line in the image, but only slightly.
"""


class FrameOverlays:
    """Describes the frames of all cameras by their status and overlays.

    Args:
        inputs: The results of the job.
    """

    def __init__(self, inputs: ReportInputs) -> None:
        self._inputs = inputs
        views = make_camera_views(inputs.registrations, inputs.maps, inputs.clocks, inputs.merge)
        self._views = {view.camera: view for view in views}
        self._bone_motion = (
            None if inputs.merge is None else bones_from_motion(inputs.merge.motion, inputs.merge.solved)
        )

    def describe(self, camera: str, frames: Iterable[int]) -> list[dict[str, Any]]:
        """Describe frames of one camera as JSON values.

        Args:
            camera: Camera name.
            frames: Indices of the frames to describe.

        Returns:
            The index, status, number of inliers, reprojection error (pixels) and overlays of each frame.
            Positions in the overlays are fractions of the image's width and height.
        """
        view, path = self._views.get(camera), self._inputs.path(camera)
        return [
            {
                **_pose_facts(path, index),
                "inliersAt": pack_scaled(_inlier_positions(view, index)),
                "bones": [] if view is None else self._bone_positions(view, index),
            }
            for index in frames
        ]

    def describe_part(self, camera: str, first: int, count: int) -> list[dict[str, Any]]:
        """Describe successive frames of one camera as `describe` does.

        No frames exist after the camera's last frame. Therefore the result can have fewer than `count`
        entries or be empty.

        Args:
            camera: Camera name.
            first: Index of the first frame.
            count: Maximum number of frames.
        """
        path = self._inputs.path(camera)
        if path is None:
            return []
        return self.describe(camera, range(first, min(first + count, len(path.status))))

    def _bone_positions(self, view: CameraView, index: int) -> list[list[float]]:
        pose = view.cam_from_frame(index)
        bones = None if self._bone_motion is None else self._bone_motion.bones_at(int(view.times_ns[index]))
        if pose is None or bones is None or view.reference_frame != "world":
            return []
        size = np.array([view.lens.width_px, view.lens.height_px], dtype=np.float64)
        lines = []
        for line in project_bones(view.lens, pose, bones):
            points = line.px[np.linspace(0, len(line.px) - 1, _LINE_POINTS).round().astype(int)] / size
            lines.append([round(float(value), 4) for value in points.ravel()])
        return lines


def _pose_facts(path: Trajectory | None, index: int) -> dict[str, Any]:
    """Return the index, status, number of inliers and reprojection error (pixels) of a frame."""
    if path is None:
        return {"i": index, "status": "", "inliers": 0, "error": None}
    error = float(path.error_px[index])
    return {
        "i": index,
        "status": path.status[index].value,
        "inliers": int(path.inliers[index]),
        "error": round(error, 3) if np.isfinite(error) else None,
    }


def _inlier_positions(view: CameraView | None, index: int) -> FloatArray:
    """Return the observed image positions (N,2) of a frame's inliers, as fractions of the image size.

    If there are more than `_MAX_INLIERS` inliers, only every k-th inlier is selected. The number k is the
    smallest number with which at most `_MAX_INLIERS` inliers remain.
    """
    if view is None:
        return np.zeros((0, 2))
    observed_px = view.inliers_at(index).observed_px
    stride = max(1, -(-len(observed_px) // _MAX_INLIERS))
    return np.asarray(observed_px[::stride] / np.array([view.lens.width_px, view.lens.height_px]))
