"""The inputs of merging with the axes of the cameras instead of those of stabilised pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.geometry import make_transform
from bodycap_batch.model.merge_data import BoardView, MergeInputs


def with_axes_of_cameras(inputs: MergeInputs) -> MergeInputs:
    """Return the inputs with paths and observations of the board in the axes of the cameras' lenses."""
    turns = inputs.picture_turns
    return replace(
        inputs,
        trajectories=tuple(
            turns[path.camera].camera_path(path) if path.camera in turns else path
            for path in inputs.trajectories
        ),
        board_views=tuple(
            _turned(view, turns[view.camera].cam_from_picture[view.frame]) if view.camera in turns else view
            for view in inputs.board_views
        ),
        picture_turns={},
    )


def _turned(view: BoardView, cam_from_picture: FloatArray) -> BoardView:
    """Return the observation in turned axes."""
    directions = np.column_stack([view.rays, np.ones(len(view.rays))]) @ cam_from_picture.T
    return replace(
        view,
        rays=directions[:, :2] / directions[:, 2:],
        cam_from_board=make_transform(cam_from_picture, np.zeros(3)) @ view.cam_from_board,
    )
