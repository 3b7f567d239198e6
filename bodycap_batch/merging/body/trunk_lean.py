"""How a body's trunk leans over time: people bend forwards, which tells up from ahead."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.body.bones import Bone, anatomical_axes
from bodycap_batch.merging.cameras.track import CameraTrack
from bodycap_batch.model.skeleton import Mount, SkeletonModel
from bodycap_batch.model.skeleton_presets import split_side

_MODE_RADIUS_RAD = float(np.radians(15.0))
"""A trunk sways by less than this about its usual direction in walking and standing."""
_MAX_SAMPLES, _SPHERE_DIRECTIONS = 300, 1000
_UPRIGHT_SIGMA_DEG = 12.0
"""Spread of a standing or walking trunk's lean: 5 degrees of habit, the rest its camera's mount."""
_LATERAL_SIGMA_DEG = 12.0
_UPRIGHT_SHARE, _FORWARD_SHARE, _BACKWARD_SHARE, _OUTLIER_SHARE = 0.57, 0.35, 0.07, 0.01
_FORWARD_SCALE_DEG, _BACKWARD_SCALE_DEG, _OUTLIER_HALF_RANGE_DEG = 60.0, 15.0, 180.0
"""Shares of a day, and how far a trunk leans then: picking things up bends it forwards by a right angle and
more, a chair lets it recline by 30 degrees; and one moment in a hundred is none of this."""


@dataclass(frozen=True, slots=True)
class TrunkOrientation:
    """Where a body's trunk pointed over time.

    Attributes:
        axes: (N,3,3) its left, back and up as columns; only up counts where `front_known` is false.
        front_known: Whether its front is known.
    """

    axes: FloatArray
    front_known: bool = True

    def modal_up(self) -> FloatArray:
        """Near which (3,) it is most of the time: who bends now and then is upright in between."""
        return modal_direction(self.axes[:, :, 2])

    def mean_up(self) -> FloatArray:
        """Of all the time (3,): who is bent most of the time leans less in the mean."""
        return _normalised(self.axes[:, :, 2].mean(axis=0))

    def upright_up(self) -> FloatArray:
        """Where it points (3,) when it stands: bending leads away from there forwards, nothing backwards."""
        axes = _subsample(self.axes)
        known = np.vstack([axes[:, :, 2], self.modal_up(), self.mean_up()])
        best = known[int(np.argmin(self.negative_log_likelihood(known)))]
        near = axes[:, :, 2] @ best > np.cos(_MODE_RADIUS_RAD)
        return _normalised(axes[near, :, 2].mean(axis=0)) if near.any() else best

    def negative_log_likelihood(self, ups: FloatArray) -> FloatArray:
        """How strange (C,) the leaning would be, were `ups` (C,3) up: mean −log of its density, nats.

        Only differences count: a trunk that is erect all the time has about 0.
        """
        return self._strangeness(ups, _OUTLIER_SHARE)

    def posterior_spread_deg(self, up: FloatArray) -> float:
        """How far `up` (3,) is off in the mean square, degrees, where nothing but the leaning tells it.

        A lean that lasts does not show: however many moments there are, together they tell as much as one
        does. What one moment in a hundred is counts for nothing here: it may be any direction.
        """
        ups = _fibonacci_sphere(_SPHERE_DIRECTIONS)
        nats = self._strangeness(ups, 0.0)
        likely = np.exp(nats.min() - nats)
        off = np.degrees(np.arccos(np.clip(ups @ up, -1.0, 1.0)))
        return float(np.sqrt(np.average(off**2, weights=likely)))

    def _strangeness(self, ups: FloatArray, anyhow: float) -> FloatArray:
        seen = np.einsum("nji,cj->cni", _subsample(self.axes), ups)
        if not self.front_known:
            angle = np.degrees(np.arccos(np.clip(seen[..., 2], -1.0, 1.0)))
            return np.asarray(_pitch_nll(angle, anyhow).mean(axis=1))
        pitch = np.degrees(np.arctan2(seen[..., 1], seen[..., 2]))
        side = np.degrees(np.arcsin(np.clip(seen[..., 0], -1.0, 1.0)))
        return np.asarray((_pitch_nll(pitch, anyhow) + _lateral_nll(side, anyhow)).mean(axis=1))


def _pitch_nll(pitch_deg: FloatArray, anyhow: float) -> FloatArray:
    """−log of the density of a lean, forwards positive, over that of none."""

    def density(pitch: FloatArray) -> FloatArray:
        forward, backward = np.maximum(pitch, 0.0), np.maximum(-pitch, 0.0)
        return np.asarray(
            _UPRIGHT_SHARE
            / (_UPRIGHT_SIGMA_DEG * np.sqrt(2.0 * np.pi))
            * np.exp(-0.5 * (pitch / _UPRIGHT_SIGMA_DEG) ** 2)
            + (pitch > 0.0) * _FORWARD_SHARE / _FORWARD_SCALE_DEG * np.exp(-forward / _FORWARD_SCALE_DEG)
            + (pitch <= 0.0) * _BACKWARD_SHARE / _BACKWARD_SCALE_DEG * np.exp(-backward / _BACKWARD_SCALE_DEG)
            + anyhow / (2.0 * _OUTLIER_HALF_RANGE_DEG)
        )

    return np.asarray(-np.log(density(pitch_deg) / density(np.zeros(1))))


def _lateral_nll(side_deg: FloatArray, anyhow: float) -> FloatArray:
    """The same of a lean to a side."""
    density = (1.0 - anyhow) * np.exp(-0.5 * (side_deg / _LATERAL_SIGMA_DEG) ** 2) + anyhow
    return np.asarray(-np.log(density))


def _fibonacci_sphere(count: int) -> FloatArray:
    """Directions (C,3) spread evenly: a spiral whose turns are the golden angle apart."""
    place = np.arange(count) + 0.5
    polar, turn = np.arccos(1.0 - 2.0 * place / count), np.pi * (1.0 + np.sqrt(5.0)) * place
    return np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], axis=1)


def trunk_orientation(
    skeleton: SkeletonModel, bones: Sequence[Bone], world_from_bone: FloatArray
) -> TrunkOrientation:
    """Where a body's trunk points, by solved bones (T,B,4,4); without a trunk, where its limbs hang from."""
    trunk = [i for i, bone in enumerate(bones) if not split_side(bone.role)[0]]
    limbs = [
        i for i, bone in enumerate(bones) if split_side(bone.role)[1] in ("Arm", "UpLeg", "Leg", "ForeArm")
    ]
    if trunk:
        left, up = (world_from_bone[:, trunk, :3, axis].mean(axis=1) for axis in (0, 2))
        return TrunkOrientation(_orthogonal_axes(left, up))
    chosen = limbs or list(range(len(bones)))
    along = [world_from_bone[:, i, :3, :3] @ anatomical_axes(skeleton, bones[i].role)[:, 0] for i in chosen]
    hanging = _normalised(-np.mean(along, axis=(0, 1)))
    return TrunkOrientation(
        _orthogonal_axes(np.linalg.svd(hanging[None])[2][1:2], hanging[None]), front_known=False
    )


def trunk_orientation_from_prior(bones: Sequence[Bone], trunk: CameraTrack, mount: Mount) -> TrunkOrientation:
    """Where the trunk points in the map, as a camera's path and its mount's prior promise."""
    rest = np.eye(3)
    index = trunk.bone
    while bones[index].parent >= 0:
        rest = bones[index].mean_rotation.T @ rest
        index = bones[index].parent
    joint = trunk.map_from_cam[:, :3, :3] @ mount.joint_from_cam[:3, :3].T
    return TrunkOrientation(joint @ rest)


def modal_direction(directions: FloatArray) -> FloatArray:
    """The direction (3,) near which most of (N,3) lie: who bends down is upright in between.

    The mean of a lifter's trunk leans by half of its bends.
    """
    some = _subsample(directions)
    some = some / np.linalg.norm(some, axis=1, keepdims=True)
    near = some @ some.T > np.cos(_MODE_RADIUS_RAD)
    return _normalised(some[near[int(np.argmax(near.sum(axis=1)))]].mean(axis=0))


def _subsample(moments: FloatArray) -> FloatArray:
    """About 300 of (N,...), evenly."""
    return np.asarray(moments[np.unique(np.linspace(0, len(moments) - 1, _MAX_SAMPLES).astype(np.int64))])


def _orthogonal_axes(left: FloatArray, up: FloatArray) -> FloatArray:
    """Left, back and up (N,3,3) from left and up that are about at right angles."""
    up = up / np.linalg.norm(up, axis=1, keepdims=True)
    back = np.cross(up, left)
    back /= np.linalg.norm(back, axis=1, keepdims=True)
    return np.stack([np.cross(back, up), back, up], axis=2)


def _normalised(direction: FloatArray) -> FloatArray:
    return np.asarray(direction / np.linalg.norm(direction))
