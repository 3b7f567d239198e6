"""Sources of the main map's scale besides the limbs, before further maps are aligned with it."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.arrays import FloatArray, evenly_spaced
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.merging.body_calibration.calibrate_body import MIN_WALKING_SAMPLES, stated_verticals
from bodycap_batch.merging.body_calibration.known_distance import known_distance
from bodycap_batch.merging.body_calibration.marker_board import locate_board
from bodycap_batch.merging.body_calibration.scale import ScaleSource, scale_from_floor
from bodycap_batch.merging.cameras.track import MAX_SAMPLE_GAP_NS, CameraTrack
from bodycap_batch.merging.graph.posture import find_posture
from bodycap_batch.merging.world.floor import WALKING_HEIGHT_RATIO, floor_beside_path, standing_height
from bodycap_batch.merging.world.vertical import Vertical, VerticalHypothesis
from bodycap_batch.model.geometry import Similarity, invert
from bodycap_batch.model.merge_data import MergeInputs

_MAX_SAMPLES = 240
"""Instants at which the posture is evaluated at most; they bound the time."""


@dataclass(frozen=True, slots=True)
class StatedConstraints:
    """What the job states about one map.

    Attributes:
        scales: From a known distance or a marker board in the map.
        verticals: From a marker board of known placement.
    """

    scales: tuple[ScaleSource, ...] = ()
    verticals: tuple[VerticalHypothesis, ...] = ()


def stated_constraints(inputs: MergeInputs, options: MergeOptions, gauge: str) -> StatedConstraints:
    """Return what the job states about one map alone.

    What concerns another map is used later, when all maps are aligned.

    Args:
        inputs: The trajectories and the views of the board.
        options: ``known_distance`` and ``marker_board``.
        gauge: Of the map.
    """
    own_map = {gauge: Similarity(1.0, np.eye(3), np.zeros(3))}
    distance, board = None, None
    # The errors here concern other maps. They are reported when all maps are aligned.
    with suppress(EstimationError):
        distance = known_distance(inputs.trajectories, options.known_distance, own_map)
    with suppress(EstimationError):
        board = locate_board(inputs.trajectories, inputs.board_views, options.marker_board, own_map)
    scales = (distance, None if board is None else board.scale)
    return StatedConstraints(
        tuple(each for each in scales if each is not None), stated_verticals(options.marker_board, board)
    )


def scale_from_walked_floor(
    inputs: MergeInputs, track: CameraTrack, up: Vertical | None, body: ScaleSource, points: FloatArray
) -> ScaleSource | None:
    """Return the scale from the height of the walking trunk above the floor.

    Only walking counts, because a person who sits or squats is not as tall.

    Args:
        inputs: The body and its mounts' priors.
        track: The trunk's camera, map units.
        up: The vertical, if it is known.
        body: An approximate scale with its sigma.
        points: (P,3) of the trunk's map, map units.

    Returns:
        None if the person does not walk, or if no floor is found beside the path.
    """
    mount = inputs.mount_of(track.camera)
    joint = inputs.skeleton.index_of_role(mount.role)
    if up is None or joint is None:
        return None
    metric = track.scaled(body.scale)
    times_ns = track.times_ns[evenly_spaced(len(track.times_ns), _MAX_SAMPLES)]
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
