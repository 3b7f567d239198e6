"""Draw a random person who wears the cameras.

The true proportions, posture and mounts differ from the nominal values.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodycap_batch.config.mounts import mount_of
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.geometry import make_transform, so3_exp
from bodycap_batch.model.nominal_mounts import nominal_mount
from bodycap_batch.model.skeleton import Mount, SkeletonModel
from bodycap_batch.model.skeleton_presets import load_skeleton, rest_positions, segment_axes, split_side


def draw_body(height_m: float, proportion_range: float, rng: np.random.Generator) -> SkeletonModel:
    """Draw a body of a given stature. Its proportions differ from the proportions of the nominal body.

    The length of each bone is multiplied by a random factor between 1 − `proportion_range` and 1 +
    `proportion_range`. The left and the right side get the same factors. Then the whole body is scaled to the
    stature.

    Args:
        height_m: Stature, metres.
        proportion_range: Maximum relative change of a bone's length.
        rng: Source of randomness.
    """
    nominal = load_skeleton("full_body", height_m)
    factors: dict[str, float] = {}
    for name in nominal.joints:
        factors.setdefault(split_side(name)[1], 1.0 + float(rng.uniform(-1, 1)) * proportion_range)
    gain = np.array([factors[split_side(name)[1]] for name in nominal.joints])
    offsets = nominal.offsets_m * gain[:, None]
    ends = nominal.end_offsets_m * gain[:, None]
    offsets[0] = 0.0
    low, high = _height_range(replace(nominal, offsets_m=offsets, end_offsets_m=ends))
    scale = height_m / (high - low)
    offsets, ends = offsets * scale, ends * scale
    offsets[0] = (0.0, 0.0, -low * scale)
    return replace(nominal, name="synthetic", offsets_m=offsets, end_offsets_m=ends)


def _height_range(body: SkeletonModel) -> tuple[float, float]:
    """Return the heights (metres) of the lowest and the highest point of a body in the zero pose.

    These points are the soles and the crown. The heights are relative to the root.
    """
    joints = rest_positions(body)
    tips = joints + np.nan_to_num(body.end_offsets_m)
    height = np.concatenate([joints[:, 2], tips[:, 2]])
    return float(height.min()), float(height.max())


_POSTURE_SIGMA_DEG = {
    "Bend": 3.2,
    "Turn": 3.2,
    "Lift": 5.4,
    "Ahead": 6.2,
    "Arm": 4.2,
    "Out": 5.1,
    "Spin": 12.5,
    "Elbow": 3.6,
    "Twist": 14.7,
}
"""Standard deviation (degrees) of each joint angle in relaxed standing, between people. `WalkStyle.posture`
explains the names.

Sources: The values of shoulder girdle, shoulder and elbow are interquartile ranges divided by 1.349. They
were measured on 158 arms of standing people: Y. Yoshida et al., "Three-dimensional alignment of the upper
extremity in the standing neutral position in healthy subjects", J. Orthop. Surg. Res. 17, 2022. The rotation
of the trunk (``Turn``) has the standard deviation of the shoulder blades' rotation, 3.18 degrees, from table
1 of "Standard reference values of the upper body posture in healthy middle-aged female adults in Germany",
Scientific Reports 11, 2021. The forward bend of the trunk (``Bend``) has half of the standard deviation of
the kyphosis angle, because the bend is the upper half of the kyphosis. The standard deviation of the whole
angle is 6.4 degrees, from Abrisham et al., as cited in https://www.nature.com/articles/s41598-023-27976-8,
Scientific Reports 13, 2023."""


def draw_posture(spread: float, rng: np.random.Generator) -> dict[str, float]:
    """Draw the posture of one person at random.

    The left and the right arm are drawn independently.

    Args:
        spread: Multiplier of the standard deviation between people.
        rng: Source of randomness.

    Returns:
        Offset (degrees) of each joint angle from the mean of all people, with the names of
        `WalkStyle.posture`.
    """
    drawn = {}
    for part, degrees in _POSTURE_SIGMA_DEG.items():
        for side in ("",) if part in ("Bend", "Turn") else ("Left", "Right"):
            drawn[side + part] = spread * degrees * float(rng.normal())
    return drawn


def draw_mounts(
    cameras: tuple[str, ...],
    skeleton: SkeletonModel,
    sigmas: tuple[float, float],
    rng: np.random.Generator,
    inward_deg: float = 0.0,
) -> tuple[Mount, ...]:
    """Draw the true mounts of the cameras: the nominal mounts, rotated and shifted at random.

    Args:
        cameras: Names of the cameras, which are names of mounts.
        skeleton: Skeleton of the body that wears the cameras.
        sigmas: Total standard deviations of the rotation (degrees) and of the shift (metres). The standard
            deviation for each of the three axes is 1/√3 of the total.
        rng: Source of randomness.
        inward_deg: Rotation of the cameras on hands about the bone, from the thumb's side towards the side of
            the palm, degrees.

    Raises:
        JobError: The skeleton has no joint on which a camera is mounted.
    """
    out = []
    for camera in cameras:
        place = mount_of(camera)
        assert place is not None  # `SynthOptions` refuses names of other places.
        nominal = nominal_mount(camera, place[1], skeleton)
        turn = so3_exp(rng.normal(0.0, np.radians(sigmas[0]) / np.sqrt(3.0), 3))
        shift = rng.normal(0.0, sigmas[1] / np.sqrt(3.0), 3)
        rotation = _towards_palm(skeleton, place[1], inward_deg) @ nominal.joint_from_cam[:3, :3] @ turn
        pose = make_transform(rotation, nominal.joint_from_cam[:3, 3] + shift)
        out.append(Mount(camera=camera, role=place[1], joint_from_cam=pose, sigma_rad=0.0, sigma_m=0.0))
    return tuple(out)


def _towards_palm(skeleton: SkeletonModel, role: str, degrees: float) -> FloatArray:
    """Return a rotation (3,3) about the bone of a hand that turns the thumb's side towards the palm's side.

    For other bones, it is the identity.
    """
    if not role.endswith("Hand"):
        return np.eye(3)
    along, forward, outward = segment_axes(skeleton, role).T
    sense = np.sign(np.dot(np.cross(along, forward), -outward))
    return np.asarray(so3_exp(along * sense * np.radians(degrees)))
