"""Poses through gaps from an inertial sensor, on a real sequence with true poses.

``python -m tests.bench inertial``: frames of the sequence EuRoC V1_02 at 20 per second are lost for 0.2, 0.5
and 1 s at 50 places. The other frames have the true poses. Delay, rotation, biases, gravity and scale are
estimated from these and the samples; velocities and biases of the truth are not used. Printed: the worst
frame of each gap, 95 %, against a spline without a sensor, and how often the truth is inside the 95 %
ellipsoid.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bodycap_batch.config.options import TelemetryOptions
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.inertial import use_sensor
from bodycap_batch.model.geometry import make_transform, rotation_angle_rad, rotation_from_quat_xyzw
from bodycap_batch.model.scene import FrameStatus, Trajectory
from bodycap_batch.telemetry.streams import ACCELEROMETER, GYROSCOPE, CameraTelemetry, Stream
from tests.bench.rows import DATA

GAPS_S = (0.2, 0.5, 1.0)
PLACES, FPS = 50, 20.0
CHI2_95 = 7.815
TARGETS = {0.2: (0.1, 0.15), 0.5: (0.6, 0.3), 1.0: (2.0, 0.5)}
"""By length of the gap: position (cm) and rotation (degrees)."""
SIGMA_RAD, SIGMA_M = np.radians(0.05), 0.0005
"""Stated sigmas of the poses of localised frames."""


def read_sequence(folder: Path) -> tuple[Trajectory, CameraTelemetry]:
    """Return the true poses of the sensor at `FPS` frames per second, and its samples."""
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, Slerp

    truth = np.loadtxt(folder / "gt0.csv", delimiter=",", comments="#")
    samples = np.loadtxt(folder / "imu0.csv", delimiter=",", comments="#")
    start_ns = truth[0, 0]
    true_s, sample_s = (1e-9 * (table[:, 0] - start_ns) for table in (truth, samples))
    times_s = np.arange(max(true_s[0], sample_s[0]) + 0.3, min(true_s[-1], sample_s[-1]) - 0.3, 1.0 / FPS)
    turned = Slerp(true_s, Rotation.from_matrix(rotation_from_quat_xyzw(truth[:, [5, 6, 7, 4]])))(times_s)
    poses = make_transform(turned.as_matrix(), CubicSpline(true_s, truth[:, 1:4])(times_s))
    count = len(poses)
    path = Trajectory(
        camera="sensor",
        gauge="map-0",
        frame_numbers=np.arange(count),
        times_ns=np.round(times_s * 1e9).astype(np.int64),
        gauge_from_cam=poses,
        covariance=np.tile(np.diag(np.repeat([SIGMA_RAD**2, SIGMA_M**2], 3)), (count, 1, 1)),
        status=(FrameStatus.REGISTERED,) * count,
        inliers=np.full(count, 100),
        error_px=np.full(count, 0.3),
    )
    rate_hz = float(1.0 / np.median(np.diff(sample_s)))
    streams = {
        key: Stream(
            key=key,
            name=key,
            unit="",
            times_s=sample_s,
            values=samples[:, first : first + 3],
            rate_hz=rate_hz,
        )
        for key, first in ((GYROSCOPE, 1), (ACCELEROMETER, 4))
    }
    return path, CameraTelemetry(source="imu.csv file", streams=streams, axes_known=True)


def lose(path: Trajectory, gaps: Sequence[tuple[int, int]]) -> Trajectory:
    """Return a trajectory without the poses of some frames (first, last + 1)."""
    poses, covariance, status = path.gauge_from_cam.copy(), path.covariance.copy(), list(path.status)
    for first, last in gaps:
        poses[first:last], covariance[first:last] = np.nan, np.nan
        status[first:last] = [FrameStatus.BLUR] * (last - first)
    return replace(path, gauge_from_cam=poses, covariance=covariance, status=tuple(status))


def splined(path: Trajectory, first: int, last: int) -> FloatArray:
    """Return positions of lost frames from a spline through the frames around them."""
    from scipy.interpolate import CubicSpline

    around = np.r_[first - 12 : first, last : last + 12]
    spline = CubicSpline(path.seconds[around], path.gauge_from_cam[around, :3, 3])
    return np.asarray(spline(path.seconds[first:last]))


def measure(path: Trajectory, telemetry: CameraTelemetry, gap_s: float) -> dict[str, Any]:
    """Return the figures for one length of the gaps."""
    lost, margin = round(gap_s * FPS) - 1, round(1.2 * FPS)
    places = np.linspace(margin, len(path.status) - lost - margin, PLACES).astype(int)
    apart = int(np.ceil((lost + margin) / np.diff(places).min()))
    position, rotation, plain, squared, empty = [], [], [], [], 0
    for phase in range(apart):
        gaps = [(int(first), int(first) + lost) for first in places[phase::apart]]
        found = use_sensor(lose(path, gaps), telemetry, TelemetryOptions(smoothing=False)).trajectory
        for first, last in gaps:
            truth = path.gauge_from_cam[first:last]
            plain.append(np.linalg.norm(splined(path, first, last) - truth[:, :3, 3], axis=1).max())
            if not found.localised[first:last].all():
                empty += 1
                continue
            mine = found.gauge_from_cam[first:last]
            mine_t = np.swapaxes(mine[:, :3, :3], 1, 2)
            error = np.einsum("nij,nj->ni", mine_t, truth[:, :3, 3] - mine[:, :3, 3])
            position.append(np.linalg.norm(error, axis=1).max())
            rotation.append(np.degrees(rotation_angle_rad(mine_t @ truth[:, :3, :3])).max())
            weighed = np.linalg.solve(found.covariance[first:last, 3:, 3:], error[..., None])[..., 0]
            squared += (error * weighed).sum(axis=1).tolist()
    return {
        "gap_s": gap_s,
        "places": PLACES,
        "not_filled": empty,
        "position_cm": 100.0 * float(np.quantile(position, 0.95)),
        "rotation_deg": float(np.quantile(rotation, 0.95)),
        "spline_cm": 100.0 * float(np.quantile(plain, 0.95)),
        "inside": float((np.array(squared) < CHI2_95).mean()),
    }


def main(arguments: Sequence[str]) -> int:
    """Print the figures against their targets."""
    parser = argparse.ArgumentParser(prog="make bench ARGS=inertial", description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA / "imu_v102", help="folder of the sequence")
    parser.add_argument("--json", type=Path, help="file for all figures as JSON")
    options = parser.parse_args(arguments)
    path, telemetry = read_sequence(options.data)
    rows = []
    print(
        "gap s  position cm (target)  rotation deg (target)  spline cm  ratio  in 95 % ellipsoid  not filled"
    )
    for gap_s in GAPS_S:
        row = measure(path, telemetry, gap_s)
        most_cm, most_deg = TARGETS[gap_s]
        print(
            f"{gap_s:5.1f}  {row['position_cm']:11.3f} ({most_cm:6.1f})  {row['rotation_deg']:12.3f} "
            f"({most_deg:6.2f})  {row['spline_cm']:9.2f}  {row['position_cm'] / row['spline_cm']:5.2f}  "
            f"{100 * row['inside']:15.1f} %  {row['not_filled']:10d}"
        )
        rows.append(row)
    if options.json is not None:
        options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return 0
