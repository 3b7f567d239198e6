"""The scale from the floor that the person walks on, for the alignment of further maps."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import FloatArray, evenly_spaced
from bodycap_batch.merging.body_calibration.calibrate_body import MIN_WALKING_SAMPLES
from bodycap_batch.merging.body_calibration.scale import ScaleSource, scale_from_floor
from bodycap_batch.merging.cameras.track import MAX_SAMPLE_GAP_NS, CameraTrack
from bodycap_batch.merging.graph.posture import find_posture
from bodycap_batch.merging.world.floor import WALKING_HEIGHT_RATIO, floor_beside_path, standing_height
from bodycap_batch.merging.world.vertical import Vertical
from bodycap_batch.model.geometry import invert
from bodycap_batch.model.merge_data import MergeInputs

MAX_SAMPLES = 240
"""Maximum number of instants at which cameras and posture are sampled. It bounds the computing time.
Evidence: none."""


def scale_from_walked_floor(
    inputs: MergeInputs, track: CameraTrack, up: Vertical | None, body: ScaleSource, points: FloatArray
) -> ScaleSource | None:
    """Return the scale from the trunk's height above the floor while the person walks.

    Other instants are not used, because sitting or squatting lowers the trunk.

    Args:
        inputs: The inputs of the merge stage. Only the skeleton and the mount priors are used.
        track: Track of the trunk's camera, map units.
        up: The vertical; None if it is unknown.
        body: Approximate scale from the body, with its sigma.
        points: (P,3) points of the trunk's map, map units.

    Returns:
        The scale; None if the vertical is unknown, if the person does not walk, or if the floor beside the
        path gives no usable scale.
    """
    mount = inputs.mount_of(track.camera)
    joint = inputs.skeleton.index_of_role(mount.role)
    if up is None or joint is None:
        return None
    metric = track.scaled(body.scale)
    times_ns = track.times_ns[evenly_spaced(len(track.times_ns), MAX_SAMPLES)]
    walking = find_posture(metric, times_ns, up.up, None).walking
    if walking.sum() < MIN_WALKING_SAMPLES:
        return None
    walking_poses, _ = metric.poses_at(times_ns[walking], max_gap_ns=MAX_SAMPLE_GAP_NS)
    path_m, walking_m = (
        (poses @ invert(mount.joint_from_cam))[:, :3, 3] for poses in (metric.map_from_cam, walking_poses)
    )
    height_m, standing_m = float(np.median(walking_m @ up.up)), standing_height(inputs.skeleton, joint)
    expected = height_m - WALKING_HEIGHT_RATIO * standing_m
    floor = floor_beside_path(body.scale * points, path_m, up, expected, standing_m)
    found = None if floor is None else scale_from_floor(body, height_m - floor.height_m, standing_m)
    return found if found is not None and found.used else None
