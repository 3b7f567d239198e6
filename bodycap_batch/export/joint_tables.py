"""Write ``joints.csv`` and ``joints.npz``: the pose of every joint at every tick of the motion."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.formats.atomic_files import atomic_replacement, write_text
from bodycap_batch.formats.dataclass_files import write_npz
from bodycap_batch.formats.joint_table import COLUMNS
from bodycap_batch.formats.tum import seconds_text
from bodycap_batch.model.geometry import continuous_quat_xyzw
from bodycap_batch.model.skeleton import Motion
from bodycap_batch.model.take import Take, exact_rate


def write_joint_table(path: Path, motion: Motion, sigma_m: FloatArray | None = None) -> Path:
    """Write one CSV line for each joint at each tick, and return the path of the file.

    The columns are:

    - the common time, seconds;
    - the name of the joint;
    - the position (metres) and the orientation of the joint in the world (world_from_joint);
    - the rotation of the joint in the frame of the parent joint;
    - 1 if cameras measured the joint at this tick, else 0;
    - `sigma_m`, empty if unknown.

    Args:
        path: Path of the file to write.
        motion: The motion in the world.
        sigma_m: (T,J) standard deviation per axis of each joint's centre, metres; NaN if unknown. It is
            relative to the centre of the first solved joint.

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


def write_joint_arrays(
    path: Path, motion: Motion, sigma_m: FloatArray | None = None, take: Take | None = None
) -> Path:
    """Write the motion of J joints at T ticks as NumPy arrays, and return the path of the file.

    The arrays are:

    - ``names`` and ``roles`` (J,): name and role of each joint;
    - ``parents`` (J,): index of each joint's parent, −1 for the root;
    - ``offsets_m`` (J,3): offset of each joint in the frame of the parent, metres;
    - ``t`` (T,): common time of each tick, seconds;
    - ``fps``: number of ticks per second, and ``rate`` (2,): the same as numerator and denominator;
    - ``take`` and ``start_timecode``: name of the take, and timecode of tick 0, "" if unknown;
    - ``world`` (T,J,3): position of each joint in the world, metres;
    - ``world_quat_xyzw`` (T,J,4): orientation of each joint in the world;
    - ``local_quat_xyzw`` (T,J,4): rotation of each joint in the frame of the parent;
    - ``observed`` (T,J): True if cameras measured the joint at this tick;
    - ``sigma_m`` (T,J): standard deviation per axis of each joint's centre, metres, NaN if unknown.

    Args:
        path: Path of the file to write.
        motion: The motion in the world.
        sigma_m: (T,J) standard deviation per axis of each joint's centre, metres; NaN if unknown. It is
            relative to the centre of the first solved joint.
        take: Name, exact rate and timecode; None if they are unknown.

    Raises:
        StoreError: The file cannot be written.
    """
    rate = exact_rate(motion.fps) if take is None else take.rate
    code = "" if take is None or take.timecode is None else str(take.timecode)
    poses, skeleton = motion.world_from_joint(), motion.skeleton
    arrays = {
        "names": np.array(skeleton.joints),
        "roles": np.array(skeleton.roles),
        "parents": skeleton.parents,
        "offsets_m": skeleton.offsets_m,
        "t": motion.times_ns() / 1e9,
        "fps": np.array(motion.fps),
        "rate": np.array([rate.numerator, rate.denominator]),
        "take": np.array("" if take is None else take.name),
        "start_timecode": np.array(code),
        "world": poses[..., :3, 3],
        "world_quat_xyzw": continuous_quat_xyzw(poses[..., :3, :3]),
        "local_quat_xyzw": continuous_quat_xyzw(motion.local_rotation),
        "observed": motion.observed,
        "sigma_m": np.full(motion.observed.shape, np.nan) if sigma_m is None else sigma_m,
    }
    with atomic_replacement(path) as temporary:
        write_npz(temporary, arrays)
    return path
