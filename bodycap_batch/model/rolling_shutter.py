"""Correct the rolling shutter: move observations to the instant at which the middle row is exposed.

In an image of height h, row r is exposed at the time of the frame plus (r/h − ½) · readout_s. If the image is
rotated by 90°, the rows of the sensor are the columns of the image (`Camera.sideways`). Then, in an image of
width w, column c is exposed at the time of the frame plus (c/w − ½) · readout_s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import invert
from bodycap_batch.model.scene import Map, Registration

_MAX_GAP_FRAMES = 3.0
"""Maximum time between a frame and a neighbouring frame that is used for its image velocity. Unit: the median
frame interval. A neighbouring frame with a larger time difference is not used, because the velocity would be
wrong. The velocity is then computed from the other neighbouring frame. Evidence:
docs/decisions/registration.md."""
_MIN_POINTS = 30
"""Minimum number of observations in a frame. Frames with fewer observations are not used. Origin: a camera
motion has six unknowns, and the observations must determine these unknowns well. Evidence: none."""
_MAX_RESIDUAL_PX = 4.0
"""Maximum residual of an observation, in pixels of an image with a width of 640 pixels. Observations with a
larger residual are not used. Evidence: none."""
_LOSS_PX = 0.5
"""Scale of the Cauchy loss, pixels. Evidence: none."""
_BATCH_ROWS = 1 << 14
"""Number of observations in one batch of projections. Each observation needs a copy of a pose, so small
batches limit the memory."""
_SCREENED_OBSERVATIONS = 100_000
"""Approximate number of observations that are used to decide whether a camera has a rolling shutter. They are
taken from frames spread over the whole video."""
_MIN_APPARENT_S = 0.0005
"""A rolling shutter is visible only if the absolute value of the estimated readout time exceeds this value.
The readout time is estimated from residuals. Unit: seconds. Origin: for a camera with a global shutter, the
estimate is less than 0.0003 s."""
_MIN_SIGMAS = 8.0
"""A rolling shutter is visible only if the absolute value of the estimated readout time exceeds this multiple
of the standard deviation of the estimate. Unit: 1. Evidence: none."""


def image_velocity(
    camera: Camera, map_from_cam: FloatArray, times_ns: IntArray, frame: IntArray, points: FloatArray
) -> FloatArray:
    """Compute the image velocities of map points from the poses of the previous and the next frame.

    Args:
        camera: The camera model.
        map_from_cam: (N,4,4) poses of all frames; NaN for a frame without a pose.
        times_ns: (N,) frame times, nanoseconds.
        frame: (M,) frame index of each observation.
        points: (M,3) observed map point of each observation, in the map frame.

    Returns:
        The velocities (M,2), px/s. A velocity is zero if the point is behind the camera, or if no
        neighbouring frame is usable. A neighbouring frame is usable if it has a pose and is near in time.
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
    """Find the frames whose neighbouring frames have a pose and are near in time.

    Returns:
        Two masks (N,): True if the previous frame is usable, and True if the next frame is usable.
    """
    interval_ns = np.diff(times_ns)
    is_near = interval_ns <= _MAX_GAP_FRAMES * np.median(interval_ns) if len(interval_ns) else interval_ns > 0
    missing = np.zeros(1, dtype=bool)
    return np.concatenate([missing, is_near & has_pose[:-1]]), np.concatenate(
        [is_near & has_pose[1:], missing]
    )


def _project_in_frames(
    camera: Camera, cam_from_map: FloatArray, frame: IntArray, points: FloatArray
) -> FloatArray:
    """Project map points into frames, in batches.

    Args:
        camera: The camera model.
        cam_from_map: (N,4,4) inverse poses of all frames; NaN for a frame without a pose.
        frame: (M,) index of the frame that each point is projected into.
        points: (M,3) points in the map frame.

    Returns:
        The pixels (M,2).
    """
    out = np.empty((len(frame), 2))
    for start in range(0, len(frame), _BATCH_ROWS):
        batch = slice(start, start + _BATCH_ROWS)
        pose = cam_from_map[frame[batch]]
        x_in_cam = np.einsum("mij,mj->mi", pose[:, :3, :3], points[batch]) + pose[:, :3, 3]
        out[batch] = camera.project(x_in_cam)
    return out


def row_delay(camera: Camera, px: FloatArray) -> FloatArray:
    """Return the exposure time (M,) of each pixel minus the frame time, as a multiple of the readout time.

    The values are between −½ and ½.
    """
    position = px[:, 0] / camera.width_px if camera.sideways else px[:, 1] / camera.height_px
    return np.asarray(position - 0.5, dtype=np.float64)


def mean_row_fraction(registration: Registration, camera: Camera) -> FloatArray:
    """Return the mean image row of the observations in each frame, as a fraction of the image height.

    If the rows of the sensor are the columns of the image, the function returns the mean image column, as a
    fraction of the image width.

    Args:
        registration: The poses and observations of one camera.
        camera: The camera model of this camera.

    Returns:
        (N,) fraction for each frame: 0.5 for a frame with a pose but without observations, NaN for a frame
        without a pose.
    """
    frame_count = len(registration.trajectory.status)
    observed = np.bincount(registration.obs_frame, minlength=frame_count)
    fraction = row_delay(camera, registration.obs_px.astype(np.float64)) + 0.5
    total = np.bincount(registration.obs_frame, weights=fraction, minlength=frame_count)
    mean = np.full(frame_count, 0.5)
    np.divide(total, observed, out=mean, where=observed > 0)
    return np.where(registration.trajectory.localised, mean, np.nan)


def px_at_mid_row(camera: Camera, px: FloatArray, velocity_px_s: FloatArray, readout_s: float) -> FloatArray:
    """Compute where observed pixels would be if the whole image were exposed together with its middle row.

    Args:
        camera: The camera model.
        px: (M,2) observed pixels.
        velocity_px_s: (M,2) image velocities, px/s.
        readout_s: Readout time, seconds.

    Returns:
        The moved pixels (M,2).
    """
    return np.asarray(px - velocity_px_s * (row_delay(camera, px) * readout_s)[:, None])


def has_visible_rolling_shutter(
    registration: Registration, maps: Sequence[Map], *, allow_sideways: bool = False
) -> bool:
    """Return True if the residuals of a camera's tracks show that the camera has a rolling shutter.

    The readout time estimated from the residuals is below 0.3 ms for a global shutter. It is about 3 ms for a
    rolling shutter with a true readout time of 24 ms.

    Args:
        registration: The poses and tracks of the camera.
        maps: The maps, including the map that the poses refer to.
        allow_sideways: True to test both directions, because the rows of the sensor may be the columns of
            the image.
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
    """Estimate the part of the readout time that is still visible in the residuals.

    A rolling shutter shifts each observation. The shift is proportional to the image velocity and to the
    distance of the image row from the middle row. The residuals (observed minus projected) show only a part
    of these shifts:

    - The estimated pose has absorbed the part that looks like a small camera motion. Therefore a small camera
      motion is fitted in each frame, both to the expected shifts and to the residuals, and is subtracted.
    - The map has absorbed another part. Therefore the estimate is only a lower bound of the readout time. It
      is good enough for detecting a rolling shutter, but not for correcting it.

    Args:
        camera: The camera model.
        frame: (M,) frame index of each observation, sorted.
        px: (M,2) observed pixels.
        residual_px: (M,2) residuals, pixels.
        velocity_px_s: (M,2) image velocities, px/s, from `image_velocity`.

    Returns:
        The readout time and its standard deviation, seconds; (0, inf) if there are too few observations.
    """
    keep = np.linalg.norm(residual_px, axis=1) < _MAX_RESIDUAL_PX * camera.width_px / 640.0
    frame, px, residual_px, velocity_px_s = frame[keep], px[keep], residual_px[keep], velocity_px_s[keep]
    signal = velocity_px_s * row_delay(camera, px)[:, None]
    x = (px - (0.5 * camera.width_px, 0.5 * camera.height_px)) / camera.width_px
    bounds = np.flatnonzero(np.diff(frame, prepend=-1, append=-1))
    signals, residuals = [np.zeros(0)], [np.zeros(0)]
    for start, stop in pairwise(bounds.tolist()):
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
    """Return the image motions (2N,6) that six basic small camera motions cause at N pixels.

    There is one column for each camera motion: two shifts, scale, roll and two tilts. Each pixel has two
    rows: its motions along x and y.
    """
    out = np.zeros((2 * len(x), 6))
    out[0::2, 0] = out[1::2, 1] = 1.0
    out[0::2, 2], out[1::2, 2] = x[:, 0], x[:, 1]
    out[0::2, 3], out[1::2, 3] = -x[:, 1], x[:, 0]
    out[0::2, 4], out[1::2, 4] = x[:, 0] ** 2, x[:, 0] * x[:, 1]
    out[0::2, 5], out[1::2, 5] = x[:, 0] * x[:, 1], x[:, 1] ** 2
    return out
