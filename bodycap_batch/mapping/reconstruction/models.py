"""The models of a workspace: their files, their order, the names of their keyframes."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

MODELS_FOLDER = "sparse"
"""Folder of the models in a workspace, one numbered folder each; COLMAP's name for it."""


def write_models(workspace: Path, models: Sequence[Any]) -> None:
    """Write the models to ``sparse/<n>``, replacing earlier ones."""
    folder = workspace / MODELS_FOLDER
    shutil.rmtree(folder, ignore_errors=True)
    for number, model in enumerate(models):
        (folder / str(number)).mkdir(parents=True)
        model.write(str(folder / str(number)))


def read_model(workspace: Path, number: int) -> Any:
    """Return one of the models in ``sparse/<n>``."""
    import pycolmap

    return pycolmap.Reconstruction(str(workspace / MODELS_FOLDER / str(number)))


def registered_ids(model: Any) -> set[int]:
    """Return the ids of a model's registered images."""
    return set(map(int, model.reg_image_ids()))


def keyframe_names(model: Any) -> set[str]:
    """Return the image names of a model's registered images."""
    return {model.image(number).name for number in model.reg_image_ids()}


def model_order(model: Any) -> tuple[int, int]:
    """Return the sort key that puts the largest model first: by keyframes, then by points."""
    return -model.num_reg_images(), -model.num_points3D()
