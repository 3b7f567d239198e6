"""The likelihood of a vertical, from the tilt of the trunk (its lean) over time.

People bend forward, and seldom backward or sideways. The distribution of the trunk's orientation therefore
shows which direction is up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.body.bones import Bone, anatomical_axes, bones_to_root
from bodycap_batch.merging.cameras.track import CameraTrack
from bodycap_batch.model.skeleton import Mount, SkeletonModel
from bodycap_batch.model.skeleton_presets import split_side

_MODE_RADIUS_RAD = float(np.radians(15.0))
"""Maximum angle (radians) between two similar directions of a trunk. While a person walks or stands, the
angle between the trunk and its usual direction is smaller. Evidence: none."""
MAX_SAMPLES, _SPHERE_DIRECTIONS = 300, 1000
"""`MAX_SAMPLES` is the maximum number of instants of a capture that are evaluated. `_SPHERE_DIRECTIONS` is
the number of directions on the sphere that are evaluated. Both numbers limit the computing time."""
_UPRIGHT_SIGMA_DEG = 12.0
"""Sigma (degrees) of the tilt of the trunk while the person stands or walks, forward and sideways. This sigma
contains 5 degrees of systematic bias. The rest is the error of the camera's mount. Evidence: none."""
_UPRIGHT_SHARE, _FORWARD_SHARE, _BACKWARD_SHARE, _OUTLIER_SHARE = 0.57, 0.35, 0.07, 0.01
"""Assumed fractions of the time. In this order, they are for a trunk that is upright, a trunk that bends
forward, a trunk that reclines, and all other orientations. Evidence: none."""
_FORWARD_SCALE_DEG, _BACKWARD_SCALE_DEG, _OUTLIER_HALF_RANGE_DEG = 60.0, 15.0, 180.0
"""Parameters (degrees) of the probability densities of the trunk's tilt. The first value is the scale of the
exponential density of the forward tilt. The second value is the scale of the exponential density of the
backward tilt. The third value is half of the range of the uniform density of outliers. When a person picks
things up, the trunk bends by a right angle and more. In a chair, the trunk reclines by up to 30 degrees.
Evidence: none."""


@dataclass(frozen=True, slots=True)
class TrunkOrientation:
    """The orientation of a body's trunk over time.

    Attributes:
        axes: (N,3,3) left, back and up directions of the trunk as columns, in the axes of the map.
        front_known: True if the left and back directions are known. If False, only the up direction is used.
    """

    axes: FloatArray
    front_known: bool = True

    def modal_up(self) -> FloatArray:
        """Return the trunk's most frequent up direction (3,).

        It is the upright direction if the person bends only now and then.
        """
        return modal_direction(self.axes[:, :, 2])

    def mean_up(self) -> FloatArray:
        """Return the trunk's mean up direction (3,).

        For a person who bends most of the time, the mean is nearer to upright than the most frequent
        direction.
        """
        return _normalised(self.axes[:, :, 2].mean(axis=0))

    def upright_up(self) -> FloatArray:
        """Return the up direction (3,) of the upright trunk: the direction that best explains all tilts."""
        axes = _subsample(self.axes)
        candidates = np.vstack([axes[:, :, 2], self.modal_up(), self.mean_up()])
        best = candidates[int(np.argmin(self.negative_log_likelihood(candidates)))]
        near = axes[:, :, 2] @ best > np.cos(_MODE_RADIUS_RAD)
        return _normalised(axes[near, :, 2].mean(axis=0)) if near.any() else best

    def negative_log_likelihood(self, ups: FloatArray) -> FloatArray:
        """Return the mean negative log-likelihood (C,), in nats, of the tilts for verticals `ups` (C,3).

        The value for a trunk without tilt is subtracted, so a trunk without tilt has a value of about 0.
        """
        return self._mean_nll(ups, _OUTLIER_SHARE)

    def posterior_spread_deg(self, up: FloatArray) -> float:
        """Return the RMS error (degrees) of a vertical `up` (3,) that is based only on the trunk's tilt.

        A constant tilt of the trunk cannot be distinguished from an error of the vertical. All instants
        together therefore count as one observation. Outliers are ignored here, because they may be in any
        direction.
        """
        ups = _fibonacci_sphere(_SPHERE_DIRECTIONS)
        nll = self._mean_nll(ups, 0.0)
        likelihood = np.exp(nll.min() - nll)
        off = np.degrees(np.arccos(np.clip(ups @ up, -1.0, 1.0)))
        return float(np.sqrt(np.average(off**2, weights=likelihood)))

    def _mean_nll(self, ups: FloatArray, outlier_share: float) -> FloatArray:
        in_trunk = np.einsum("nji,cj->cni", _subsample(self.axes), ups)
        if not self.front_known:
            angle = np.degrees(np.arccos(np.clip(in_trunk[..., 2], -1.0, 1.0)))
            return np.asarray(_pitch_nll(angle, outlier_share).mean(axis=1))
        pitch = np.degrees(np.arctan2(in_trunk[..., 1], in_trunk[..., 2]))
        side = np.degrees(np.arcsin(np.clip(in_trunk[..., 0], -1.0, 1.0)))
        return np.asarray((_pitch_nll(pitch, outlier_share) + _lateral_nll(side, outlier_share)).mean(axis=1))


def _pitch_nll(pitch_deg: FloatArray, outlier_share: float) -> FloatArray:
    """Return the negative log-likelihood of tilts in degrees, minus the value for no tilt.

    Tilts forward are positive. The result has the shape of `pitch_deg`.
    """

    def density(pitch: FloatArray) -> FloatArray:
        forward, backward = np.maximum(pitch, 0.0), np.maximum(-pitch, 0.0)
        height = _UPRIGHT_SHARE / (_UPRIGHT_SIGMA_DEG * np.sqrt(2.0 * np.pi))
        return np.asarray(
            height * np.exp(-0.5 * (pitch / _UPRIGHT_SIGMA_DEG) ** 2)
            + (pitch > 0.0) * _FORWARD_SHARE / _FORWARD_SCALE_DEG * np.exp(-forward / _FORWARD_SCALE_DEG)
            + (pitch <= 0.0) * _BACKWARD_SHARE / _BACKWARD_SCALE_DEG * np.exp(-backward / _BACKWARD_SCALE_DEG)
            + outlier_share / (2.0 * _OUTLIER_HALF_RANGE_DEG)
        )

    return np.asarray(-np.log(density(pitch_deg) / density(np.zeros(1))))


def _lateral_nll(side_deg: FloatArray, outlier_share: float) -> FloatArray:
    """Return the negative log-likelihood of sideways tilts in degrees, minus the value for no tilt."""
    density = (1.0 - outlier_share) * np.exp(-0.5 * (side_deg / _UPRIGHT_SIGMA_DEG) ** 2) + outlier_share
    return np.asarray(-np.log(density))


def _fibonacci_sphere(count: int) -> FloatArray:
    """Return evenly distributed directions (C,3): points on a spiral at successive golden angles."""
    number = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1.0 - 2.0 * number / count), np.pi * (1.0 + np.sqrt(5.0)) * number
    return np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], axis=1)


def trunk_orientation(
    skeleton: SkeletonModel, bones: Sequence[Bone], world_from_bone: FloatArray
) -> TrunkOrientation:
    """Return the trunk's orientation from solved bones (T,B,4,4).

    If the graph has no bone of the trunk, up is opposite to the mean direction of the limbs, because limbs
    hang most of the time. The front is then unknown.
    """
    trunk = [i for i, bone in enumerate(bones) if not split_side(bone.role)[0]]
    limbs = [
        i for i, bone in enumerate(bones) if split_side(bone.role)[1] in ("Arm", "UpLeg", "Leg", "ForeArm")
    ]
    if trunk:
        left, up = (world_from_bone[:, trunk, :3, axis].mean(axis=1) for axis in (0, 2))
        return TrunkOrientation(_orthogonal_axes(left, up))
    chosen = limbs or list(range(len(bones)))
    along = [world_from_bone[:, i, :3, :3] @ anatomical_axes(skeleton, bones[i].role)[:, 0] for i in chosen]
    up = _normalised(-np.mean(along, axis=(0, 1)))[None]
    return TrunkOrientation(_orthogonal_axes(np.linalg.svd(up)[2][1:2], up), front_known=False)


def trunk_orientation_from_prior(bones: Sequence[Bone], trunk: CameraTrack, mount: Mount) -> TrunkOrientation:
    """Return the trunk's orientation in the map from the path and the mount prior of the trunk's camera.

    The joints between the camera's bone and the first bone are assumed to be in the rest pose.
    """
    rest = np.eye(3)
    for index in bones_to_root(bones, trunk.bone)[:-1]:
        rest = bones[index].mean_rotation.T @ rest
    joint = trunk.map_from_cam[:, :3, :3] @ mount.joint_from_cam[:3, :3].T
    return TrunkOrientation(joint @ rest)


def modal_direction(directions: FloatArray) -> FloatArray:
    """Return the mean (3,) of the largest group of similar directions among (N,3).

    For a trunk that bends from time to time, the result is the direction of the upright trunk. The mean of
    all directions would be tilted towards the directions of the bent trunk.
    """
    sample = _subsample(directions)
    sample = sample / np.linalg.norm(sample, axis=1, keepdims=True)
    near = sample @ sample.T > np.cos(_MODE_RADIUS_RAD)
    return _normalised(sample[near[int(np.argmax(near.sum(axis=1)))]].mean(axis=0))


def _subsample(items: FloatArray) -> FloatArray:
    """Return up to 300 evenly spaced items (N,...). The indices of the items are rounded down."""
    return np.asarray(items[np.unique(np.linspace(0, len(items) - 1, MAX_SAMPLES).astype(np.int64))])


def _orthogonal_axes(left: FloatArray, up: FloatArray) -> FloatArray:
    """Return left, back and up axes as columns (N,3,3), from nearly orthogonal left and up axes (N,3)."""
    up = up / np.linalg.norm(up, axis=1, keepdims=True)
    back = np.cross(up, left)
    back /= np.linalg.norm(back, axis=1, keepdims=True)
    return np.stack([np.cross(back, up), back, up], axis=2)


def _normalised(direction: FloatArray) -> FloatArray:
    return np.asarray(direction / np.linalg.norm(direction))
