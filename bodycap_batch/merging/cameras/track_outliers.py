"""Remove grossly wrong poses from the path of a camera."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, runs
from bodycap_batch.merging.cameras.track import CameraTrack

OUTLIER_HALF_WINDOW = 6
"""Each frame is compared with this number of frames before it, and with this number of frames after it. The
value is 0.2 s at 30 fps. Over this time, a quadratic function of time follows a swinging hand to a few
centimetres. Evidence: none."""


OUTLIER_LIMIT_M = 0.12
"""Maximum distance (metres) of a pose from the quadratic through the neighbouring frames. A swinging hand
deviates from the quadratic by a fraction of this distance. A pose at a larger distance is wrong. Evidence:
none."""


def remove_outliers(track: CameraTrack, scale: float, fps: float) -> CameraTrack:
    """Remove frames whose centre jumps away from the robust quadratic through the neighbouring frames.

    Args:
        track: The measured path.
        scale: Metres per map unit; a provisional value is accurate enough.
        fps: Nominal frame rate of the camera.
    """
    count = len(track.times_ns)
    steps = np.array([step for step in range(-OUTLIER_HALF_WINDOW, OUTLIER_HALF_WINDOW + 1) if step])
    index = np.arange(count)[:, None] + steps
    valid = (index >= 0) & (index < count)
    index = np.clip(index, 0, count - 1)
    time = (track.times_ns[index] - track.times_ns[:, None]) * (1e-9 * fps)
    valid &= np.abs(time) <= OUTLIER_HALF_WINDOW + 0.5
    centre = scale * (track.map_from_cam[index, :3, 3] - track.map_from_cam[:, None, :3, 3])
    predicted = _robust_quadratic(time / OUTLIER_HALF_WINDOW, centre, valid)
    # A frame with fewer than two neighbours on one side is kept. For such a frame, the quadratic
    # extrapolates, and a change of direction looks like an error.
    inner = ((time < 0) & valid).sum(axis=1).clip(max=2) + ((time > 0) & valid).sum(axis=1).clip(max=2) == 4
    bad = (np.linalg.norm(predicted, axis=1) > OUTLIER_LIMIT_M) & inner & (valid.sum(axis=1) >= 6)
    return track.keep(~_runs_with_jumps(bad, scale * track.map_from_cam[:, :3, 3]))


def _runs_with_jumps(bad: BoolArray, centre_m: FloatArray) -> BoolArray:
    """Return a mask (N,) of the runs of bad frames in which the path jumps.

    The path of a very fast arm deviates from any quadratic, but this path does not jump.
    """
    jump = np.zeros(len(bad), dtype=bool)
    jump[1:-1] = np.linalg.norm(np.diff(centre_m, n=2, axis=0), axis=1) > OUTLIER_LIMIT_M
    out = np.zeros(len(bad), dtype=bool)
    for start, stop in runs(bad):
        out[start:stop] = jump[max(start - 1, 0) : stop + 1].any()
    return out


def _robust_quadratic(time: FloatArray, centre: FloatArray, valid: BoolArray) -> FloatArray:
    """Fit quadratics with Cauchy weights, and return their values (N,3) at time 0.

    Args:
        time: (N,W) times of the W frames around each frame.
        centre: (N,W,3) camera centres at these times.
        valid: (N,W) True if the centre is used.
    """
    basis = np.stack([np.ones_like(time), time, time**2], axis=-1)
    weight = valid.astype(np.float64)
    for _ in range(8):
        weighted = basis * weight[..., None]
        normal = np.einsum("nwi,nwj->nij", weighted, basis) + 1e-9 * np.eye(3)
        coefficients = np.linalg.solve(normal, np.einsum("nwi,nwk->nik", weighted, centre))
        residual = np.linalg.norm(centre - basis @ coefficients, axis=-1)
        weight = valid / (1.0 + (residual / (0.25 * OUTLIER_LIMIT_M)) ** 2)
    return np.asarray(coefficients[:, 0])
