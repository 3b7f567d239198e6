"""Open the videos of a capture: list their frames, and compute frame times and intrinsics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodycap_batch.capture.cameras import Capture, CaptureCamera
from bodycap_batch.capture.frame_index import index_videos
from bodycap_batch.capture.initial_intrinsics import guessed_camera, work_camera, work_size_of
from bodycap_batch.capture.lens_choice import chosen_lens
from bodycap_batch.capture.masks import read_mask
from bodycap_batch.capture.timeline import join_chapters
from bodycap_batch.capture.video import VideoFile, spherical_error
from bodycap_batch.config.calibration import Calibration
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.core.arrays import BoolArray, IntArray
from bodycap_batch.core.errors import CaptureError

_MAX_RATE_CHANGE = 1.5
"""Maximum ratio of the nominal frame rate to the rate of the frame times, or its inverse, at which the former
is kept. Origin: cameras drop frames, and slow motion has a ratio of 2 or more."""


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
    videos = index_videos(config.video)
    for video in videos:
        if video.projection:
            raise spherical_error(video.path, video.projection)
    _check_one_format(videos)
    timeline = join_chapters(videos, config.timestamps)
    used = timeline.usable
    # Without a known clock, nothing says which frames are between start_s and end_s, so all are used.
    if config.offset_s is not None:
        used = used & _in_time_range(timeline.times_ns, config.offset_s, spec)
        if not used.any():
            raise _no_frames_error(spec, config, timeline.times_ns, config.offset_s)
    calibration = config.calibration if isinstance(config.calibration, Calibration) else None
    lens = chosen_lens(config, videos[0])
    if calibration is not None:
        camera = work_camera(calibration, videos[0], spec.work_px)
    elif lens is not None:
        camera = lens.profile.first_guess(work_size_of(videos[0], spec.work_px))
    else:
        camera = guessed_camera(videos[0], spec.work_px, config.fov_deg)
    return CaptureCamera(
        name=config.name,
        chapters=config.video,
        camera=replace(
            camera, sideways=_is_quarter_turned(videos[0]) and config.rolling_shutter_s is not None
        ),
        calibrated=calibration is not None,
        frame_numbers=np.flatnonzero(used),
        times_ns=timeline.times_ns[used],
        nominal_fps=_real_fps(videos[0], timeline.times_ns),
        rolling_shutter_s=_shown_rolling_shutter_s(config.rolling_shutter_s or 0.0, videos[0]),
        rolling_shutter_known=config.rolling_shutter_s is not None,
        # Sensors are wider than they are high. Therefore a picture that is higher than wide was rotated by
        # 90°, by the camera or by the person who edited the video.
        may_be_sideways=_is_quarter_turned(videos[0]) or camera.height_px > camera.width_px,
        notes=(
            *_missing_end_notes(videos),
            *timeline.notes,
            *_late_start_notes(spec, config, timeline.times_ns),
            *([] if lens is None or not lens.note else [lens.note]),
        ),
        videos=videos,
        threads=threads,
        mask=None
        if config.mask is None
        else read_mask(config.mask, (camera.width_px, camera.height_px), videos[0].turned_size),
    )


def _missing_end_notes(videos: tuple[VideoFile, ...]) -> list[str]:
    """Return a note for the user about each chapter whose end is missing."""
    return [
        f"{video.path.name}: {video.missing_end}; the video is used up to its last whole frame, at "
        f"{video.length_s:.2f} s: to get the rest, copy the video again from the camera's card"
        for video in videos
        if video.missing_end
    ]


def _real_fps(video: VideoFile, times_ns: IntArray) -> float:
    """Return the nominal frame rate of the file, or the rate of the frame times if it is much different."""
    steps = np.diff(times_ns[: len(video.pts)])
    if not len(steps):
        return video.fps
    fps = 1e9 / float(np.median(steps))
    return video.fps if fps / _MAX_RATE_CHANGE < video.fps < fps * _MAX_RATE_CHANGE else fps


def _late_start_notes(spec: CaptureConfig, config: CameraConfig, times_ns: IntArray) -> list[str]:
    """Return a note if clocks are stated to agree, and the file states that its first frame is late."""
    late_s = float(times_ns[0]) / 1e9
    if spec.clocks != "common" or config.offset_s or config.timestamps or not late_s:
        return []
    return [
        f"the first picture is {late_s:.3f} s after the start of the file, as the file states, and this is "
        f"used. If the first pictures of all videos show the same moment, set offset_s: {-late_s:.3f}"
    ]


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
                f"this chapter has pictures of {video.shown_size[0]}×{video.shown_size[1]} pixels, but the "
                f"first chapter has pictures of {videos[0].shown_size[0]}×{videos[0].shown_size[1]} pixels",
                path=video.path,
                hint="list only chapters of one recording for a camera; list this video as another camera",
            )


def _in_time_range(times_ns: IntArray, offset_s: float, spec: CaptureConfig) -> BoolArray:
    """Return a mask (N,) that is True for frames between start_s and end_s on the common clock."""
    common = times_ns + round(offset_s * 1e9)
    first = -np.inf if spec.start_s is None else round(spec.start_s * 1e9)
    last = np.inf if spec.end_s is None else round(spec.end_s * 1e9)
    return np.asarray((common >= first) & (common <= last))


def _no_frames_error(
    spec: CaptureConfig, config: CameraConfig, times_ns: IntArray, offset_s: float
) -> CaptureError:
    """Return the error for a camera that has no frame between start_s and end_s."""
    first, last = times_ns[0] / 1e9 + offset_s, times_ns[-1] / 1e9 + offset_s
    return CaptureError(
        f"camera {config.name} has no frame between start_s and end_s: on the common clock, its video runs "
        f"from {first:.2f} s to {last:.2f} s",
        path=config.video[0],
        field="capture.start_s" if spec.start_s is not None else "capture.end_s",
        hint="set start_s and end_s on the common clock (common time = camera time + offset_s)",
    )
