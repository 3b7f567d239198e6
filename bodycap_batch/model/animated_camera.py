"""Animated pinhole cameras and the points of the room, in the form that files for 3D programs hold."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, json_numbers, set_array, true_spans
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.take import Take

SENSOR_WIDTH_MM = 36.0
"""Width of the sensor in all files, millimetres. Only its ratio to the focal length matters. Origin: the
full-frame format, Blender's default, to which focal lengths are usually compared."""

NEAR_PLANE = 0.01
"""Distance of the near plane of the cameras, in the unit of the scene. Nothing is nearer to a lens."""
FAR_PLANE = 1e3
"""Distance of the far plane of the cameras, in the unit of the scene. No point of a room is farther."""

CAM_FROM_GL: FloatArray = np.diag([1.0, -1.0, -1.0, 1.0])
"""Pose of the axes of cameras in computer graphics (x right, y up, looks along −z) in our camera axes (x
right, y down, looks along +z)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AnimatedCamera:
    """A pinhole camera with a pose at each of T frames of a scene.

    Attributes:
        name: Name of the camera.
        pinhole: The undistorted camera, with square pixels and the principal point in the centre.
        scene_from_cam: (T,4,4) poses. A frame that is not valid has the pose of the last valid frame before
            it, or of the first valid frame.
        valid: (T,) True if the picture of the frame was localised, or if its rotation alone is known. Then
            its position is zero, and has no sigma.
        video_frame: (T,) number of the frame of the video whose picture and pose the frame has; −1 before the
            start and after the end of the video.
        shift_s: (T,) instant of the middle row of this picture − time of the frame, seconds; NaN without a
            picture.
        sigma_rad: (T,) standard deviation of the rotation per axis, radians; NaN if the frame is not valid.
        sigma_position: (T,) standard deviation of the position per axis, in the unit of the scene; NaN if the
            frame is not valid.
        clock_is_known: False if the relation of the camera's clock to the other cameras is unknown.
    """

    name: str
    pinhole: Camera
    scene_from_cam: FloatArray
    valid: BoolArray
    video_frame: IntArray
    shift_s: FloatArray
    sigma_rad: FloatArray
    sigma_position: FloatArray
    clock_is_known: bool = True

    def __post_init__(self) -> None:
        count = len(self.valid)
        set_array(self, "scene_from_cam", (count, 4, 4))
        set_array(self, "valid", (count,), np.bool_)
        set_array(self, "video_frame", (count,), np.int64)
        for name in ("shift_s", "sigma_rad", "sigma_position"):
            set_array(self, name, (count,), finite=False)

    @property
    def focal_mm(self) -> float:
        """Focal length for a sensor of `SENSOR_WIDTH_MM`, millimetres."""
        return self.pinhole.focal_px / self.pinhole.width_px * SENSOR_WIDTH_MM

    @property
    def sensor_height_mm(self) -> float:
        """Height of a sensor of the width `SENSOR_WIDTH_MM`, millimetres."""
        return SENSOR_WIDTH_MM * self.pinhole.height_px / self.pinhole.width_px

    @property
    def vertical_fov_rad(self) -> float:
        """Vertical field of view, radians."""
        return 2.0 * float(np.arctan(0.5 * self.pinhole.height_px / self.pinhole.focal_px))

    def scene_from_gl(self) -> FloatArray:
        """Return the poses (T,4,4) of the camera's axes as computer graphics define them."""
        return self.scene_from_cam @ CAM_FROM_GL

    def figures(self) -> dict[str, Any]:
        """Return lens, validity and sigma as plain JSON values; None stands for unknown values."""
        return {
            "width_px": self.pinhole.width_px,
            "height_px": self.pinhole.height_px,
            "focal_px": round(self.pinhole.focal_px, 4),
            "focal_mm": round(self.focal_mm, 6),
            "sensor_mm": [SENSOR_WIDTH_MM, round(self.sensor_height_mm, 6)],
            "vertical_fov_deg": round(float(np.degrees(self.vertical_fov_rad)), 6),
            "clock_is_known": self.clock_is_known,
            "valid_frames": true_spans(self.valid),
            "rotation_only_frames": true_spans(self.valid & ~np.isfinite(self.sigma_position)),
            "video_frame": self.video_frame.tolist(),
            "shift_s": json_numbers(self.shift_s, 6),
            "sigma_deg": json_numbers(np.degrees(self.sigma_rad), 4),
            "sigma_position": json_numbers(self.sigma_position, 6),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraScene:
    """Animated cameras with T frames, and P points of the room.

    Attributes:
        take: Name of the take, frame rate, start and timecode.
        frame_of_reference: Sentence about the frame of reference of all poses and points.
        is_metric: True if the unit is the metre and Z is up; False for the gauge of a map.
        cameras: The cameras.
        points: (P,3) points of the room.
        colors: (P,3) colours of the points, uint8 RGB.
    """

    take: Take
    frame_of_reference: str
    is_metric: bool
    cameras: tuple[AnimatedCamera, ...]
    points: FloatArray
    colors: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]

    def __post_init__(self) -> None:
        set_array(self, "points", (None, 3))
        set_array(self, "colors", (len(self.points), 3), np.uint8)
        if len({len(camera.valid) for camera in self.cameras}) != 1:
            raise ValueError("cameras: all need the same number of frames, and there must be one")

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return len(self.cameras[0].valid)

    def figures(self) -> dict[str, Any]:
        """Return the take and the frame of reference as plain JSON values."""
        return {**self.take.figures(), "frame_of_reference": self.frame_of_reference}
