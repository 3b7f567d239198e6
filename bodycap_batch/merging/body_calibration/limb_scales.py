"""Each limb on its own: the scale at which it fits, as a check of the bones against each other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.body.bones import kinematic_chain
from bodycap_batch.merging.body_calibration.calibration_graph import CalibrationGraph
from bodycap_batch.merging.body_calibration.samples import take_samples
from bodycap_batch.merging.body_calibration.scale import ScaleSource
from bodycap_batch.merging.cameras.track import MAX_SAMPLE_GAP_NS, CameraTrack
from bodycap_batch.model.merge_data import MergeInputs
from bodycap_batch.model.skeleton_presets import split_side

_LOG_SCALE_STEP = 0.1
_SAMPLES = 40
_ENOUGH_TOGETHER = 15
_LIMB_OF_PART = {
    **dict.fromkeys(("Shoulder", "Arm", "ForeArm", "Hand"), "arm"),
    **dict.fromkeys(("UpLeg", "Leg", "Foot", "ToeBase"), "leg"),
    **dict.fromkeys(("Neck", "Head"), "head"),
}


def limb_scales(
    inputs: MergeInputs,
    tracks: Sequence[CameraTrack],
    scale: float,
    known: tuple[FloatArray | None, tuple[int, int] | None],
    step: Callable[[], None],
) -> tuple[ScaleSource, ...]:
    """Scale from the trunk's camera and each limb's alone, by a parabola through three costs.

    Args:
        inputs: The body and its mounts' priors.
        tracks: Cleaned tracks, the trunk's first.
        scale: The scale of the whole body, metres per map unit.
        known: The vertical in the map, and from when to when a T-pose stands, where known.
        step: Called after each iteration; may raise to stop.

    Returns:
        One a limb, fewer where a limb's own cost does not curve; empty for a single limb.
    """
    limbs: dict[str, list[CameraTrack]] = {}
    for track in tracks[1:]:
        side, part = split_side(inputs.mount_of(track.camera).role)
        if part in _LIMB_OF_PART and _common_frames(tracks[0], track) >= _ENOUGH_TOGETHER:
            limbs.setdefault(f"{side.lower()} {_LIMB_OF_PART[part]}".strip(), []).append(track)
    if len(limbs) < 2:
        return ()
    found = [
        _scale_of_limb(name, inputs, [tracks[0], *own], (scale, *known), step)
        for name, own in sorted(limbs.items())
    ]
    return tuple(each for each in found if each is not None)


def _common_frames(trunk: CameraTrack, track: CameraTrack) -> int:
    return int(track.poses_at(trunk.times_ns, max_gap_ns=MAX_SAMPLE_GAP_NS)[1].sum())


def _scale_of_limb(
    name: str,
    inputs: MergeInputs,
    tracks: Sequence[CameraTrack],
    known: tuple[float, FloatArray | None, tuple[int, int] | None],
    step: Callable[[], None],
) -> ScaleSource | None:
    scale, up, t_pose_ns = known
    roles = [inputs.mount_of(track.camera).role for track in tracks]
    bones = kinematic_chain(inputs.skeleton, roles)
    index = {bone.role: position for position, bone in enumerate(bones)}
    own = [replace(track, bone=index[role]) for track, role in zip(tracks, roles, strict=True)]
    samples = take_samples(own, scale, _SAMPLES, up, t_pose_ns)
    priors = {mount.camera: mount for mount in inputs.mounts}
    calibration = CalibrationGraph(inputs.skeleton, bones, samples, priors, scale, step)
    middle = calibration.solve(scale)
    low, high = (calibration.solve(scale * float(np.exp(sign * _LOG_SCALE_STEP))) for sign in (-1.0, 1.0))
    bend = low + high - 2.0 * middle
    if bend <= 0.0:
        return None
    offset = 0.5 * _LOG_SCALE_STEP * (low - high) / bend
    return ScaleSource(
        name=name, scale=scale * float(np.exp(offset)), sigma_log=float(_LOG_SCALE_STEP / np.sqrt(bend))
    )
