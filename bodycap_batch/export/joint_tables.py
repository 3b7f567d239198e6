"""``joints.csv`` and ``joints.npz``: the pose of every joint at every tick."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.formats.atomic_files import atomic_replacement, write_text
from bodycap_batch.formats.dataclass_files import write_npz
from bodycap_batch.formats.tum import seconds_text
from bodycap_batch.model.geometry import continuous_quat_xyzw
from bodycap_batch.model.skeleton import Motion

COLUMNS = "time,joint,x_m,y_m,z_m,qx,qy,qz,qw,local_qx,local_qy,local_qz,local_qw,observed,sigma_m"


def write_joint_table(path: Path, motion: Motion, sigma_m: FloatArray | None = None) -> Path:
    """Write one line per tick and joint as CSV, and return the path.

    The columns are: common time in seconds; position and orientation in the world (world_from_joint);
    rotation in the frame of the parent; whether cameras measured the joint; `sigma_m`, empty if unknown.

    Args:
        path: The file.
        motion: The motion in the world.
        sigma_m: (T,J) standard deviation per axis of each joint's centre relative to the first solved
            joint's; NaN if unknown.

    Raises:
        StoreError: The file cannot be written.
    """
    poses = motion.world_from_joint()
    world = continuous_quat_xyzw(poses[..., :3, :3])
    local = continuous_quat_xyzw(motion.local_rotation)
    numbers = np.concatenate([poses[..., :3, 3], world, local], axis=-1).round(6) + 0.0
    line = "%s,%s," + "%.6f," * numbers.shape[-1] + "%d,%s\n"
    names = [_csv_field(name) for name in motion.skeleton.joints]
    text = io.StringIO()
    text.write(COLUMNS + "\n")
    for tick, time_ns in enumerate(motion.times_ns().tolist()):
        time = seconds_text(time_ns)
        for joint, name in enumerate(names):
            sigma = np.nan if sigma_m is None else sigma_m[tick, joint]
            sigma_text = f"{sigma:.6f}" if np.isfinite(sigma) else ""
            text.write(line % (time, name, *numbers[tick, joint], motion.observed[tick, joint], sigma_text))
    write_text(path, text.getvalue())
    return path


def _csv_field(name: str) -> str:
    """Return a joint name as a CSV field, quoted if necessary."""
    doubled = name.replace('"', '""')
    return f'"{doubled}"' if set(name) & set(',"\n') else name


def write_joint_arrays(path: Path, motion: Motion, sigma_m: FloatArray | None = None) -> Path:
    """Write the motion of J joints at T ticks as arrays, and return the path.

    The arrays are: ``names`` and ``roles`` (J,); ``parents`` (J,), −1 for the root; ``offsets_m`` (J,3) in
    the frame of the parent; ``t`` (T,), common time in seconds; ``fps``; ``world`` (T,J,3), metres;
    ``world_quat_xyzw`` and ``local_quat_xyzw`` (T,J,4); ``observed`` (T,J); ``sigma_m`` (T,J), NaN if
    unknown.

    Args:
        path: The file.
        motion: The motion in the world.
        sigma_m: As in `write_joint_table`.

    Raises:
        StoreError: The file cannot be written.
    """
    poses, skeleton = motion.world_from_joint(), motion.skeleton
    arrays = {
        "names": np.array(skeleton.joints),
        "roles": np.array(skeleton.roles),
        "parents": skeleton.parents,
        "offsets_m": skeleton.offsets_m,
        "t": motion.times_ns() / 1e9,
        "fps": np.array(motion.fps),
        "world": poses[..., :3, 3],
        "world_quat_xyzw": continuous_quat_xyzw(poses[..., :3, :3]),
        "local_quat_xyzw": continuous_quat_xyzw(motion.local_rotation),
        "observed": motion.observed,
        "sigma_m": np.full(motion.observed.shape, np.nan) if sigma_m is None else sigma_m,
    }
    with atomic_replacement(path) as temporary:
        write_npz(temporary, arrays)
    return path
