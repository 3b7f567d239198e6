"""Cameras that stabilise their pictures by rotation, and the record of it that GoPro cameras write.

The camera turns each picture relative to the lens, so that the pictures follow a smooth orientation. The
centre of the camera does not move. The picture is a crop, because the turned picture must not leave that of
the lens.

Source: Karpenko, Jacobs, Baek, Levoy, "Digital video stabilization and rolling shutter correction using
gyroscopes", Stanford CTSR 2011-03.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.formats.gpmf_writer import item, nested
from bodycap_batch.formats.mp4_writer import DataTrack
from bodycap_batch.model.geometry import continuous_quat_xyzw, nearest_rotation, so3_exp, so3_log

GOPRO_SETTINGS = {"MINF": "HERO11 Black", "EISE": "Y", "EISA": "HS High"}
"""Settings of a GoPro camera that stabilises its pictures."""
_SMOOTHING_S = 0.4
"""Standard deviation (seconds) of the weights of the mean orientation. Origin: the recorded turns of a HERO11
and a MAX have a correlation of 0.4 to 0.5 over 0.33 to 0.5 s."""
_STEPS_S = np.arange(-15, 16) * 0.08
"""Distances (seconds) of the instants whose orientations are averaged: three standard deviations."""
_MAX_TURN_RAD = float(np.radians(6.0))
"""Maximum turn of a picture. Origin: the crop of the default lens leaves 5.1 and 5.9 degrees on each side."""
_QUATERNION_SCALE = 32767
"""Stored value of 1 in GoPro's streams of orientations."""


def turn_of_pictures(
    world_from_cam_at: Callable[[FloatArray], FloatArray], times_s: FloatArray
) -> FloatArray:
    """Return the rotations cam_from_picture (T,3,3) of a stabilised camera.

    The picture has the mean orientation of the camera around its time, as far as the crop permits.

    Args:
        world_from_cam_at: Function that returns the poses (T,4,4) of the camera at times (T,), seconds.
        times_s: (T,) times of the pictures, seconds.
    """
    times_s = np.asarray(times_s, dtype=np.float64)
    around = world_from_cam_at((times_s[:, None] + _STEPS_S).ravel())[:, :3, :3].reshape(
        -1, len(_STEPS_S), 3, 3
    )
    weight = np.exp(-0.5 * (_STEPS_S / _SMOOTHING_S) ** 2)
    world_from_smooth = nearest_rotation(np.einsum("k,tkij->tij", weight, around))
    now = world_from_cam_at(times_s)[:, :3, :3]
    turn = so3_log(np.swapaxes(now, 1, 2) @ world_from_smooth)
    return so3_exp(turn / np.sqrt(1.0 + (turn**2).sum(axis=1, keepdims=True) / _MAX_TURN_RAD**2))


def orientation_track(
    times_ns: IntArray, world_from_cam: FloatArray, cam_from_picture: FloatArray
) -> DataTrack:
    """Return the telemetry track in which a GoPro camera records its orientation and that of its pictures.

    `bodycap_batch.telemetry.picture_orientation.recorded_turns` describes the axes.

    Args:
        times_ns: (T,) times of the pictures in the file, nanoseconds.
        world_from_cam: (T,4,4) poses of the camera.
        cam_from_picture: (T,3,3) turns of the pictures.
    """
    start_from_cam = world_from_cam[0, :3, :3].T @ world_from_cam[:, :3, :3]
    stored = {
        key: np.rint(_QUATERNION_SCALE * continuous_quat_xyzw(rotation)[:, [3, 0, 1, 2]] * [1, -1, -1, -1])
        for key, rotation in (("CORI", start_from_cam), ("IORI", cam_from_picture))
    }
    names = {"CORI": "CameraOrientation", "IORI": "ImageOrientation"}
    seconds = times_ns * 1e-9
    interval_s = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 1.0
    payloads = []
    for number in range(int(seconds[-1]) + 1):
        inside = np.flatnonzero((seconds >= number) & (seconds < number + 1))
        if not len(inside):
            continue
        streams = [
            nested(
                "STRM",
                item("STMP", "J", [round(1e6 * seconds[inside[0]])]),
                item("TSMP", "L", [int(inside[-1]) + 1]),
                item("STNM", "c", names[key]),
                item("SCAL", "s", [_QUATERNION_SCALE]),
                item(key, "s", values[inside].astype(int), 4),
            )
            for key, values in stored.items()
        ]
        device = nested("DEVC", item("DVID", "L", [1]), item("DVNM", "c", GOPRO_SETTINGS["MINF"]), *streams)
        payloads.append((device, float(seconds[inside[0]]), float(len(inside) * interval_s)))
    return DataTrack(handler="GoPro MET", payloads=tuple(payloads))
