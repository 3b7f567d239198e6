"""Nuke's .chan files: the animation of one camera, one line for each frame.

The columns are: frame, translation x, y, z, rotation x, y, z in degrees, vertical field of view in degrees.
The axes are Nuke's: Y up, and the camera looks along −Z. The format has no place for rate, picture size, unit
or comments.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.formats.atomic_files import write_text
from bodycap_batch.formats.bvh.euler import continuous_angles, rotation_from_angles
from bodycap_batch.formats.y_up import camera_poses_with_y_up, poses_from_y_up
from bodycap_batch.model.animated_camera import AnimatedCamera

FIRST_FRAME = 1
"""Number of the first frame in the file. Origin: Nuke's scripts begin at frame 1."""

_LEFTMOST_FIRST = "YXZ"
"""Axes of the rotations, the leftmost matrix first. Nuke calls this order ZXY, because the rotation about Z
acts first. It is the default of Nuke's cameras."""


def write_chan(path: Path, camera: AnimatedCamera) -> Path:
    """Write the poses of a camera. Frames that are not valid have no line.

    Returns:
        The path of the file.

    Raises:
        StoreError: The file cannot be written.
    """
    frames = np.flatnonzero(camera.valid)
    poses = camera_poses_with_y_up(camera)[frames]
    y, x, z = np.degrees(continuous_angles((_LEFTMOST_FIRST,), poses[:, None, :3, :3])[:, 0]).T
    fov = np.full(len(frames), np.degrees(camera.vertical_fov_rad))
    rows = np.column_stack([poses[:, :3, 3], x, y, z, fov]) + 0.0
    line = "%d" + rows.shape[1] * " %.8f" + "\n"
    numbers = (frames + FIRST_FRAME).tolist()
    write_text(path, "".join(line % (number, *row) for number, row in zip(numbers, rows, strict=True)))
    return path


def read_chan(path: Path) -> tuple[IntArray, float, FloatArray]:
    """Read a file that `write_chan` has written.

    Returns:
        The frames (N,), counted from 0, the vertical field of view, radians, and the poses (N,4,4) of the
        camera's axes of computer graphics in the scene.
    """
    rows = np.loadtxt(path, ndmin=2)
    angles = np.radians(rows[:, [5, 4, 6]])
    rotation = rotation_from_angles(_LEFTMOST_FIRST, angles)
    frames = rows[:, 0].astype(np.int64) - FIRST_FRAME
    return frames, float(np.radians(rows[0, 7])), poses_from_y_up(rotation, rows[:, 1:4])
