"""Compute the intrinsics of a camera before mapping, at the work size (the image size of all stages)."""

from __future__ import annotations

from typing import Literal

import numpy as np

from bodycap_batch.capture.video import VideoFile
from bodycap_batch.config.bounds import ASPECT_TOLERANCE
from bodycap_batch.config.calibration import Calibration
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.model.camera import Camera, with_two_focal_lengths

FovSource = Literal["job file", "video metadata", "default"]

_GUESSED_FOV_DEG = 70.0
"""Field of view along the long side of the image. The program assumes this value if the true field of view is
unknown. Unit: degrees. The widest common lenses of webcams and phones have this field of view. Mapping
refines the value."""


_FULL_FRAME_MM = 36.0
"""Width of a 35 mm film frame, millimetres. The definition of the 35 mm equivalent focal length uses this
width."""


def work_size(
    shown_size: tuple[int, int], work_px: int, turned_size: tuple[int, int] | None = None
) -> tuple[int, int]:
    """Return the work size of a video. Frames are never enlarged to the work size.

    Args:
        shown_size: Width and height that a player shows, in square pixels.
        work_px: Maximum length of the long side of the work size, pixels.
        turned_size: Width and height after the display rotation, in stored pixels. The work size is not
            larger than this size. None if the stored pixels are square.

    Returns:
        The width and height, pixels.
    """
    stored = turned_size or shown_size
    scale = min(
        1.0, work_px / max(shown_size), *(own / side for own, side in zip(stored, shown_size, strict=True))
    )
    width, height = (max(1, round(side * scale)) for side in shown_size)
    return width, height


def work_size_of(video: VideoFile, work_px: int) -> tuple[int, int]:
    """Return the work size of a video, pixels: see `work_size`."""
    return work_size(video.shown_size, work_px, video.turned_size)


def work_camera(calibration: Calibration, video: VideoFile, work_px: int) -> Camera:
    """Return the intrinsics of a calibration at the work size.

    The stored pixels of some videos are not square. A calibration that was made with such pixels is stretched
    in the same way as the images.

    Raises:
        CaptureError: The aspect ratio of the calibration differs from the aspect ratio of the video.
    """
    width, height = video.shown_size
    if not any(_same_aspect(calibration, *size) for size in (video.shown_size, video.turned_size)):
        is_turned = _same_aspect(calibration, height, width)
        raise CaptureError(
            f"the camera was calibrated at {calibration.width}×{calibration.height}, but the video shows "
            f"{width}×{height}: the aspect ratios differ",
            path=video.path,
            field="calibration",
            hint="the video is rotated relative to the calibration: calibrate with pictures in the "
            "orientation that a video player shows"
            if is_turned
            else "calibrate in the same video mode as the recording (the program cannot know how the "
            "camera crops the picture), or use `calibration: auto`",
        )
    camera = calibration.camera()
    size = work_size_of(video, work_px)
    if size[0] * camera.height_px != size[1] * camera.width_px:
        camera = with_two_focal_lengths(camera)
    return camera.scaled(*size)


def _same_aspect(calibration: Calibration, width: int, height: int) -> bool:
    """Return True if a calibration has the same aspect ratio as an image of this width and height."""
    return abs(width * calibration.height / (height * calibration.width) - 1.0) <= ASPECT_TOLERANCE


def guessed_fov_deg(video: VideoFile, fov_deg: float | None) -> tuple[float, FovSource]:
    """Return the field of view (degrees) along the long side of `guessed_camera`, and where it comes from."""
    if fov_deg is not None:
        return fov_deg, "job file"
    if video.focal_35mm is not None:
        return float(2.0 * np.degrees(np.arctan(0.5 * _FULL_FRAME_MM / video.focal_35mm))), "video metadata"
    return _GUESSED_FOV_DEG, "default"


def guessed_camera(video: VideoFile, work_px: int, fov_deg: float | None) -> Camera:
    """Return an initial guess of the intrinsics at the work size. Mapping refines this guess.

    Args:
        video: The video.
        work_px: Maximum length of the long side of the work size, pixels.
        fov_deg: Field of view along the long side that is given in the job, degrees. If it is None, the focal
            length in the metadata of the video is used. Without such metadata, a typical field of view is
            used.
    """
    width, height = work_size_of(video, work_px)
    long_side = max(width, height)
    used_fov_deg, source = guessed_fov_deg(video, fov_deg)
    if source == "video metadata" and video.focal_35mm is not None:
        focal = long_side * video.focal_35mm / _FULL_FRAME_MM
    else:
        focal = 0.5 * long_side / np.tan(0.5 * np.radians(used_fov_deg))
    params = np.array([focal, 0.5 * width, 0.5 * height, 0.0])
    return Camera(model="SIMPLE_RADIAL", width_px=width, height_px=height, params=params, refine=True)
