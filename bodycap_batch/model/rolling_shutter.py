"""Correct the rolling shutter: move observations to the instant at which the middle row is exposed.

In an image of height h, row r is exposed at the time of the frame plus (r/h − ½) · readout_s. If the image is
rotated by 90°, the rows of the sensor are the columns of the image (`Camera.sideways`). Then, in an image of
width w, column c is exposed at the time of the frame plus (c/w − ½) · readout_s.
"""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.scene import Registration


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
