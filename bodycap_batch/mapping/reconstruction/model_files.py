"""Read, write and sort the models of a workspace, and list the registered images of a model."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

MODELS_FOLDER = "sparse"
"""Name of the folder with all models in a workspace, as COLMAP names it. Each model has a numbered folder."""


def write_models(workspace: Path, models: Sequence[Any]) -> None:
    """Write the models to the folders ``sparse/<n>`` of a workspace; delete earlier models there."""
    folder = workspace / MODELS_FOLDER
    shutil.rmtree(folder, ignore_errors=True)
    for number, model in enumerate(models):
        (folder / str(number)).mkdir(parents=True)
        model.write(str(folder / str(number)))


def read_model(workspace: Path, number: int) -> Any:
    """Read the model in the folder ``sparse/<number>`` of a workspace."""
    import pycolmap

    return pycolmap.Reconstruction(str(workspace / MODELS_FOLDER / str(number)))


def registered_ids(model: Any) -> set[int]:
    """Return the ids of a model's registered images."""
    return set(map(int, model.reg_image_ids()))


def keyframe_names(model: Any) -> set[str]:
    """Return the image names of a model's registered images."""
    return {model.image(number).name for number in model.reg_image_ids()}


def model_order(model: Any) -> tuple[int, int]:
    """Return a sort key for models: most keyframes first; with equally many keyframes, most points first."""
    return -model.num_reg_images(), -model.num_points3D()
