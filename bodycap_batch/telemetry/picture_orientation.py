"""Find out how a camera turned its pictures relative to its lens, from what the camera recorded."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.geometry import rotation_angle_rad, rotation_from_quat_xyzw
from bodycap_batch.model.picture_turns import PictureTurns
from bodycap_batch.telemetry.streams import IMAGE_ORIENTATION, CameraTelemetry, Stream

_MAX_DISTANCE = 0.6
"""Maximum distance of an orientation from its frame, in intervals of its stream: half, and some rounding."""
_MIN_TURN_RAD = float(np.radians(0.05))
"""Minimum turn (radians) of a stabilised picture whose file states no stabilisation. Origin: ten times the
rounding of the stored values."""
UNRECORDED_SIGMA_RAD = float(np.radians(6.0))
"""Standard deviation (radians per axis) of the turn of a picture that is not recorded. Origin: recorded turns
of a horizon lock have 3.1 degrees on their largest axis, and successive frames are alike. Evidence:
docs/decisions/telemetry.md."""


def recorded_turns(telemetry: CameraTelemetry, times_s: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the recorded rotation cam_from_picture (N,3,3) of each picture, and whether there is one (N,).

    Without a record, the rotation is the identity.

    GoPro's stream IORI holds the orientation of the image relative to the camera's body. The four values are
    w, x, y, z of the conjugate of cam_from_picture, in OpenCV's axes. Evidence: docs/decisions/telemetry.md.

    Args:
        telemetry: The telemetry of the camera.
        times_s: (N,) times of the pictures on the clock of the camera, seconds.
    """
    stream = telemetry.streams.get(IMAGE_ORIENTATION)
    turns, known = np.tile(np.eye(3), (len(times_s), 1, 1)), np.zeros(len(times_s), dtype=np.bool_)
    if stream is None or not len(stream.times_s):
        return turns, known
    nearest, known = _nearest(stream, times_s)
    quat_xyzw = stream.values[nearest][:, [1, 2, 3, 0]] * [-1.0, -1.0, -1.0, 1.0]
    known &= np.linalg.norm(quat_xyzw, axis=1) > 0.5
    turns[known] = rotation_from_quat_xyzw(quat_xyzw[known])
    return turns, known


def turns_of_pictures(telemetry: CameraTelemetry, times_s: FloatArray) -> PictureTurns | None:
    """Return the turns of pictures as the camera states or records them; None if it states no stabilisation.

    Args:
        telemetry: The telemetry of the camera.
        times_s: (N,) times of the pictures on the clock of the camera, seconds.
    """
    turns, known = recorded_turns(telemetry, times_s)
    if not telemetry.is_stabilised and rotation_angle_rad(turns).max(initial=0.0) < _MIN_TURN_RAD:
        return None
    if not known.any():
        return unrecorded_turns(telemetry, len(times_s))
    return PictureTurns(
        mode=telemetry.stabilisation,
        cam_from_picture=turns,
        sigma_rad=np.where(known, 0.0, UNRECORDED_SIGMA_RAD),
    )


def unrecorded_turns(telemetry: CameraTelemetry, count: int) -> PictureTurns:
    """Return the turns of N pictures that are stabilised without a record."""
    return PictureTurns(
        mode=telemetry.stabilisation,
        cam_from_picture=np.tile(np.eye(3), (count, 1, 1)),
        sigma_rad=np.full(count, UNRECORDED_SIGMA_RAD),
    )


def _nearest(stream: Stream, times_s: FloatArray) -> tuple[IntArray, BoolArray]:
    """Return the index (N,) of the sample nearest to each time, and whether it is within half an interval."""
    after = np.clip(np.searchsorted(stream.times_s, times_s), 1, max(len(stream.times_s) - 1, 1))
    after = np.minimum(after, len(stream.times_s) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.abs(stream.times_s[before] - times_s) <= np.abs(stream.times_s[after] - times_s)
    index = np.asarray(np.where(nearer, before, after), dtype=np.int64)
    return index, np.asarray(np.abs(stream.times_s[index] - times_s) <= _MAX_DISTANCE / stream.rate_hz)
