"""Inertial samples of cameras on one body: irregular steps and turns of all, and motion of each one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from bodycap_batch.core.arrays import FloatArray

RATE_HZ = 200.0
_LENGTH_S = 40.0


def _noise(seed: int, smooth_s: float, columns: int) -> FloatArray:
    """Return smooth noise (N,C) with a standard deviation of 1 over the whole time."""
    values = np.random.default_rng(seed).normal(size=(int(_LENGTH_S * RATE_HZ), columns))
    smooth = gaussian_filter1d(values, smooth_s * RATE_HZ, axis=0)
    return np.asarray(smooth / smooth.std(axis=0))


def write_samples(
    folder: Path, camera: str, *, body: int, start_s: float, seconds: float, own: float = 0.5
) -> Path:
    """Write ``<camera>.imu.csv``, with a mount and a motion of its own for each name, and return its path.

    Args:
        folder: Folder of the file.
        camera: Name of the camera.
        body: Seed of the motion that all cameras of a body share.
        start_s: Common time at which the recording starts, seconds.
        seconds: Duration of the recording, seconds.
        own: Amplitude of the camera's own motion, as a share of the common one.
    """
    seed = sum(camera.encode())
    force, rate = own * _noise(1000 + seed, 0.06, 3), np.zeros((int(_LENGTH_S * RATE_HZ), 3))
    force[:, 2] += _noise(body, 0.06, 1)[:, 0]
    rate[:, 2] = _noise(body + 1, 0.25, 1)[:, 0] + own * _noise(2000 + seed, 0.25, 1)[:, 0]
    inside = slice(int(start_s * RATE_HZ), int((start_s + seconds) * RATE_HZ))
    mount = Rotation.random(random_state=seed)
    forces = mount.apply(2.0 * force[inside] + [0.0, 0.0, 9.81])
    times_s = np.arange(len(forces)) / RATE_HZ
    table = np.column_stack([times_s, mount.apply(rate[inside]), forces])
    path = folder / f"{camera}.imu.csv"
    np.savetxt(path, table, "%.6f", delimiter=",", header="t_s,gx,gy,gz,ax,ay,az", comments="")
    return path
