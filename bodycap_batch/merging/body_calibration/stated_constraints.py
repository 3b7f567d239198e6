"""The scales and verticals that the job or accelerometers give, without the motion of the body."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext, suppress
from dataclasses import dataclass

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.merging.body_calibration.known_distance import known_distance
from bodycap_batch.merging.body_calibration.marker_board import locate_board
from bodycap_batch.merging.body_calibration.scale import ScaleSource
from bodycap_batch.merging.world.measured_gravity import verticals_from_accelerometers
from bodycap_batch.merging.world.vertical import VerticalHypothesis
from bodycap_batch.model.geometry import Similarity
from bodycap_batch.model.merge_data import MergeInputs


@dataclass(frozen=True, slots=True)
class StatedConstraints:
    """Scales and verticals in the gauge of the main map.

    Attributes:
        scales: Scales from a known distance or a marker board.
        verticals: Verticals from a marker board of known placement, and from accelerometers.
    """

    scales: tuple[ScaleSource, ...] = ()
    verticals: tuple[VerticalHypothesis, ...] = ()


def stated_constraints(
    inputs: MergeInputs,
    options: MergeOptions,
    main_from_gauge: Mapping[str, Similarity],
    *,
    skip_unusable: bool = False,
) -> StatedConstraints:
    """Return the scales and verticals that the job or accelerometers give.

    Args:
        inputs: The inputs of the merge stage. Only the trajectories, the views of the board and the windows
            of force are used.
        options: Options of the merge stage. Only ``known_distance`` and ``marker_board`` are used.
        main_from_gauge: By gauge of each used map, similarity from this map to the main map. The main map is
            the first.
        skip_unusable: True to leave out a distance or a board that cannot be used, such as one in another
            map, instead of raising an error.

    Raises:
        JobError: The known distance names a frame that does not exist, or two cameras in different maps.
        EstimationError: The known distance or the marker board cannot be used.
    """
    distance, board = None, None
    with suppress(EstimationError) if skip_unusable else nullcontext():
        board = locate_board(inputs.trajectories, inputs.board_views, options.marker_board, main_from_gauge)
    with suppress(EstimationError) if skip_unusable else nullcontext():
        distance = known_distance(inputs.trajectories, options.known_distance, main_from_gauge)
    scales = [] if distance is None else [distance]
    verticals = verticals_from_accelerometers(inputs, main_from_gauge)
    if board is not None and options.marker_board is not None:
        scales.append(board.scale)
        verticals = (*board.verticals(options.marker_board.placed), *verticals)
    return StatedConstraints(tuple(scales), verticals)
