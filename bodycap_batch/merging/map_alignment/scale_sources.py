"""What else than the body's limbs knows the scale of the trunk's own map, before others are joined to it."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.merging.body_calibration.calibrate_body import MIN_WALKING_SAMPLES, stated_verticals
from bodycap_batch.merging.body_calibration.known_distance import known_distance
from bodycap_batch.merging.body_calibration.marker_board import locate_board
from bodycap_batch.merging.body_calibration.scale import ScaleSource, scale_from_floor
from bodycap_batch.merging.cameras.track import SAMPLE_REACH_NS, Track, evenly
from bodycap_batch.merging.graph.posture import find_posture
from bodycap_batch.merging.world.floor import WALKING_HEIGHT, standing_height, walked_floor
from bodycap_batch.merging.world.vertical import Direction, Say
from bodycap_batch.model.geometry import Similarity, invert
from bodycap_batch.model.merge_data import MergeInputs

_TIMES = 240


@dataclass(frozen=True, slots=True)
class Stated:
    """What the job itself says of the trunk's map.

    Attributes:
        scales: By a distance or a board in it.
        ups: By a board that is placed in it.
    """

    scales: tuple[ScaleSource, ...] = ()
    ups: tuple[Say, ...] = ()


def stated_in(inputs: MergeInputs, options: MergeOptions, gauge: str) -> Stated:
    """What the job states of one map by itself.

    What lies in another map is left to the whole body, whose maps are together then.

    Args:
        inputs: The trajectories and the views of the board.
        options: ``known_distance`` and ``marker_board``.
        gauge: The map.
    """
    here = {gauge: Similarity(1.0, np.eye(3), np.zeros(3))}
    distance, board = None, None
    # Of another map: told where all maps are in place.
    with suppress(EstimationError):
        distance = known_distance(inputs.trajectories, options.known_distance, here)
    with suppress(EstimationError):
        board = locate_board(inputs.trajectories, inputs.board_views, options.marker_board, here)
    scales = (distance, None if board is None else board.scale)
    return Stated(
        tuple(each for each in scales if each is not None), stated_verticals(options.marker_board, board)
    )


def floor_scale(
    inputs: MergeInputs, trunk: tuple[Track, Direction | None], body: ScaleSource, points: FloatArray
) -> ScaleSource | None:
    """The scale by the trunk's height over the floor it walks, None where none was seen to be walked.

    Who sits or squats between walks is not as tall as who walks: only the walking counts.

    Args:
        inputs: The body and its mounts' priors.
        trunk: The trunk's camera in map units, and the vertical where it is known.
        body: A scale near the right one, and how near.
        points: (P,3) of the trunk's map.
    """
    track, up = trunk
    mount = inputs.mount_of(track.camera)
    joint = inputs.skeleton.index_of_role(mount.role)
    if up is None or joint is None:
        return None
    metric = track.scaled(body.scale)
    times_ns = track.times_ns[evenly(np.arange(len(track.times_ns)), _TIMES)]
    walking = find_posture(metric, times_ns, up.up, None).walking
    if walking.sum() < MIN_WALKING_SAMPLES:
        return None
    walked, _ = metric.at(times_ns[walking], reach_ns=SAMPLE_REACH_NS)
    path_m, walked_m = (
        (poses @ invert(mount.joint_from_cam))[:, :3, 3] for poses in (metric.map_from_cam, walked)
    )
    height_m, standing_m = float(np.median(walked_m @ up.up)), standing_height(inputs.skeleton, joint)
    expected = height_m - WALKING_HEIGHT * standing_m
    floor = walked_floor(body.scale * points, path_m, up, expected, standing_m)
    found = None if floor is None else scale_from_floor(body, height_m - floor.height_m, standing_m)
    return found if found is not None and found.used else None
