"""What the trunk and the hands show about the steps: speed, rise and fall, sway, yaw and arm swing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.skeleton import Motion

_SLOW_HZ = 0.7
"""Cutoff frequency (Hz) of the path and heading without the sway of single steps. Derivation: a stride, which
is the period of the sway, takes 1.0 to 1.4 s at ordinary speeds."""
STEP_HZ = 4.0
"""Cutoff frequency (Hz) of the rise and fall with each step. Derivation: twice the frequency of ordinary
steps, 2 Hz."""
_STRIDE_HZ = 2.5
"""Cutoff frequency (Hz) of sway, yaw and arm swing, which repeat with each stride. Derivation: more than
twice the frequency of ordinary strides, 1 Hz."""
ORDINARY_SPEED_M_PER_S = 1.3
"""Speed (m/s) of an ordinary walk, for which the sources state durations and angles."""
_MIN_TICKS = 16
"""Minimum number of ticks of a filtered signal. Derivation: the padding of the filter."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrunkSignals:
    """Signals of the trunk and the hands at T ticks.

    Attributes:
        fps: Ticks per second.
        hips_m: (T,3) middle of the hips below an upright pelvis, in the world, metres.
        slow_hips_m: (T,3) the same without the sway of single steps.
        velocity_m_per_s: (T,3) velocity of `slow_hips_m`.
        heading_rad: (T,) heading of the trunk without the yaw of single steps; 0 faces −y.
        yaw_rate_rad_per_s: (T,) rate of `heading_rad`.
        rise_m_per_s2: (T,) upward acceleration of the trunk.
        sway_m_per_s2: (T,) acceleration of the hips to the left, without that of the slow path.
        twist_rad_per_s: (T,) rate of the trunk's yaw to the left, without that of the slow heading.
        arm_m_per_s: (T,) forward velocity of the left hand relative to the right hand, without its slow part.
    """

    fps: float
    hips_m: FloatArray
    slow_hips_m: FloatArray
    velocity_m_per_s: FloatArray
    heading_rad: FloatArray
    yaw_rate_rad_per_s: FloatArray
    rise_m_per_s2: FloatArray
    sway_m_per_s2: FloatArray
    twist_rad_per_s: FloatArray
    arm_m_per_s: FloatArray

    def speed_m_per_s(self) -> FloatArray:
        """Return the horizontal speed (T,) of the slow path."""
        return np.asarray(np.hypot(self.velocity_m_per_s[:, 0], self.velocity_m_per_s[:, 1]))

    def forward(self) -> FloatArray:
        """Return the horizontal unit vectors (T,2) that the trunk faces."""
        return np.column_stack([np.sin(self.heading_rad), -np.cos(self.heading_rad)])

    def left(self) -> FloatArray:
        """Return the horizontal unit vectors (T,2) to the left of the trunk."""
        return np.column_stack([np.cos(self.heading_rad), np.sin(self.heading_rad)])


def trunk_signals(motion: Motion, trunk: int, hands: tuple[int | None, int | None]) -> TrunkSignals:
    """Return the signals of a motion whose pelvis is upright below the trunk.

    Args:
        motion: The motion from merging.
        trunk: Index of the measured joint of the trunk.
        hands: Indices of the left and the right hand, or of the last measured joint of each arm; None for an
            arm that is not measured.
    """
    fps = motion.fps
    poses = motion.world_from_joint()
    hips = poses[:, 0, :3, 3]
    yaw = yaw_rad(poses[:, 0, :3, :3])
    heading = low_pass(yaw, _SLOW_HZ, fps)
    left = np.column_stack([np.cos(heading), np.sin(heading)])
    forward = np.column_stack([np.sin(heading), -np.cos(heading)])
    slow = low_pass(hips, _SLOW_HZ, fps)
    sway = low_pass(hips, _STRIDE_HZ, fps)[:, :2] - slow[:, :2]
    height = low_pass(poses[:, trunk, 2, 3], STEP_HZ, fps)
    arm = np.zeros(len(hips))
    if hands[0] is not None and hands[1] is not None:
        apart = poses[:, hands[0], :2, 3] - poses[:, hands[1], :2, 3]
        ahead = (apart * forward).sum(axis=1)
        arm = _rate(low_pass(ahead, _STRIDE_HZ, fps) - low_pass(ahead, _SLOW_HZ, fps), fps)
    return TrunkSignals(
        fps=fps,
        hips_m=hips,
        slow_hips_m=slow,
        velocity_m_per_s=_rate(slow, fps),
        heading_rad=heading,
        yaw_rate_rad_per_s=_rate(heading, fps),
        rise_m_per_s2=_rate(_rate(height, fps), fps),
        sway_m_per_s2=(_rate(_rate(sway, fps), fps) * left).sum(axis=1),
        twist_rad_per_s=_rate(low_pass(yaw, _STRIDE_HZ, fps) - heading, fps),
        arm_m_per_s=arm,
    )


def yaw_rad(world_from_hips: FloatArray) -> FloatArray:
    """Return the yaw (T,) of upright rotations (T,3,3) about z, radians, continuous over time."""
    return np.asarray(np.unwrap(np.arctan2(world_from_hips[:, 1, 0], world_from_hips[:, 0, 0])))


def low_pass(values: FloatArray, cutoff_hz: float, fps: float) -> FloatArray:
    """Return values (T,...) after a low-pass filter along the time axis, without delay.

    A signal that is too short is returned without its noise filtered.
    """
    from scipy.signal import butter, sosfiltfilt

    if len(values) < _MIN_TICKS or 2.0 * cutoff_hz >= 0.95 * fps:
        return np.array(values)
    sections = butter(2, cutoff_hz, fs=fps, output="sos")
    padding = min(len(values) - 1, round(2.0 * fps / cutoff_hz))
    return np.asarray(sosfiltfilt(sections, values, axis=0, padlen=padding))


def oscillation_amplitude(values: FloatArray, cutoff_hz: float, fps: float) -> FloatArray:
    """Return the amplitude (T,) of an oscillation (T,), averaged with a low-pass filter."""
    return np.asarray(np.sqrt(2.0 * np.maximum(low_pass(values**2, cutoff_hz, fps), 0.0)))


def _rate(values: FloatArray, fps: float) -> FloatArray:
    if len(values) < 2:
        return np.zeros_like(values)
    return np.asarray(np.gradient(values, axis=0) * fps)
