"""A motion from a BVH file that can be evaluated at any time."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.errors import JobError
from bodycap_batch.formats.bvh import inspect_rig
from bodycap_batch.model.geometry import interpolate_pose, make_transform
from bodycap_batch.model.skeleton import Motion, SkeletonModel, forward_kinematics
from bodycap_batch.model.skeleton_presets import MEAN_HEIGHT_M, is_plausible_stature, stature_from_limbs

logger = logging.getLogger(__name__)


class Clip:
    """A recorded motion that gives the pose of the body at any time, by interpolation between its frames.

    Rotations are interpolated by slerp, positions linearly. The pose is constant before and after the
    recording.

    Args:
        motion: The recorded motion.
        start_s: Time (seconds) in the recording at which the capture's common clock is zero.
        length_s: Duration of the capture, seconds. The motion is shifted: the path of the root during
            the capture is then centred in the room, and the lowest joint is on the floor.
    """

    def __init__(self, motion: Motion, start_s: float, length_s: float) -> None:
        self.skeleton: SkeletonModel = motion.skeleton
        first = int(start_s * motion.fps)
        used = slice(first, first + max(2, int(np.ceil(length_s * motion.fps)) + 1))
        poses = forward_kinematics(motion.skeleton, motion.root_in_world_m[used], motion.local_rotation[used])
        root_path = poses[:, 0, :3, 3]
        middle = (root_path.min(axis=0) + root_path.max(axis=0)) / 2
        middle[2] = poses[:, :, 2, 3].min()
        self._start_s, self._fps = start_s, motion.fps
        self._local = make_transform(motion.local_rotation, np.zeros(3))
        self._local[:, 0, :3, 3] = motion.root_in_world_m - middle

    def pose(self, t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return root positions (T,3) in the world (m) and local rotations (T,J,3,3) at common times (T,)."""
        frame = np.clip((t_s + self._start_s) * self._fps, 0, len(self._local) - 1)
        before = np.minimum(frame.astype(np.int64), max(len(self._local) - 2, 0))
        after = np.minimum(before + 1, len(self._local) - 1)
        alpha = np.broadcast_to((frame - before)[:, None], (len(frame), self._local.shape[1]))
        poses = interpolate_pose(self._local[before], self._local[after], alpha)
        return np.asarray(poses[:, 0, :3, 3]), np.asarray(poses[..., :3, :3])


def load_clip(path: Path, start_s: float, length_s: float, height_m: float = MEAN_HEIGHT_M) -> Clip:
    """Read a BVH file as the motion of a capture.

    Args:
        path: Path of the BVH file.
        start_s: Time (seconds) in the recording at which the capture's common clock is zero.
        length_s: Duration of the capture, seconds.
        height_m: Stature (metres) of the body if the file is neither in metres nor in centimetres.

    Raises:
        JobError: The file cannot be read, holds no motion or no pose of a body, or is too short.
    """
    _, motion, problem = inspect_rig(path)
    if problem is not None and problem.field != "skeleton":  # a wrong size is corrected below
        raise problem
    if motion is None or len(motion.root_in_world_m) < 2:
        raise JobError(
            "the file contains no motion",
            path=path,
            field="motion",
            hint="give a BVH file with two frames or more",
        )
    lasts = (len(motion.root_in_world_m) - 1) / motion.fps
    if start_s + length_s > lasts + 1.5 / motion.fps:
        raise JobError(
            f"the motion in the file lasts {lasts:.2f} s, but the capture needs the part from "
            f"{start_s:.2f} to {start_s + length_s:.2f} s",
            path=path,
            field="motion",
            hint="set seconds or motion_start_s to a smaller value",
        )
    return Clip(_with_plausible_size(motion, path, height_m), start_s, length_s)


def _with_plausible_size(motion: Motion, path: Path, height_m: float) -> Motion:
    """Return a motion whose body has the size of a person.

    Recordings of the CMU Graphics Lab Motion Capture Database have a unit of length of 5.6 cm. Read in
    centimetres, such a body has a stature of 30 cm.

    Args:
        motion: The motion as read in metres or centimetres.
        path: Path of the BVH file.
        height_m: Stature of the body, metres, if its own size is not that of a person.
    """
    stature_m = stature_from_limbs(motion.skeleton)
    if stature_m is None or stature_m <= 0.0 or is_plausible_stature(stature_m):
        return motion
    factor = height_m / stature_m
    logger.warning(
        "%s: the body has a stature of %.3g m in metres or centimetres; therefore its size is multiplied by "
        "%.4g, which gives a stature of %.3g m",
        path.name,
        stature_m,
        factor,
        height_m,
    )
    body = motion.skeleton
    hips = motion.hips_in_root_m
    return replace(
        motion,
        skeleton=replace(body, offsets_m=factor * body.offsets_m, end_offsets_m=factor * body.end_offsets_m),
        root_in_world_m=factor * motion.root_in_world_m,
        hips_in_root_m=None if hips is None else factor * hips,
    )
