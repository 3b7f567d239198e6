"""Write the tables of all frames (``frames.csv``) and of all joints (``joints.csv``, ``joints.npz``)."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.export.export_inputs import ExportInputs
from bodycap_batch.export.target_frames import target_numbers, trajectories_in_target_frames
from bodycap_batch.formats import joint_table
from bodycap_batch.formats.atomic_files import atomic_replacement, write_text
from bodycap_batch.formats.dataclass_files import write_npz
from bodycap_batch.formats.frame_table import COLUMNS, LOST
from bodycap_batch.formats.tum import seconds_text
from bodycap_batch.model.geometry import continuous_quat_xyzw
from bodycap_batch.model.scene import FrameStatus, Trajectory
from bodycap_batch.model.skeleton import Motion
from bodycap_batch.model.take import Take, exact_rate


def write_frame_table(path: Path, inputs: ExportInputs) -> Path:
    """Write one line for each frame of each camera, and return the path of the file.

    Times are in seconds. Errors are in pixels at the work size (the image size that all stages work at). The
    column `status` is KEYFRAME, REGISTERED, INERTIAL, ROTATION_ONLY or LOST. INERTIAL means that the pose was
    derived from the inertial sensor, and ROTATION_ONLY that the frame has no position. For a lost frame, the
    column `reason` holds the value of `FrameStatus`.

    The column `map` is the number of the map to which the pose refers, as in the names ``map_<n>.ply``; 0 is
    ``map.ply``. A lost frame with a pose in another map than that of the camera's path has the reason
    OTHER_MAP and the number of this map.

    The sigmas are those of the pose as measured, per axis: the centre in metres, or in units of the map
    without a world; the rotation in degrees.

    Args:
        path: Path of the file to write.
        inputs: The results of the earlier stages.

    Raises:
        StoreError: The file cannot be written.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    numbers = target_numbers(inputs)
    for trajectory in trajectories_in_target_frames(inputs):
        map_numbers = _map_numbers(trajectory, inputs.other_paths, numbers)
        common = inputs.clocks[trajectory.camera].common_times_ns(trajectory.times_ns)
        sigma_position, sigma_rotation_deg = _sigmas(trajectory)
        for index, status in enumerate(trajectory.status):
            writer.writerow(
                (
                    trajectory.camera,
                    int(trajectory.frame_numbers[index]),
                    seconds_text(int(trajectory.times_ns[index])),
                    seconds_text(int(common[index])),
                    *_status_and_reason(status),
                    int(trajectory.inliers[index]),
                    _number_text(trajectory.error_px[index], 3),
                    map_numbers.get(int(trajectory.frame_numbers[index]), ""),
                    _number_text(sigma_position[index], 6),
                    _number_text(sigma_rotation_deg[index], 6),
                )
            )
    write_text(path, text.getvalue())
    return path


def _map_numbers(
    path: Trajectory, other_paths: Sequence[Trajectory], numbers: Mapping[str, int]
) -> dict[int, int]:
    """Return the number of the map to which the pose of each frame of a camera refers, by frame number."""
    parts = (path, *(other for other in other_paths if other.camera == path.camera))
    return {
        int(frame): numbers[part.gauge]
        for part in parts
        for frame in part.frame_numbers[part.localised]
        if part.gauge in numbers
    }


def _number_text(value: float, decimals: int) -> str:
    """Return a number with these decimals; "" for NaN."""
    return f"{value:.{decimals}f}" if np.isfinite(value) else ""


def _sigmas(trajectory: Trajectory) -> tuple[FloatArray, FloatArray]:
    """Return the sigmas per axis of the centre and of the rotation (degrees) of each frame; NaN: lost."""
    variance = np.diagonal(trajectory.covariance, axis1=1, axis2=2)
    rotation_rad, position = (np.sqrt(variance[:, part].mean(axis=1)) for part in (slice(3), slice(3, 6)))
    return position, np.degrees(rotation_rad)


def _status_and_reason(status: FrameStatus) -> tuple[str, str]:
    """Return the values of the columns `status` and `reason`."""
    is_measured = status.localised or status is FrameStatus.ROTATION_ONLY
    return (status.value, "") if is_measured else (LOST, status.value)


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
    text.write(joint_table.COLUMNS + "\n")
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
