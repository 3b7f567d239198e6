"""The noise of the motion prior, adapted to the measured accelerations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bodycap_batch.merging.body.bones import Bone
from bodycap_batch.merging.cameras.track import CameraTrack
from bodycap_batch.model.geometry import so3_log

_MAX_PSD_RATIO = 100.0
"""Maximum factor on the power spectral density of a bone's acceleration. A factor of 100 stands for ten times
the usual acceleration. Poses with a larger acceleration are wrong. Evidence: none."""


def scale_motion_noise(bones: Sequence[Bone], tracks: Sequence[CameraTrack]) -> tuple[Bone, ...]:
    """Increase the noise of the motion prior for bones that accelerate more than usual.

    The function estimates the power spectral density q of the acceleration from the second differences of
    each camera's path. With a frame interval h, a second difference has the variance 2/3 q h³. Independent
    noise of the poses with sigma σ adds 6 σ². The factor of a bone is the estimate
    divided by the usual value of q. A bone without a camera gets the largest factor of its descendants,
    because a limb swings as a whole.

    Args:
        bones: The graph's bones.
        tracks: Tracks without outliers, poses in metres.

    Returns:
        The bones. Each power spectral density is at least as large as its usual value.
    """
    ratio = np.ones((len(bones), 2))
    for track in tracks:
        step_s = float(np.median(np.diff(track.times_ns))) * 1e-9
        even = np.abs(np.diff(track.times_ns) * 1e-9 - step_s) < 0.2 * step_s
        even = even[1:] & even[:-1]
        rotation, centre = track.map_from_cam[:, :3, :3], track.map_from_cam[:, :3, 3]
        turn = so3_log(np.swapaxes(rotation[:-1], 1, 2) @ rotation[1:])
        for axis, (second, sigma) in enumerate(
            ((np.diff(turn, axis=0), track.sigma_rad), (np.diff(centre, n=2, axis=0), track.sigma_map))
        ):
            if even.sum() >= 10:
                variance = float((second[even] ** 2).mean()) - 6.0 * float(np.median(sigma)) ** 2
                density = variance / (2.0 / 3.0 * step_s**3)
                table = float(bones[track.bone].psd[3 * axis])
                ratio[track.bone, axis] = max(ratio[track.bone, axis], density / table)
    measured = {track.bone for track in tracks}
    for index in range(len(bones) - 1, 0, -1):
        if bones[index].parent not in measured:
            ratio[bones[index].parent] = np.maximum(ratio[bones[index].parent], ratio[index].max())
    ratio = np.minimum(ratio, _MAX_PSD_RATIO)
    return tuple(
        replace(bone, psd=bone.psd * np.repeat(factor, 3)) for bone, factor in zip(bones, ratio, strict=True)
    )
