"""What the inertial sensor of a camera gives together with the solved poses of the camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bodycap_batch.core.arrays import FloatArray, set_array
from bodycap_batch.model.earth import GpsFixes
from bodycap_batch.model.geometry import Similarity, rotation_angle_rad
from bodycap_batch.model.picture_turns import PictureTurns


@dataclass(frozen=True, slots=True, kw_only=True)
class ForceWindows:
    """Weighted means over K windows, in the axes of a gauge. The weights of a window have the integral 1.

    Attributes:
        times_s: (K,) middle of each window on the clock of the camera, seconds.
        force: (K,3) mean of the specific force, m/s².
        rotation: (K,3,3) mean of the rotations gauge_from_cam: the change of `force` per bias.
        turned_force: (K,3,3) mean of gauge_from_cam · [force]×: minus the change of `force` per rotation of
            the sensor.
        acceleration: (K,3) mean acceleration of the camera, gauge units/s².
        lever: (K,3,3) mean second derivative of gauge_from_cam, 1/s²: the acceleration of the sensor
            relative to the camera, per metre of their distance.
        rotation_sigma_rad: (3,) standard deviation of the rotation between sensor and camera, radians.
    """

    times_s: FloatArray
    force: FloatArray
    rotation: FloatArray
    turned_force: FloatArray
    acceleration: FloatArray
    lever: FloatArray
    rotation_sigma_rad: FloatArray

    def __post_init__(self) -> None:
        count = len(self.times_s)
        set_array(self, "times_s", (count,))
        for name in ("force", "acceleration"):
            set_array(self, name, (count, 3))
        for name in ("rotation", "turned_force", "lever"):
            set_array(self, name, (count, 3, 3))
        set_array(self, "rotation_sigma_rad", (3,))

    def in_gauge(self, target_from_gauge: Similarity) -> ForceWindows:
        """Return the windows in the axes and the unit of another gauge."""
        turn = target_from_gauge.rotation
        return replace(
            self,
            force=self.force @ turn.T,
            rotation=turn @ self.rotation,
            turned_force=turn @ self.turned_force,
            acceleration=target_from_gauge.scale * self.acceleration @ turn.T,
            lever=turn @ self.lever,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorRelation:
    """How an inertial sensor relates to its camera.

    Attributes:
        delay_s: Time of the sensor's samples = time of the frame + delay, seconds, in the middle of the clip.
        delay_sigma_s: Standard deviation of the delay.
        drift: Change of the delay per second, no unit: how much faster the clock of the sensor runs.
        drift_sigma: Standard deviation of the drift.
        cam_from_sensor: (3,3) rotation from the stated axes of the sensor to the camera.
        rotation_sigma_rad: (3,) standard deviations of this rotation about the axes of the camera, radians.
        bias_rad_s: (3,) bias of the gyroscope in its axes, rad/s.
        bias_sigma_rad_s: (3,) standard deviations of the bias, rad/s.
        r_squared: Share of the variance of the camera's rotations that the gyroscope explains.
        pairs: Number of pairs of frames that were used.
    """

    delay_s: float
    delay_sigma_s: float
    drift: float
    drift_sigma: float
    cam_from_sensor: FloatArray
    rotation_sigma_rad: FloatArray
    bias_rad_s: FloatArray
    bias_sigma_rad_s: FloatArray
    r_squared: float
    pairs: int

    def __post_init__(self) -> None:
        set_array(self, "cam_from_sensor", (3, 3))
        for name in ("rotation_sigma_rad", "bias_rad_s", "bias_sigma_rad_s"):
            set_array(self, name, (3,))

    def figures(self) -> dict[str, Any]:
        """Return the relation as plain JSON values for ``metrics.json``."""
        return {
            "delay_s": round(self.delay_s, 6),
            "delay_sigma_s": round(self.delay_sigma_s, 6),
            "rate_ppm": round(1e6 * self.drift, 1),
            "rate_sigma_ppm": round(1e6 * self.drift_sigma, 1),
            "cam_from_sensor": np.round(self.cam_from_sensor, 6).tolist(),
            "turned_deg": round(float(np.degrees(rotation_angle_rad(self.cam_from_sensor))), 3),
            "turned_sigma_deg": np.round(np.degrees(self.rotation_sigma_rad), 3).tolist(),
            "gyro_bias_rad_s": np.round(self.bias_rad_s, 5).tolist(),
            "gyro_bias_sigma_rad_s": np.round(self.bias_sigma_rad_s, 5).tolist(),
            "r_squared": round(self.r_squared, 4),
            "pairs": self.pairs,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class InertialCamera:
    """What the inertial sensor of one camera gives.

    Attributes:
        camera: Camera name.
        gauge: Gauge of the poses that the sensor was compared with.
        source: Where the samples come from.
        verdict: Whether pictures and gyroscope agree: "agrees", "stabilised" or "unknown".
        reason: Sentence that explains the verdict.
        relation: How the sensor relates to the camera; None if it cannot be used.
        windows: Means of the specific force, for the vertical; None if there is no usable accelerometer.
        filled: Number of lost frames that got a pose from the sensor.
        refused: Number of lost frames in short gaps whose poses were too uncertain, or contradicted the poses
            beside them.
        solved: Number of localised frames whose poses were solved again together with the sensor.
        replaced: Number of localised frames whose pose contradicted the sensor, and was replaced.
        gps: GPS positions of the camera; None if there are none, or if they are not used.
        turns: How the camera turned its pictures relative to its lens; None if nothing shows that it did.
    """

    camera: str
    gauge: str
    source: str
    verdict: str
    reason: str
    relation: SensorRelation | None = None
    windows: ForceWindows | None = None
    filled: int = 0
    refused: int = 0
    solved: int = 0
    replaced: int = 0
    gps: GpsFixes | None = None
    turns: PictureTurns | None = None

    def figures(self) -> dict[str, Any]:
        """Return verdict and relation as plain JSON values for ``metrics.json``."""
        relation: Mapping[str, Any] = {} if self.relation is None else self.relation.figures()
        return {
            "source": self.source,
            "verdict": self.verdict,
            "reason": self.reason,
            **relation,
            "frames_filled": self.filled,
            "frames_refused": self.refused,
            "frames_solved_again": self.solved,
            "frames_replaced": self.replaced,
            **({} if self.turns is None else {"stabilisation": self.turns.figures()}),
        }
