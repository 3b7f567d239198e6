"""Open the videos of a capture: list their frames, compute frame times and intrinsics.

The intrinsics are computed at the work size, which is the image size that all stages work at.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodycap_batch.capture.cameras import Capture, CaptureCamera
from bodycap_batch.capture.indexing import index_video
from bodycap_batch.capture.masks import read_mask
from bodycap_batch.capture.timeline import join_chapters
from bodycap_batch.capture.video import VideoFile
from bodycap_batch.config.calibration import Calibration
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.core.arrays import BoolArray, IntArray
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.model.camera import Camera, with_two_focal_lengths

_GUESSED_FOV_DEG = 70.0
"""Field of view along the long side of the image. The program assumes this value if the true field of view is
unknown. Unit: degrees. The widest common lenses of webcams and phones have this field of view. Mapping
refines the value."""
_FULL_FRAME_MM = 36.0
"""Width of a 35 mm film frame, millimetres. The definition of the 35 mm equivalent focal length uses this
width."""
_ASPECT_TOLERANCE = 0.004
"""Maximum relative difference between two aspect ratios that are treated as equal. Origin: one pixel in an
image of 640×480, because encoders round image sizes to even numbers."""


def open_capture(spec: CaptureConfig, threads: int = 0) -> Capture:
    """Open all videos of a capture and list their frames. The frames are not decoded.

    Args:
        spec: The capture block of a job, as returned by `load_job`.
        threads: Number of threads of each decoder, as in `CaptureCamera`.

    Raises:
        CaptureError: A video, its timestamps or its calibration cannot be used, or there is no frame between
            start_s and end_s.
    """
    return Capture(cameras=tuple(open_camera(spec, camera, threads) for camera in spec.cameras))


def open_camera(spec: CaptureConfig, config: CameraConfig, threads: int = 0) -> CaptureCamera:
    """Open the videos of one camera and list their frames.

    Args:
        spec: The capture block of a job, as returned by `load_job`.
        config: The block of this camera.
        threads: Number of threads of the decoder, as in `CaptureCamera`.

    Raises:
        CaptureError: A video of the camera, its timestamps or its calibration cannot be used, or there is no
            frame between start_s and end_s.
    """
    videos = tuple(index_video(path, threads) for path in config.video)
    _check_one_format(videos)
    timeline = join_chapters(videos, config.timestamps)
    offset_s = config.offset_s or 0.0
    used = timeline.usable & _in_time_range(timeline.times_ns, offset_s, spec)
    if not used.any():
        raise _no_frames_error(spec, config, timeline.times_ns, offset_s)
    calibration = config.calibration if isinstance(config.calibration, Calibration) else None
    camera = (
        guessed_camera(videos[0], spec.work_px, config.fov_deg)
        if calibration is None
        else work_camera(calibration, videos[0], spec.work_px)
    )
    return CaptureCamera(
        name=config.name,
        chapters=config.video,
        camera=replace(
            camera, sideways=_is_quarter_turned(videos[0]) and config.rolling_shutter_s is not None
        ),
        calibrated=calibration is not None,
        frame_numbers=np.flatnonzero(used),
        times_ns=timeline.times_ns[used],
        nominal_fps=videos[0].fps,
        offset_s=offset_s,
        rolling_shutter_s=_shown_rolling_shutter_s(config.rolling_shutter_s or 0.0, videos[0]),
        rolling_shutter_known=config.rolling_shutter_s is not None,
        # Sensors are wider than they are high. Therefore a picture that is higher than wide was rotated by
        # 90°, by the camera or by the person who edited the video.
        may_be_sideways=_is_quarter_turned(videos[0]) or camera.height_px > camera.width_px,
        notes=timeline.notes,
        videos=videos,
        threads=threads,
        mask=None if config.mask is None else read_mask(config.mask, (camera.width_px, camera.height_px)),
    )


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
            f"calibrated at {calibration.width}×{calibration.height}, but the video shows {width}×{height}: "
            "another aspect ratio",
            path=video.path,
            field="calibration",
            hint="the video is rotated relative to the calibration: calibrate as a player shows it"
            if is_turned
            else "calibrate in the video mode that was recorded (a crop cannot be guessed), or use `auto`",
        )
    camera = calibration.camera()
    size = work_size((width, height), work_px, video.turned_size)
    if size[0] * camera.height_px != size[1] * camera.width_px:
        camera = with_two_focal_lengths(camera)
    return camera.scaled(*size)


def _same_aspect(calibration: Calibration, width: int, height: int) -> bool:
    """Return True if a calibration has the same aspect ratio as an image of this width and height."""
    return abs(width * calibration.height / (height * calibration.width) - 1.0) <= _ASPECT_TOLERANCE


def guessed_camera(video: VideoFile, work_px: int, fov_deg: float | None) -> Camera:
    """Return an initial guess of the intrinsics at the work size. Mapping refines this guess.

    Args:
        video: The video.
        work_px: Maximum length of the long side of the work size, pixels.
        fov_deg: Field of view along the long side that is given in the job, degrees. If it is None, the focal
            length in the metadata of the video is used. Without such metadata, a typical field of view is
            used.
    """
    width, height = work_size(video.shown_size, work_px, video.turned_size)
    long_side = max(width, height)
    if fov_deg is not None:
        focal = 0.5 * long_side / np.tan(0.5 * np.radians(fov_deg))
    elif video.focal_35mm is not None:
        focal = long_side * video.focal_35mm / _FULL_FRAME_MM
    else:
        focal = 0.5 * long_side / np.tan(0.5 * np.radians(_GUESSED_FOV_DEG))
    params = np.array([focal, 0.5 * width, 0.5 * height, 0.0])
    return Camera(model="SIMPLE_RADIAL", width_px=width, height_px=height, params=params, refine=True)


def _is_quarter_turned(video: VideoFile) -> bool:
    """Return True if a player rotates the video by 90°, so that stored rows are shown as columns."""
    return not video.orientation[1][1]


def _shown_rolling_shutter_s(rolling_shutter_s: float, video: VideoFile) -> float:
    """Return the readout time of the shown image, with a sign for the direction of the readout.

    The time is positive if the sensor reads the shown image from top to bottom; for a video rotated by 90°,
    from left to right. It is negative for the opposite direction, for example if the camera was upside down.
    """
    return rolling_shutter_s * (video.orientation[1][1] or video.orientation[0][1])


def _check_one_format(videos: tuple[VideoFile, ...]) -> None:
    """Raise `CaptureError` if the chapters have different image sizes."""
    for video in videos[1:]:
        if video.shown_size != videos[0].shown_size:
            raise CaptureError(
                f"this chapter shows {video.shown_size[0]}×{video.shown_size[1]}, the first one "
                f"{videos[0].shown_size[0]}×{videos[0].shown_size[1]}",
                path=video.path,
                hint="chapters of one camera come from one recording; list this video as another camera",
            )


def _in_time_range(times_ns: IntArray, offset_s: float, spec: CaptureConfig) -> BoolArray:
    """Return a mask (N,) that is True for frames between start_s and end_s on the common clock."""
    common = times_ns + round(offset_s * 1e9)
    is_inside = np.ones(len(common), dtype=bool)
    if spec.start_s is not None:
        is_inside &= common >= round(spec.start_s * 1e9)
    if spec.end_s is not None:
        is_inside &= common <= round(spec.end_s * 1e9)
    return is_inside


def _no_frames_error(
    spec: CaptureConfig, config: CameraConfig, times_ns: IntArray, offset_s: float
) -> CaptureError:
    """Return the error for a camera that has no frame between start_s and end_s."""
    first, last = times_ns[0] / 1e9 + offset_s, times_ns[-1] / 1e9 + offset_s
    return CaptureError(
        f"camera {config.name} has no frame between start_s and end_s: its video runs from {first:.2f} s to "
        f"{last:.2f} s on the common clock",
        path=config.video[0],
        field="capture.start_s" if spec.start_s is not None else "capture.end_s",
        hint="start_s and end_s are on the common clock: camera time + offset_s",
    )
