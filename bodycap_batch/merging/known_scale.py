"""What else than the body's limbs knows the scale of the trunk's own map, before others are joined to it."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from bodycap_batch.arrays import FloatArray
from bodycap_batch.body import MergeInputs
from bodycap_batch.config.options import MergeOptions
from bodycap_batch.errors import EstimationError
from bodycap_batch.geometry import Similarity, invert
from bodycap_batch.merging.board import find_board
from bodycap_batch.merging.distance import known_distance
from bodycap_batch.merging.gauge import WALKING_HEIGHT, standing_height, walked_floor
from bodycap_batch.merging.scale import ScaleSource, floor_source
from bodycap_batch.merging.tracks import Track
from bodycap_batch.merging.upright import Direction


def known_scales(
    inputs: MergeInputs,
    options: MergeOptions,
    trunk: tuple[Track, FloatArray | None],
    body: ScaleSource,
    points: FloatArray,
) -> tuple[ScaleSource, ...]:
    """A stated distance or board in the trunk's map, else its height over the floor that was walked.

    What lies in another map is left to the whole body, whose maps are together then.

    Args:
        inputs: The body and its mounts' priors.
        options: ``known_distance`` and ``marker_board``.
        trunk: The trunk's camera in map units, and the vertical where it is known.
        body: A scale near the right one, and how near.
        points: (P,3) of the trunk's map.
    """
    gauge = next(each.gauge for each in inputs.trajectories if each.camera == trunk[0].camera)
    here = {gauge: Similarity(1.0, np.eye(3), np.zeros(3))}
    stated = []
    # Of another map: told where all maps are in place.
    with suppress(EstimationError):
        stated.append(known_distance(inputs, options, here))
    with suppress(EstimationError):
        board = find_board(inputs, options, here)
        stated.append(None if board is None else board.scale)
    found = tuple(source for source in stated if source is not None)
    floor = None if found else _over_floor(inputs, trunk, body, points)
    return found if floor is None or not floor.used else (floor,)


def _over_floor(
    inputs: MergeInputs, trunk: tuple[Track, FloatArray | None], body: ScaleSource, points: FloatArray
) -> ScaleSource | None:
    """The scale by the trunk's height over the floor, None where none was seen to be walked."""
    track, up = trunk
    mount = inputs.mount_of(track.camera)
    joint = inputs.skeleton.index_of_role(mount.role)
    if up is None or joint is None:
        return None
    metric = track.scaled(body.scale)
    path_m = (metric.map_from_cam @ invert(mount.joint_from_cam))[:, :3, 3]
    height_m, standing_m = float(np.median(path_m @ up)), standing_height(inputs.skeleton, joint)
    expected = height_m - WALKING_HEIGHT * standing_m
    floor = walked_floor(body.scale * points, path_m, Direction(up, "map", None, 0.0), expected, standing_m)
    return None if floor is None else floor_source(body, height_m - floor.height_m, standing_m)
