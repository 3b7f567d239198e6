"""A camera that moves like a hand, its solved poses, and the samples of an inertial sensor on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.geometry import Similarity, make_transform, so3_exp
from bodycap_batch.model.scene import FrameStatus, Trajectory
from bodycap_batch.synthetic.imu import true_samples
from bodycap_batch.telemetry.streams import ACCELEROMETER, GYROSCOPE, CameraTelemetry, Stream

NOISE_M, NOISE_RAD = 0.002, float(np.radians(0.15))
"""Noise of the solved poses per axis."""


@dataclass(frozen=True)
class Hand:
    """A camera whose position and rotation are sums of sines; the world has z up."""

    seed: int = 0
    reach_m: float = 0.25
    turn_rad: float = 0.7

    def poses(self, times_s: FloatArray) -> FloatArray:
        """Return world_from_cam (T,4,4)."""
        rng = np.random.default_rng(self.seed)
        hertz, phase = rng.uniform(0.2, 1.4, (2, 3, 3)), rng.uniform(0.0, 6.3, (2, 3, 3))
        waves = np.sin(2.0 * np.pi * hertz * times_s[:, None, None, None] + phase).sum(axis=3) / 1.7
        return make_transform(so3_exp(self.turn_rad * waves[:, 1]), self.reach_m * waves[:, 0])


class Moving(Protocol):
    """A camera whose motion is known at all times."""

    def poses(self, times_s: FloatArray) -> FloatArray:
        """Return world_from_cam (T,4,4)."""


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """Errors of a sensor: those of a consumer's camera; noise per sample at 100 samples per second."""

    rate_hz: float = 200.0
    turn_rad: Sequence[float] = (0.02, -0.025, 0.01)
    late_s: float = 0.008
    gyro_bias: Sequence[float] = (0.01, -0.012, 0.006)
    force_bias: Sequence[float] = (0.08, -0.05, 0.1)
    gyro_noise: float = 0.004
    force_noise: float = 0.03
    lever_m: Sequence[float] = (0.0, 0.0, 0.0)

    def samples(self, hand: Moving, seconds: float, seed: int = 1) -> CameraTelemetry:
        """Return the telemetry of a recording that starts half a second before the first frame."""
        rng = np.random.default_rng(seed)
        times_s = np.arange(-0.5, seconds + 0.5, 1.0 / self.rate_hz)
        lever = make_transform(np.eye(3), np.array(self.lever_m))
        truth = true_samples(times_s, 1.0 / self.rate_hz, lambda t: hand.poses(t) @ lever)
        grown = np.sqrt(self.rate_hz / 100.0)
        errors = ((self.gyro_bias, self.gyro_noise), (self.force_bias, self.force_noise))
        streams = {}
        for key, values, (bias, noise) in zip((GYROSCOPE, ACCELEROMETER), truth, errors, strict=True):
            measured = values @ so3_exp(self.turn_rad) + bias + rng.normal(0.0, noise * grown, values.shape)
            streams[key] = Stream(
                key=key,
                name=key,
                unit="",
                times_s=times_s + self.late_s,
                values=measured,
                rate_hz=self.rate_hz,
            )
        return CameraTelemetry(source="imu.csv file", streams=streams, axes_known=True)


def solved(
    hand: Moving,
    seconds: float,
    *,
    fps: float = 30.0,
    lost: Sequence[int] = (),
    gauge_from_world: Similarity | None = None,
    seed: int = 2,
) -> Trajectory:
    """Return the solved poses of the camera, with noise, in a gauge."""
    rng = np.random.default_rng(seed)
    times_s = np.arange(int(seconds * fps)) / fps
    poses = hand.poses(times_s)
    poses[:, :3, :3] = poses[:, :3, :3] @ so3_exp(rng.normal(0.0, NOISE_RAD, (len(poses), 3)))
    poses[:, :3, 3] += rng.normal(0.0, NOISE_M, (len(poses), 3))
    moved = gauge_from_world or Similarity(1.0, np.eye(3), np.zeros(3))
    sigma = np.repeat([NOISE_RAD, moved.scale * NOISE_M], 3)
    poses, covariance = moved.apply_to_poses(poses), np.tile(np.diag(sigma**2), (len(poses), 1, 1))
    status = [FrameStatus.REGISTERED] * len(poses)
    for frame in lost:
        status[frame] = FrameStatus.BLUR
        poses[frame] = covariance[frame, 0, 0] = np.nan
        covariance[frame] = np.nan
    return Trajectory(
        camera="left_palm",
        gauge="map-0",
        frame_numbers=np.arange(len(poses)),
        times_ns=np.round(times_s * 1e9).astype(np.int64),
        gauge_from_cam=poses,
        covariance=covariance,
        status=tuple(status),
        inliers=np.where([each is FrameStatus.REGISTERED for each in status], 60, 0),
        error_px=np.full(len(poses), 0.5),
    )
