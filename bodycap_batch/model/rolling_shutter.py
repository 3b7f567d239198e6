"""Correct the rolling shutter: move observations to the instant of the middle row.

Image row r of h is exposed at the frame's time + (r/h − ½) · readout_s. If a quarter turn lets the sensor's
rows run along the image columns (`Camera.sideways`), column c of w is exposed at (c/w − ½) · readout_s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import invert
from bodycap_batch.model.scene import Map, Registration

_MAX_GAP_FRAMES = 3.0
"""Largest distance to a neighbouring frame that gives a velocity, in frame intervals. Beyond it only the
other neighbour is used, because the velocity over a hole in the video is wrong. Evidence:
docs/decisions/registration.md."""
_MIN_POINTS = 30
"""Least observations of a frame. Origin: the camera motion takes six unknowns. Evidence: none."""
_MAX_RESIDUAL_PX = 4.0
"""Pixels at 640 px image width: larger residuals are ignored. Evidence: none."""
_LOSS_PX = 0.5
"""Pixels: scale of the Cauchy loss. Evidence: none."""
_BATCH_ROWS = 1 << 14
"""Observations projected at a time, each with a pose of its own. It bounds the memory."""
_SCREENED_OBSERVATIONS = 100_000
"""About the number of observations used, from frames spread over the video. They are enough for a
decision."""
_MIN_APPARENT_S = 0.0005
"""Seconds: least readout time in the residuals that shows a rolling shutter. Origin: a global shutter shows
less than 0.0003 s."""
_MIN_SIGMAS = 8.0
"""Least significance of it, in standard deviations. Evidence: none."""


def image_velocity(
    camera: Camera, map_from_cam: FloatArray, times_ns: IntArray, frame: IntArray, points: FloatArray
) -> FloatArray:
    """Return the velocity (M,2) in px/s of map points in the image, from the poses of neighbouring frames.

    Args:
        camera: The camera model.
        map_from_cam: (N,4,4) poses of all frames, NaN if there is none.
        times_ns: (N,) frame times.
        frame: (M,) frame of each observation.
        points: (M,3) the observed point.

    Returns:
        Zero if neither neighbour has a pose and is near in time, or if the point is behind it.
    """
    has_pose: BoolArray = np.asarray(np.isfinite(map_from_cam).all(axis=(1, 2)))
    cam_from_map = np.full_like(map_from_cam, np.nan)
    cam_from_map[has_pose] = invert(map_from_cam[has_pose])
    out = np.empty((len(frame), 2))
    has_before, has_after = _usable_neighbours(has_pose, times_ns)
    for start in range(0, len(frame), _BATCH_ROWS):
        batch = slice(start, start + _BATCH_ROWS)
        before, after = frame[batch] - has_before[frame[batch]], frame[batch] + has_after[frame[batch]]
        elapsed_s = (times_ns[after] - times_ns[before]) * 1e-9
        later, earlier = (
            _project_in_frames(camera, cam_from_map, at, points[batch]) for at in (after, before)
        )
        velocity = (later - earlier) / np.where(elapsed_s > 0, elapsed_s, np.inf)[:, None]
        out[batch] = np.nan_to_num(velocity, posinf=0.0, neginf=0.0)
    return out


def _usable_neighbours(has_pose: BoolArray, times_ns: IntArray) -> tuple[BoolArray, BoolArray]:
    """Return which frames (N,) have a previous, and which a next, frame with a pose near in time."""
    interval_ns = np.diff(times_ns)
    is_near = interval_ns <= _MAX_GAP_FRAMES * np.median(interval_ns) if len(interval_ns) else interval_ns > 0
    missing = np.zeros(1, dtype=bool)
    return np.concatenate([missing, is_near & has_pose[:-1]]), np.concatenate(
        [is_near & has_pose[1:], missing]
    )


def _project_in_frames(
    camera: Camera, cam_from_map: FloatArray, frame: IntArray, points: FloatArray
) -> FloatArray:
    """Project points (M,3), each into a frame of its own, to pixels (M,2), in batches."""
    out = np.empty((len(frame), 2))
    for start in range(0, len(frame), _BATCH_ROWS):
        batch = slice(start, start + _BATCH_ROWS)
        pose = cam_from_map[frame[batch]]
        x_in_cam = np.einsum("mij,mj->mi", pose[:, :3, :3], points[batch]) + pose[:, :3, 3]
        out[batch] = camera.project(x_in_cam)
    return out


def row_delay(camera: Camera, px: FloatArray) -> FloatArray:
    """Return the exposure time (M,) of pixels (M,2) relative to the frame's time, over the readout time."""
    position = px[:, 0] / camera.width_px if camera.sideways else px[:, 1] / camera.height_px
    return np.asarray(position - 0.5, dtype=np.float64)


def mean_row_fraction(registration: Registration, camera: Camera) -> FloatArray:
    """Return the mean image row of the observations behind each pose, over the image height.

    If the sensor's rows run along the image columns, it is the mean column over the width.

    Args:
        registration: The poses and observations of one camera.
        camera: Its camera model.

    Returns:
        (N,) one value for each frame: 0.5 for a pose without observations, NaN for a frame without a pose.
    """
    frame_count = len(registration.trajectory.status)
    observed = np.bincount(registration.obs_frame, minlength=frame_count)
    fraction = row_delay(camera, registration.obs_px.astype(np.float64)) + 0.5
    total = np.bincount(registration.obs_frame, weights=fraction, minlength=frame_count)
    mean = np.full(frame_count, 0.5)
    np.divide(total, observed, out=mean, where=observed > 0)
    return np.where(registration.trajectory.localised, mean, np.nan)


def px_at_mid_row(camera: Camera, px: FloatArray, velocity_px_s: FloatArray, readout_s: float) -> FloatArray:
    """Return the pixels (M,2) at the instant of the middle row, given their velocities (M,2) in px/s."""
    return np.asarray(px - velocity_px_s * (row_delay(camera, px) * readout_s)[:, None])


def has_visible_rolling_shutter(
    registration: Registration, maps: Sequence[Map], *, allow_sideways: bool = False
) -> bool:
    """Return True if a rolling shutter shows in the residuals of a camera's tracks.

    A global shutter shows less than 0.3 ms; a readout time of 24 ms shows 3 ms.

    Args:
        registration: The poses and tracks of the camera.
        maps: The maps they belong to.
        allow_sideways: Test both directions: the sensor's rows may run along the image columns.
    """
    path = registration.trajectory
    scene_map = next((item for item in maps if item.gauge == path.gauge), None)
    if scene_map is None:
        return False
    stride = max(1, len(registration.obs_frame) // _SCREENED_OBSERVATIONS)
    chosen = np.flatnonzero(path.localised[registration.obs_frame] & (registration.obs_frame % stride == 0))
    chosen = chosen[np.argsort(registration.obs_frame[chosen], kind="stable")]
    point = scene_map.points_of(
        path.camera, registration.obs_keyframe[chosen], registration.obs_feature[chosen]
    )
    has_point, points = chosen[point >= 0], scene_map.points[point[point >= 0]]
    frame, px = registration.obs_frame[has_point], registration.obs_px[has_point].astype(float)
    lens = scene_map.cameras[path.camera]
    pose = np.full_like(path.gauge_from_cam, np.nan)
    pose[path.localised] = invert(path.gauge_from_cam[path.localised])
    residual = np.nan_to_num(px - _project_in_frames(lens, pose, frame, points), nan=np.inf)
    velocity = image_velocity(lens, path.gauge_from_cam, path.times_ns, frame, points)
    for sideways in (False, True) if allow_sideways else (lens.sideways,):
        candidate = replace(lens, sideways=sideways)
        readout_s, sigma_s = estimate_residual_readout(candidate, frame, px, residual, velocity)
        if abs(readout_s) > max(_MIN_APPARENT_S, _MIN_SIGMAS * sigma_s):
            return True
    return False


def estimate_residual_readout(
    camera: Camera, frame: IntArray, px: FloatArray, residual_px: FloatArray, velocity_px_s: FloatArray
) -> tuple[float, float]:
    """Estimate the part of the readout time that poses and points have not absorbed.

    With a rolling shutter the residuals (observed minus projected) grow with row times velocity. The part
    that a similarity and a tilt of the image explain is removed from both, frame by frame, because the pose
    has absorbed it. The map absorbs more. The value is therefore a lower bound, which suits a test and not a
    correction.

    Args:
        camera: The camera model.
        frame: (M,) frame of each observation, sorted.
        px: (M,2) observed pixel.
        residual_px: (M,2) residual.
        velocity_px_s: (M,2) from `image_velocity`.

    Returns:
        Seconds and their standard deviation; (0, inf) if there are too few observations.
    """
    keep = np.linalg.norm(residual_px, axis=1) < _MAX_RESIDUAL_PX * camera.width_px / 640.0
    frame, px, residual_px, velocity_px_s = frame[keep], px[keep], residual_px[keep], velocity_px_s[keep]
    signal = velocity_px_s * row_delay(camera, px)[:, None]
    x = (px - (0.5 * camera.width_px, 0.5 * camera.height_px)) / camera.width_px
    starts = np.flatnonzero(np.diff(frame, prepend=-1))
    signals, residuals = [np.zeros(0)], [np.zeros(0)]
    for start, stop in zip(starts, [*starts[1:], len(frame)], strict=True):
        if stop - start >= _MIN_POINTS:
            basis, _ = np.linalg.qr(_camera_motion_basis(x[start:stop]))
            for collected, values in ((signals, signal), (residuals, residual_px)):
                flat = values[start:stop].ravel()
                collected.append(flat - basis @ (basis.T @ flat))
    signals_all, residuals_all = np.concatenate(signals), np.concatenate(residuals)
    weight = 1.0 / (1.0 + (residuals_all / _LOSS_PX) ** 2)
    information = float((weight * signals_all * signals_all).sum())
    if information <= 0.0:
        return 0.0, float("inf")
    readout_s = float((weight * signals_all * residuals_all).sum()) / information
    variance = float((weight * (residuals_all - readout_s * signals_all) ** 2).sum() / weight.sum())
    return readout_s, float(np.sqrt(variance / information))


def _camera_motion_basis(x: FloatArray) -> FloatArray:
    """Return the image motions (2N,6) of a small camera motion: shift, scale, roll, and the two tilts."""
    out = np.zeros((2 * len(x), 6))
    out[0::2, 0] = out[1::2, 1] = 1.0
    out[0::2, 2], out[1::2, 2] = x[:, 0], x[:, 1]
    out[0::2, 3], out[1::2, 3] = -x[:, 1], x[:, 0]
    out[0::2, 4], out[1::2, 4] = x[:, 0] ** 2, x[:, 0] * x[:, 1]
    out[0::2, 5], out[1::2, 5] = x[:, 0] * x[:, 1], x[:, 1] ** 2
    return out
