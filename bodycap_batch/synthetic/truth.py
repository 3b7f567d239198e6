"""Write all files of a capture except the videos: calibration and ground truth.

The ground truth consists of camera paths, joint positions, body proportions, motion and mounts.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.formats.atomic_files import atomic_replacement, write_text
from bodycap_batch.formats.bvh import write_bvh
from bodycap_batch.formats.joint_positions import ROLE_BY_TRUTH_NAME
from bodycap_batch.model.geometry import invert, make_transform, quat_xyzw_from_rotation, so3_exp, so3_log
from bodycap_batch.model.skeleton import Motion, Mount, SkeletonModel
from bodycap_batch.synthetic.clocks import has_own_clocks, reference_name, true_clocks
from bodycap_batch.synthetic.moving_body import MovingBody, joint_poses_at
from bodycap_batch.synthetic.options import SynthOptions
from bodycap_batch.synthetic.stance_walk import StanceWalk

_README = """Ground truth of a synthetic capture. Metres, Z up, floor at z = 0.

<camera>.tum   world_from_camera (OpenCV axes), one line a frame: timestamp tx ty tz qx qy qz qw.
               Timestamps are the camera's own; common time = camera time + offsets_s of calib.json.
               With a rolling shutter, it is the pose at the exposure of the middle row of the image. With
               motion blur, it is the pose at the middle of the exposure.
exposure/<camera>.tum  with motion blur, the mean pose over the exposure, which the picture shows. A recorded
               motion shakes within an exposure, so it differs from the pose at the middle.
lens/<camera>.tum  with stabilisation, the poses with the axes of the lens, which mounts.json refers to.
               <camera>.tum holds those of the pictures, which the camera turned relative to its lens.
joints.npz     names (J,), t (T,) s on the common clock, world (T,J,3) m: joint centres.
motion.bvh     the motion on the common clock, at the cameras' rate; frame 0 is the earliest frame.
mounts.json    joint_from_cam of each camera: the true mount, which differs from the nominal mount.
<camera>.imu.json  of ../<camera>.imu.csv, if there is one: x_in_cam = cam_from_sensor · x_in_sensor, the
               biases in the axes of the sensor, and late_s: time stamp of a sample = camera time + late_s.
synth.json     the options the capture was made with.

The files ../skeleton.bvh and motion.bvh have the true proportions of the body.
"""
_CLOCKS_README = """
clocks.json    the clock of each camera, and the time by which its sound is late against its pictures:
               common time = camera time * (1 + drifts_ppm * 1e-6) + offsets_s. These values count where
               calib.json has no offsets_s. Sound takes up to 12 ms more from its source to the microphone.
"""
_CONTACTS_README = """
contacts.json  stances of each foot (left, right) in ascending order. strike_s: times of heel strike, the
               first contact (in steps back and aside, the toes touch first). off_s: times of toe off, the
               last contact. null: the stance starts before, or ends after, the simulated time. Seconds on
               the common clock. Between strike_s and off_s the foot rolls without slipping: about the heel
               until the foot is flat, and about the tip of the toes when the heel has risen.
"""
_EXPOSURE_STEPS = 24
"""Number of instants whose mean is the pose over an exposure. Origin: 0.4 ms of an exposure of 10 ms, a
twentieth of the interval of a recorded motion."""


def write_calibration(folder: Path, options: SynthOptions) -> None:
    """Write ``calib.json``: the intrinsics, the timing and the clock offsets of all cameras.

    It is written to ``gt/`` if the pictures are stabilised.

    The offsets of free clocks are left out: a user does not know them.
    """
    stated = {name: options.offsets_s.get(name, 0.0) for name in options.cameras}
    content: dict[str, Any] = {
        "width": options.width,
        "height": options.height,
        "fps": options.fps,
        "model": options.lens,
        "params": options.camera().params.tolist(),
        "rolling_shutter_s": options.rolling_shutter_s,
        **({"rates_fps": dict(options.rates_fps)} if options.rates_fps else {}),
        **({"offsets_s": stated} if options.clocks == "common" else {}),
        "exposure_s": options.exposure_s,
        "timestamp": "middle of the exposure",
        "pixel_origin": "COLMAP (centre of first pixel = 0.5)",
    }
    # The lens of a crop is unknown to users: a calibration without stabilisation does not fit it.
    _write_json(folder / ("calib.json" if options.stabilised == "none" else "gt/calib.json"), content)


def write_truth(folder: Path, options: SynthOptions, motion: MovingBody, mounts: tuple[Mount, ...]) -> None:
    """Write ``skeleton.bvh`` and all files in ``gt/`` except the paths of the cameras."""
    truth = folder / "gt"
    ticks = common_ticks_ns(options)
    root, local = motion.pose(seconds_from_ns(ticks))
    true_motion = Motion(
        skeleton=motion.skeleton,
        fps=options.fps,
        start_ns=int(ticks[0]),
        root_in_world_m=root,
        local_rotation=local,
        observed=np.ones(local.shape[:2], dtype=bool),
    )
    write_bvh(truth / "motion.bvh", true_motion)
    write_bvh(folder / "skeleton.bvh", _rest_pose_motion(motion.skeleton, options.fps))
    _write_joints(truth / "joints.npz", motion, ticks)
    content = {
        mount.camera: {
            "role": mount.role,
            "joint_from_cam": mount.joint_from_cam.tolist(),
            "translation_m": mount.joint_from_cam[:3, 3].tolist(),
            "quat_xyzw": quat_xyzw_from_rotation(mount.joint_from_cam[:3, :3]).tolist(),
        }
        for mount in mounts
    }
    _write_json(truth / "mounts.json", content)
    readme = _README
    if has_own_clocks(options):
        _write_clocks(truth / "clocks.json", options)
        readme += _CLOCKS_README
    if isinstance(motion, StanceWalk):
        _write_contacts(truth / "contacts.json", motion, seconds_from_ns(ticks))
        readme += _CONTACTS_README
    write_text(truth / "README.txt", readme)
    settings = options.model_dump(mode="json")
    if options.motion is not None:
        settings["motion"] = options.motion.name
    _write_json(truth / "synth.json", settings)


def seconds_from_ns(times_ns: IntArray) -> FloatArray:
    """Convert times from nanoseconds to seconds."""
    return np.asarray(times_ns * 1e-9, dtype=np.float64)


def common_ticks_ns(options: SynthOptions) -> IntArray:
    """Return regular times (nanoseconds) on the common clock at the common frame rate.

    The times cover the capture from the earliest to the latest timestamp of all cameras.
    """
    clocks = true_clocks(options).values()
    length_s = (options.frame_count - 1) / options.fps
    offsets = [clock.offset_s for clock in clocks]
    lasts_s = length_s + max(clock.offset_s + 1e-6 * clock.drift_ppm * length_s for clock in clocks)
    lasts_s -= min(offsets)
    ticks = np.arange(int(np.floor(lasts_s * options.fps + 1e-6)) + 1)
    return np.asarray(np.round(min(offsets) * 1e9 + ticks * (1e9 / options.fps)), dtype=np.int64)


def mean_poses(
    world_from_cam_at: Callable[[FloatArray], FloatArray], times_s: FloatArray, exposure_s: float
) -> FloatArray:
    """Return the mean poses (T,4,4) of a camera over exposures.

    Args:
        world_from_cam_at: Function that returns the poses (N,4,4) of the camera at times (N,), seconds.
        times_s: (T,) middle of each exposure, seconds.
        exposure_s: Length of an exposure, seconds.
    """
    middle = world_from_cam_at(times_s)
    turn, shift = np.zeros((len(times_s), 3)), np.zeros((len(times_s), 3))
    for step in (np.arange(_EXPOSURE_STEPS) + 0.5) / _EXPOSURE_STEPS - 0.5:
        moved = invert(middle) @ world_from_cam_at(times_s + step * exposure_s)
        turn += so3_log(moved[:, :3, :3]) / _EXPOSURE_STEPS
        shift += moved[:, :3, 3] / _EXPOSURE_STEPS
    return np.asarray(middle @ make_transform(so3_exp(turn), shift))


def _write_clocks(path: Path, options: SynthOptions) -> None:
    """Write the true clocks of all cameras."""
    clocks = true_clocks(options)
    content = {
        "reference": reference_name(options.cameras),
        "offsets_s": {name: clock.offset_s for name, clock in clocks.items()},
        "drifts_ppm": {name: clock.drift_ppm for name, clock in clocks.items()},
        "sound_skews_s": {name: clock.skew_s for name, clock in clocks.items()},
    }
    _write_json(path, content)


def _rest_pose_motion(skeleton: SkeletonModel, fps: float) -> Motion:
    """Return a motion of one frame with the zero pose of a skeleton."""
    count = len(skeleton.joints)
    return Motion(
        skeleton=skeleton,
        fps=fps,
        start_ns=0,
        root_in_world_m=np.asarray(skeleton.offsets_m[:1]),
        local_rotation=np.tile(np.eye(3), (1, count, 1, 1)),
        observed=np.ones((1, count), dtype=bool),
    )


def _write_joints(path: Path, motion: MovingBody, ticks_ns: IntArray) -> None:
    """Write the world positions of the joints in `ROLE_BY_TRUTH_NAME` at given common times (nanoseconds)."""
    indices = {name: motion.skeleton.index_of_role(role) for name, role in ROLE_BY_TRUTH_NAME.items()}
    present = {name: index for name, index in indices.items() if index is not None}
    world = joint_poses_at(motion, seconds_from_ns(ticks_ns))[:, list(present.values())][..., :3, 3]
    with atomic_replacement(path) as temporary:
        np.savez(temporary, names=np.array(list(present)), t=seconds_from_ns(ticks_ns), world=world)


def _write_contacts(path: Path, motion: StanceWalk, times_s: FloatArray) -> None:
    """Write the stances of both feet that overlap the given times on the common clock, seconds."""
    content = {}
    for side, stances in motion.contacts(float(times_s[0]), float(times_s[-1])).items():
        rows = [[round(time, 6) if np.isfinite(time) else None for time in row] for row in stances.tolist()]
        content[side.lower()] = {"strike_s": [row[0] for row in rows], "off_s": [row[1] for row in rows]}
    _write_json(path, content)


def _write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file with the given content."""
    write_text(path, json.dumps(content, indent=1) + "\n")
