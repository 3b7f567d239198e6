"""Draw the person who wears the cameras: true proportions and mounts, which differ from nominal ones."""

from __future__ import annotations

import numpy as np

from bodycap_batch.config.mounts import mount_of
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.geometry import make_transform, so3_exp
from bodycap_batch.model.skeleton import Mount, SkeletonModel
from bodycap_batch.model.skeleton_presets import load_skeleton, nominal_mount, rest_positions, split_side


def draw_body(height_m: float, proportion_range: float, rng: np.random.Generator) -> SkeletonModel:
    """Draw a body of a given stature with other proportions than the nominal body.

    The length of each bone changes by a ratio of up to ±`proportion_range`, equally on both sides. Then the
    whole body is scaled to the stature.
    """
    nominal = load_skeleton("full_body", height_m)
    factors: dict[str, float] = {}
    for name in nominal.joints:
        factors.setdefault(split_side(name)[1], 1.0 + float(rng.uniform(-1, 1)) * proportion_range)
    gain = np.array([factors[split_side(name)[1]] for name in nominal.joints])
    offsets = nominal.offsets_m * gain[:, None]
    ends = nominal.end_offsets_m * gain[:, None]
    offsets[0] = 0.0
    body = _with_bones(nominal, offsets, ends)
    low, high = _height_range(body)
    scale = height_m / (high - low)
    offsets, ends = offsets * scale, ends * scale
    offsets[0] = (0.0, 0.0, -low * scale)
    return _with_bones(nominal, offsets, ends)


def _with_bones(model: SkeletonModel, offsets_m: FloatArray, end_offsets_m: FloatArray) -> SkeletonModel:
    """Return a skeleton with other bone vectors, metres."""
    return SkeletonModel(
        name="synthetic",
        joints=model.joints,
        parents=model.parents,
        offsets_m=offsets_m,
        end_offsets_m=end_offsets_m,
        roles=model.roles,
        bvh_channels=model.bvh_channels,
    )


def _height_range(body: SkeletonModel) -> tuple[float, float]:
    """Return the heights of the soles and of the crown over the root in the zero pose, metres."""
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
"""Standard deviation between people of the joint angles when they stand relaxed, degrees. Shoulder girdle,
shoulder and elbow: interquartile ranges divided by 1.349, of 158 arms of standing people, Y. Yoshida et al.,
"Three-dimensional alignment of the upper extremity in the standing neutral position in healthy subjects", J.
Orthop. Surg. Res. 17, 2022. Trunk: turned like the shoulder blades (3.18 degrees, table 1 of "Standard
reference values of the upper body posture in healthy middle-aged female adults in Germany", Scientific
Reports 11, 2021), inclined by half of the standard deviation of the kyphosis, whose upper half it is (6.4
degrees, Abrisham et al., as cited in https://www.nature.com/articles/s41598-023-27976-8, Scientific Reports
13, 2023)."""


def draw_posture(spread: float, rng: np.random.Generator) -> dict[str, float]:
    """Draw one person's offsets of joint angles from the mean of people, degrees, as in `WalkStyle.posture`.

    Args:
        spread: Factor on the standard deviation between people. Both sides are drawn independently.
        rng: Source of randomness.
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
) -> tuple[Mount, ...]:
    """Draw true mounts: nominal ones, rotated and shifted at random.

    Args:
        cameras: Mount names.
        skeleton: The body that wears the cameras.
        sigmas: Standard deviations in degrees and metres, of all three axes together; each axis gets 1/√3 of
            it.
        rng: Source of randomness.

    Raises:
        JobError: The skeleton has no joint for a camera.
    """
    out = []
    for camera in cameras:
        place = mount_of(camera)
        assert place is not None  # `SynthOptions` refuses other names.
        nominal = nominal_mount(camera, place[1], skeleton)
        turn = so3_exp(rng.normal(0.0, np.radians(sigmas[0]) / np.sqrt(3.0), 3))
        shift = rng.normal(0.0, sigmas[1] / np.sqrt(3.0), 3)
        pose = make_transform(nominal.joint_from_cam[:3, :3] @ turn, nominal.joint_from_cam[:3, 3] + shift)
        out.append(Mount(camera=camera, role=place[1], joint_from_cam=pose, sigma_rad=0.0, sigma_m=0.0))
    return tuple(out)
