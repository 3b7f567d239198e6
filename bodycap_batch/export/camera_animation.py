"""Collect the animated cameras: for each frame, the pose of the picture that is shown at this frame."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.export.export_inputs import ExportInputs
from bodycap_batch.export.far_points import is_far
from bodycap_batch.export.take_time import frame_times_ns, frames_without_motion, take_of_motion
from bodycap_batch.export.target_frames import (
    WORLD,
    describe_target,
    main_target_name,
    maps_in_target_frames,
    trajectories_in_target_frames,
)
from bodycap_batch.formats.ply import Colors
from bodycap_batch.model.animated_camera import AnimatedCamera, CameraScene
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.camera_clock import CameraClock
from bodycap_batch.model.frame_choice import nearest_frames
from bodycap_batch.model.geometry import interpolate_pose
from bodycap_batch.model.pinhole import pinhole_of
from bodycap_batch.model.scene import FrameStatus, Trajectory
from bodycap_batch.model.skeleton import Motion
from bodycap_batch.model.take import Take


def collect_camera_scene(
    inputs: ExportInputs, motion: Motion | None, fps: float | None, left_out: list[str]
) -> CameraScene | None:
    """Return the cameras of the main target frame with a pose at each frame, and the points of the room.

    Args:
        inputs: The results of the earlier stages.
        motion: The motion in the layout of the files for animation: its ticks are the frames. None without a
            body; the frames are then those of a camera.
        fps: Frames per second without a body; None for the rate of this camera.
        left_out: Receives a sentence for the user about each camera whose poses are in another frame, and
            about missing files.

    Returns:
        The scene; None if no camera has a pose in the main target frame.
    """
    target = main_target_name(inputs)
    posed = [
        path
        for path in trajectories_in_target_frames(inputs)
        if (path.localised | path.rotation_only).any() and lens_of(inputs, path.camera) is not None
    ]
    paths = [path for path in posed if path.gauge == target]
    if not paths:
        left_out.append(f"the files of the cameras are not written: no camera has a pose in {target}")
        return None
    left_out += [
        f"the files of the cameras do not contain {path.camera}: its poses are not in {target}"
        for path in posed
        if path.gauge != target
    ]
    if motion is None:
        take, count = frames_without_motion(inputs, [path.camera for path in paths], fps)
    else:
        take, count = take_of_motion(inputs, motion), len(motion.root_in_world_m)
    points, colors = _room(inputs, target)
    return CameraScene(
        take=take,
        frame_of_reference=describe_target(target),
        is_metric=target == WORLD,
        cameras=tuple(_animated(inputs, path, take, count) for path in paths),
        points=points,
        colors=colors,
    )


def lens_of(inputs: ExportInputs, camera: str) -> Camera | None:
    """Return the lens of a camera at the work size; None if no map contains the camera."""
    return next((scene.cameras[camera] for scene in inputs.maps if camera in scene.cameras), None)


def picture_size(lens: Camera, shown: tuple[int, int] | None) -> tuple[int, int]:
    """Return the size of the undistorted picture of a camera: that of the video, in even numbers.

    Args:
        lens: The lens at the work size.
        shown: Width and height of the shown video, pixels; None if they are unknown.
    """
    width, height = shown or (lens.width_px, lens.height_px)
    return max(2, width - width % 2), max(2, height - height % 2)  # the colours of H.264 have half the size


def _animated(inputs: ExportInputs, path: Trajectory, take: Take, count: int) -> AnimatedCamera:
    """Return one camera with its pose at each frame: that of the nearest picture that can be shown."""
    lens, clock = lens_of(inputs, path.camera), inputs.clocks[path.camera]
    assert lens is not None
    video = inputs.videos.get(path.camera)
    common = clock.common_times_ns(path.times_ns)
    frames = frame_times_ns(take, count)
    pictures = np.flatnonzero([status is not FrameStatus.DAMAGED for status in path.status])
    shown = nearest_frames(common[pictures], frames, clock.nominal_fps)
    shown = np.where(shown >= 0, pictures[shown], -1)
    is_measured = path.localised | path.rotation_only
    valid = (shown >= 0) & is_measured[shown]
    poses = _middle_row_poses(path, clock, inputs.row_fraction.get(path.camera))
    size = picture_size(lens, None if video is None else (video.width_px, video.height_px))
    return AnimatedCamera(
        name=path.camera,
        pinhole=pinhole_of(lens, *size),
        scene_from_cam=poses[_held(shown, valid, is_measured)],
        valid=valid,
        video_frame=np.where(shown >= 0, path.frame_numbers[shown], -1),
        shift_s=np.where(shown >= 0, (common[shown] - frames) * 1e-9, np.nan),
        sigma_rad=_sigma(path.covariance[shown, :3, :3], valid),
        sigma_position=_sigma(path.covariance[shown, 3:, 3:], valid),
        clock_is_known=clock.is_known,
    )


def _held(shown: IntArray, valid: BoolArray, is_measured: BoolArray) -> IntArray:
    """Return the index (T,) of the pose of each frame: that of the last valid frame, else the first one."""
    if not valid.any():  # the camera was localised, but not while the body moves
        return np.full(len(shown), np.flatnonzero(is_measured)[0], dtype=np.int64)
    latest = np.maximum.accumulate(np.where(valid, np.arange(len(shown)), -1))
    return np.asarray(shown[np.where(latest >= 0, latest, np.argmax(valid))])


def _middle_row_poses(path: Trajectory, clock: CameraClock, row_fraction: FloatArray | None) -> FloatArray:
    """Return the poses (N,4,4) at the exposure of the middle row, NaN for lost frames.

    A frame with a rotation alone is at the origin. Poses of cameras whose rolling shutter the map did not
    correct are valid at the mean row of their observations. They are moved along the path to the neighbouring
    frame, if it was localised.

    Args:
        path: The poses and their times.
        clock: The clock of the camera, with its readout time.
        row_fraction: (N,) mean row of the observations, as in `ExportInputs`; None for the middle row.
    """
    poses = path.poses_at_origin()
    if row_fraction is None or not clock.rolling_shutter_s:
        return poses
    later_s = np.nan_to_num(row_fraction - 0.5) * clock.rolling_shutter_s
    at_s = path.times_ns * 1e-9 + later_s
    index = np.flatnonzero(path.localised & (later_s != 0.0))
    other = index - np.sign(later_s[index]).astype(np.int64)
    inside = (other >= 0) & (other < len(poses))
    inside[inside] = path.localised[other[inside]]
    index, other = index[inside], other[inside]
    share = (path.times_ns[index] * 1e-9 - at_s[index]) / (at_s[other] - at_s[index])
    near = (share >= 0.0) & (share <= 1.0)
    index, other, share = index[near], other[near], share[near]
    original = path.gauge_from_cam
    poses[index] = interpolate_pose(original[index], original[other], share)
    return poses


def _sigma(covariance: FloatArray, valid: BoolArray) -> FloatArray:
    """Return the standard deviation (T,) per axis of covariances (T,3,3); NaN if a frame is not valid."""
    variance = np.trace(covariance, axis1=1, axis2=2) / 3.0
    return np.where(valid, np.sqrt(np.maximum(variance, 0.0)), np.nan)


def _room(inputs: ExportInputs, target: str) -> tuple[FloatArray, Colors]:
    """Return the points of the room in the main target frame, without far points, and their colours."""
    points, colors = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.uint8)]
    for item in maps_in_target_frames(inputs):
        if item.target == target:
            near = ~is_far(item.scene)
            points.append(item.points()[near])
            colors.append(item.scene.colors[near])
    return np.concatenate(points), np.concatenate(colors)
